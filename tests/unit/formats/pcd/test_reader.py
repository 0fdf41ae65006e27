# SPDX-License-Identifier: Apache-2.0
"""The reader against files made byte by byte: types, layouts, oddities, sizes, what it yields."""

from __future__ import annotations

import itertools
import math
import os
import random
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import CAUSES
from tests.support.cloud_bytes import CODES, Field, Number, body, column, header, pcd

ENCODINGS = ("ascii", "binary", "binary_compressed")
X = column("x", "F4", [0.5, 1.5, -2.5])
Y = column("y", "F4", [10.0, 11.0, 12.0])
Z = column("z", "F4", [-1.0, 0.0, 1.0])
XYZ = [X, Y, Z]


class Read:
    """A whole file, read block by block, and what the reader said."""

    def __init__(self, file: Path, **options: Any) -> None:
        with PcdReader(file, **options) as reader:
            self.blocks = [tuple(part.copy() for part in block) for block in reader.blocks()]
            self.reader = reader
        self.columns: dict[str, NDArray[Any]] = {}
        for index, spec in enumerate(reader.columns):
            parts = [block[index] for block in self.blocks]
            assert all(part.dtype == spec.dtype and part.flags.c_contiguous for part in parts)
            if parts:
                self.columns[spec.name] = np.concatenate(parts)


def read(tmp_path: Path, data: bytes, **options: Any) -> Read:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(data)
    return Read(path, **options)


def refused(tmp_path: Path, data: bytes) -> MapDataError:
    with pytest.raises(MapDataError) as caught:
        read(tmp_path, data)
    assert caught.value.cause in CAUSES
    assert str(tmp_path / "cloud.pcd") in str(caught.value)
    return caught.value


def refused_at_once(tmp_path: Path, data: bytes) -> MapDataError:
    """The error, which comes before memory is taken for what the file claims."""
    refused(tmp_path, data)  # once, so that what it imports and caches does not count
    tracemalloc.start()
    error = refused(tmp_path, data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 500_000
    return error


def packed(field: Field) -> bytes:
    return b"".join(field.pack(row) for row in range(len(field.rows)))


def extremes(kind: str, size: int) -> list[Number]:
    if kind == "F":
        largest = math.ldexp(2 - 2.0 ** (-23 if size == 4 else -52), 127 if size == 4 else 1023)
        return [largest, -largest, math.ldexp(1, -149 if size == 4 else -1074)]
    bits = 8 * size
    return [0, 2**bits - 1, 1] if kind == "U" else [-(2 ** (bits - 1)), 2 ** (bits - 1) - 1, -1]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(("kind", "size"), CODES)
@pytest.mark.parametrize("count", [1, 3])
def test_every_type_keeps_its_bits(tmp_path: Path, encoding: str, kind: str, size: int, count: int) -> None:
    values = extremes(kind, size)
    rows = tuple(tuple(values[(row + part) % 3] for part in range(count)) for row in range(3))
    extra = Field("extra", kind, size, rows, count)
    for fields in ([*XYZ, extra], [extra, *XYZ], [X, extra, Y, Z]):
        found = read(tmp_path, pcd(fields, encoding))
        assert found.columns["extra"].tobytes() == packed(extra)
        assert found.columns["extra"].shape == ((3,) if count == 1 else (3, 3))
        assert found.columns["extra"].dtype == np.dtype(f"<{kind.lower()}{size}")
        assert found.columns["xyz"].tobytes() == body(XYZ, "binary")
        assert not found.reader.warnings


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_coordinates_in_any_order_and_place(tmp_path: Path, encoding: str) -> None:
    extra = column("intensity", "U2", [1, 2, 65535])
    for order in itertools.permutations([X, Y, Z, extra]):
        found = read(tmp_path, pcd(order, encoding))
        assert list(found.columns) == ["xyz", "intensity"]
        assert found.columns["xyz"].tobytes() == body(XYZ, "binary")
        assert found.columns["intensity"].tolist() == [1, 2, 65535]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    ("types", "dtype"),
    [
        (("F4", "F4", "F4"), "<f4"),
        (("F8", "F8", "F8"), "<f8"),
        (("F4", "F8", "F4"), "<f8"),
        (("I2", "U2", "I1"), "<f4"),
        (("F4", "U1", "F4"), "<f4"),
        (("I4", "F4", "F4"), "<f8"),
        (("U4", "U4", "U4"), "<f8"),
        (("I8", "F4", "U8"), "<f8"),
    ],
)
def test_coordinates_are_promoted_without_loss(
    tmp_path: Path, encoding: str, types: tuple[str, str, str], dtype: str
) -> None:
    values: dict[str, list[Number]] = {
        "F4": [0.1, -3.5, 89000.125],
        "F8": [0.1, 589500.123456789, -1e300],
        "I1": [-128, 127, 3],
        "U1": [0, 255, 3],
        "I2": [-32768, 32767, 3],
        "U2": [0, 65535, 3],
        "I4": [-(2**31), 2**31 - 1, 3],
        "U4": [0, 2**32 - 1, 3],
        "I8": [-(2**53), 2**53, 3],
        "U8": [0, 2**53, 3],
    }
    fields = [column(name, kind, values[kind]) for name, kind in zip("xyz", types, strict=True)]
    xyz = read(tmp_path, pcd(fields, encoding)).columns["xyz"]
    assert xyz.dtype == np.dtype(dtype)
    for axis, field in enumerate(fields):
        exact = struct.unpack(f"<3{CODES[field.kind, field.size]}", packed(field))
        assert [float(value) for value in xyz[:, axis]] == [float(value) for value in exact]
        assert all(int(value) == value for value in xyz[:, axis].tolist()) or field.kind == "F"


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("value", [2**53 + 1, -(2**53) - 1])
def test_an_integer_coordinate_that_no_float_holds_is_refused(
    tmp_path: Path, encoding: str, value: int
) -> None:
    fields = [column("x", "I8", [1, value, 3]), Y, Z]
    assert refused(tmp_path, pcd(fields, encoding)).cause == "coordinate_range"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_padding_is_left_out(tmp_path: Path, encoding: str) -> None:
    pad = Field("_", "U", 1, ((1, 2, 3, 4),) * 3, 4)
    tail = Field("_", "F", 4, ((math.nan, math.nan),) * 3, 2)
    none = Field("_", "U", 1, ((),) * 3, 0)
    intensity = column("intensity", "F4", [7.0, 8.0, 9.0])
    found = read(tmp_path, pcd([*XYZ, pad, intensity, tail, none], encoding))
    assert list(found.columns) == ["xyz", "intensity"]
    assert found.columns["intensity"].tolist() == [7.0, 8.0, 9.0]
    assert found.columns["xyz"].tobytes() == body(XYZ, "binary")
    assert not found.reader.warnings


def test_compressed_padding_may_be_in_the_data(tmp_path: Path) -> None:
    pad = Field("_", "U", 1, ((1, 2, 3, 4),) * 3, 4)
    intensity = column("intensity", "F4", [7.0, 8.0, 9.0])
    named = [*XYZ, Field("pad", "U", 1, pad.rows, 4), intensity]
    data = header([*XYZ, pad, intensity], "binary_compressed") + body(named, "binary_compressed")
    assert read(tmp_path, data).columns["intensity"].tolist() == [7.0, 8.0, 9.0]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path, encoding: str) -> None:
    rng = random.Random(3)
    bad = [math.nan, math.inf, -math.inf]
    rows = 700
    wrong = set(rng.sample(range(rows), 90))
    coordinates = [[rng.uniform(-100, 100) for _ in range(3)] for _ in range(rows)]
    for row in wrong:
        coordinates[row][rng.randrange(3)] = rng.choice(bad)
    fields = [column(name, "F8", [c[axis] for c in coordinates]) for axis, name in enumerate("xyz")]
    fields.append(column("label", "U4", list(range(rows))))
    fields.append(column("ring", "F4", [rng.choice([*bad, 1.0]) for _ in range(rows)]))
    for block_points in (1, 64, 512, 513, 10**6):
        found = read(tmp_path, pcd(fields, encoding), block_points=block_points)
        kept = [row for row in range(rows) if row not in wrong]
        assert found.columns["label"].tolist() == kept
        assert found.columns["xyz"].tolist() == [coordinates[row] for row in kept]
        assert (found.reader.kept, found.reader.dropped) == (len(kept), 90)
        assert found.reader.header.points == rows
        low, high = found.reader.bounds
        finite = [coordinates[row] for row in kept]
        assert low.tolist() == [min(p[axis] for p in finite) for axis in range(3)]
        assert high.tolist() == [max(p[axis] for p in finite) for axis in range(3)]
    everything = read(tmp_path, pcd(fields, encoding), keep_non_finite=True)
    assert everything.columns["label"].tolist() == list(range(rows))
    assert (everything.reader.kept, everything.reader.dropped) == (rows, 0)
    assert everything.reader.bounds[0].tolist() == low.tolist()
    assert repr(everything.columns["ring"].tolist()) == repr([row[0] for row in fields[4].rows])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_block_size_changes_nothing(tmp_path: Path, encoding: str) -> None:
    rows = 1500
    rng = random.Random(5)
    fields = [
        column(name, "F4", [float(rng.randrange(-999, 999)) / 8 for _ in range(rows)]) for name in "xyz"
    ]
    fields.insert(1, Field("h", "I", 2, tuple((row, -row, 7) for row in range(rows)), 3))
    data = pcd(fields, encoding)
    whole = read(tmp_path, data)
    assert whole.columns["h"].tolist() == [list(row) for row in fields[1].rows]
    for block_points in (1, 2, 511, 512, 513, 1024, 1499, 1500):
        found = read(tmp_path, data, block_points=block_points)
        assert max(len(block[0]) for block in found.blocks) <= block_points
        assert {len(part) for block in found.blocks for part in block} == {len(b[0]) for b in found.blocks}
        for name, values in whole.columns.items():
            assert found.columns[name].tobytes() == values.tobytes()
        assert [b.tolist() for b in found.reader.bounds] == [b.tolist() for b in whole.reader.bounds]
        assert found.reader.digest == whole.reader.digest


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_digest_is_that_of_the_whole_file(tmp_path: Path, encoding: str) -> None:
    for data in (pcd(XYZ, encoding), pcd(XYZ, encoding) + b"\n# trailing bytes"):
        assert read(tmp_path, data).reader.digest == xxhash.xxh3_128(data).digest()
    assert len(read(tmp_path, data).reader.digest) == 16


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_reading_again_gives_the_same(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd([column("x", "F4", [math.nan, 1, 2]), Y, Z], encoding))
    with PcdReader(path) as reader:
        seen = []
        for _ in range(2):
            points = [block[0].tolist() for block in reader.blocks()]
            seen.append((points, reader.kept, reader.dropped, reader.digest, reader.warnings))
    assert seen[0] == seen[1]
    assert seen[0][1:3] == (2, 1)


def test_two_readers_at_once_do_not_share_buffers(tmp_path: Path) -> None:
    paths = []
    for index in range(2):
        paths.append(tmp_path / f"{index}.pcd")
        fields = [column(name, "F4", [float(index)] * 100) for name in "xyz"]
        paths[-1].write_bytes(pcd(fields, "binary"))
    with PcdReader(paths[0], block_points=10) as one, PcdReader(paths[1], block_points=10) as two:
        for first, second in zip(one.blocks(), two.blocks(), strict=True):
            assert set(first[0].ravel().tolist()) == {0.0}
            assert set(second[0].ravel().tolist()) == {1.0}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("size", [0, 1])
def test_empty_and_single_clouds(tmp_path: Path, encoding: str, size: int) -> None:
    fields = [column(name, "F4", [2.5] * size) for name in "xyz"]
    found = read(tmp_path, pcd(fields, encoding))
    assert found.reader.kept == size
    low, high = found.reader.bounds
    assert np.isnan(low).all() == (size == 0)
    assert np.isnan(high).all() == (size == 0)
    assert not found.reader.warnings
    assert found.reader.digest


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_truncation_at_every_byte(tmp_path: Path, encoding: str) -> None:
    """No prefix reads as something else: it is refused, or only the final newline was missing."""
    data = pcd([*XYZ, column("i", "U1", [7, 8, 9])], encoding)
    good = {name: values.tobytes() for name, values in read(tmp_path, data).columns.items()}
    for size in range(len(data)):
        if encoding == "ascii" and size == len(data) - 1:
            found = read(tmp_path, data[:size])
            assert {name: values.tobytes() for name, values in found.columns.items()} == good
        else:
            error = refused(tmp_path, data[:size])
            assert error.offset is None or 0 <= error.offset <= size


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("line", [b"# DATA follows\n", b"DATABASE survey 7\n", b"DATA_SOURCE a drive\n"])
def test_a_header_longer_than_the_first_read(tmp_path: Path, encoding: str, line: bytes) -> None:
    for comment_bytes in (0, 1900, 2048, 2100, 60_000):
        more = line + b"#" * comment_bytes + b"\nFIELDS"
        found = read(tmp_path, pcd(XYZ, encoding).replace(b"FIELDS", more, 1))
        assert found.reader.kept == 3


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed"])
def test_trailing_bytes_are_reported(tmp_path: Path, encoding: str) -> None:
    found = read(tmp_path, pcd(XYZ, encoding) + b"extra")
    assert found.reader.kept == 3
    assert any("5 bytes" in warning for warning in found.reader.warnings)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("points", [1000, 10**8, 3 * 10**9, 10**12, 10**18])
def test_large_claims_allocate_nothing(tmp_path: Path, encoding: str, points: int) -> None:
    change: dict[str, str | None] = {"POINTS": str(points), "WIDTH": str(points)}
    refused_at_once(tmp_path, pcd(XYZ, encoding, change=change))


@pytest.mark.parametrize(
    ("compressed", "plain", "cause"),
    [
        (10**9, None, "truncated"),
        (None, 2**32 - 16, "bad_lzf"),
        (None, 35, "bad_lzf"),
        (None, 37, "bad_lzf"),
        (0, None, "bad_lzf"),
        (None, 0, "bad_lzf"),
        (5, None, "bad_lzf"),
    ],
)
def test_wrong_compressed_sizes(
    tmp_path: Path, compressed: int | None, plain: int | None, cause: str
) -> None:
    data = bytearray(pcd(XYZ, "binary_compressed"))
    at = len(header(XYZ, "binary_compressed"))
    if compressed is not None:
        struct.pack_into("<I", data, at, compressed)
    if plain is not None:
        struct.pack_into("<I", data, at + 4, plain)
    error = refused_at_once(tmp_path, bytes(data))
    assert error.cause == cause
    assert error.offset is not None
    assert at <= error.offset <= at + 8


def test_claim_that_lzf_cannot_reach(tmp_path: Path) -> None:
    """Sizes that agree with POINTS, and 30 compressed bytes for 120 MB."""
    change: dict[str, str | None] = {"POINTS": "10000000", "WIDTH": "10000000"}
    data = header(XYZ, "binary_compressed", change=change) + struct.pack("<II", 30, 120_000_000) + bytes(30)
    assert refused(tmp_path, data).cause == "bad_lzf"


def test_no_descriptor_is_left_open(tmp_path: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for data in (b"", b"junk", pcd(XYZ, "binary")[:-1], pcd(XYZ, "binary"), pcd(XYZ, "ascii")[:-9]):
        path = tmp_path / "cloud.pcd"
        path.write_bytes(data)
        try:
            Read(path)
        except MapDataError:
            continue
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_file_cut_while_being_read(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(pcd([column(name, "F4", [1.0] * 1000) for name in "xyz"], "binary"))
    with PcdReader(path, block_points=100) as reader:
        blocks = reader.blocks()
        next(blocks)
        os.truncate(path, 3000)
        with pytest.raises(MapDataError) as caught:
            list(blocks)
    assert caught.value.cause == "truncated"


def test_signalling_nans_and_payloads_pass_as_bits(tmp_path: Path) -> None:
    bits = struct.pack("<3I", 0x7F800001, 0xFFC12345, 0x80000000)
    data = bytearray(pcd([*XYZ, column("w", "F4", [1.0, 1.0, 1.0])], "binary"))
    start = len(header([*XYZ, column("w", "F4", [1.0, 1.0, 1.0])], "binary"))
    for row in range(3):
        data[start + 16 * row + 12 : start + 16 * row + 16] = bits[4 * row : 4 * row + 4]
    data[start : start + 4] = bits[:4]  # and one in x
    found = read(tmp_path, bytes(data))
    assert found.reader.dropped == 1
    assert found.columns["w"].tobytes() == bits[4:]
    assert read(tmp_path, bytes(data), keep_non_finite=True).columns["w"].tobytes() == bits
