# SPDX-License-Identifier: Apache-2.0
"""Objects of a published map, exact and in millimetres: golden bytes, made into segments, or refused."""

from __future__ import annotations

import os
import random
import struct
import zlib
from collections.abc import Callable
from hashlib import sha256
from typing import Any

import numpy as np
import pytest
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.segment.header import unpack_header
from shmmap.segment.layout import Lattice, SegmentHeader, SourceStamp
from shmmap.segment.writer import SegmentOrigin, write_table
from tests.support.fuzzing import mutate_bytes
from tests.support.published_maps import columns_of
from tests.support.segments import write_segment as segment_of

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_object import (  # noqa: E402
    CellIdentity,
    ObjectName,
    bare_object,
    pack_object,
    read_bare_header,
    rows_of,
    to_millimetres,
    write_segment,
)
from shmmap.origin.remote.zstd_frame import unpack_frame  # noqa: E402

STAMP = bytes(range(200, 224))
BOX = (-20.0, 0.0, 0.0, 20.0)
Columns = dict[str, NDArray[Any]]

# of two points with an intensity; what is not zero
GOLDEN = {
    0: "53484d4d415000010100030004030201",  # magic, 1.3, byte order
    16: "00100000000000008010000000000000",  # 4096 header bytes, 4224 total
    32: "02000000000000000300000000000000",  # 2 rows of 3 points
    48: "01000000000000000000000000000000",  # 1 dropped; no source
    128: "000000000000f8bf0000000000000240",  # z -1.5 .. 2.25
    160: "00000000000000000100000002000000",  # builder 1, 2 columns
    176: "00020000800000000003000000000000",  # table at 512, rows of 128; id at 768, 0 bytes
    192: "00030000060000000603000000000000",  # layer at 768, 6 bytes; frame 0 bytes
    208: "01000000000000000000000000000000",  # planes
    512: "78797a00000000000000000000000000",  # xyz
    544: "00000000000000003c66340000000000",  # <f4
    560: "6d000000000000000000000000000000",  # m
    576: "02000000000000000200000000000000",  # 2 dimensions: 2 x
    592: "03000000000000000000000000000000",  # 3
    608: "00000000000000000010000000000000",  # at 4096
    624: "1800000000000000473470f7cc07e7a6",  # 24 bytes, checksum of the rows
    640: "696e74656e7369747900000000000000",  # intensity
    672: "00000000000000003c75320000000000",  # <u2
    704: "01000000000000000200000000000000",  # 1 dimension: 2
    736: "00000000000000004010000000000000",  # at 4160
    752: "0400000000000000ddc00f1d0cfb5151",  # 4 bytes, checksum
    768: "706f696e747300000000000000000000",  # points
    4016: "00000000000000000000000000000000",  # CRC at 4024
    # 1.0 2.0 3.0, 4.0 5.0 6.0: first bytes of both rows, second bytes, ...
    4096: "0000000080803f400000000000a04040",
    4112: "0000000040c04040",
    4160: "02040103",  # 0x0102, 0x0304
}


def golden_columns() -> Columns:
    return {
        "xyz": np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        "intensity": np.array([0x0102, 0x0304], np.uint16),
    }


def written(write: Callable[[int], SegmentHeader]) -> memoryview:
    """What ``write`` writes to a file of its own."""
    fd = os.memfd_create("segment")
    try:
        header = write(fd)
        assert header.total_bytes == os.fstat(fd).st_size
        return memoryview(os.pread(fd, header.total_bytes, 0))
    finally:
        os.close(fd)


def segment(columns: Columns, **described: Any) -> memoryview:
    return written(lambda fd: segment_of(fd, columns, **described))


def golden_segment(**described: Any) -> memoryview:
    return segment(
        golden_columns(),
        **{"z_min": -1.5, "z_max": 2.25, "source_points": 3, "dropped_points": 1, **described},
    )


def named(unpacked: bytes | bytearray) -> tuple[ObjectName, bytes]:
    return pack_object(unpacked, sha256(unpacked).digest())


def loaded(unpacked: bytes | bytearray, layer: str = "points", cell_id: str = "/m/b.pcd") -> memoryview:
    """The segment that a loader makes."""
    identity, reserved = CellIdentity(cell_id, BOX, "town", STAMP), list[int]()
    made = written(lambda fd: write_segment(bytes(unpacked), fd, identity, layer, reserve=reserved.append))
    assert reserved == [len(made)]
    return made


def loaded_columns(unpacked: bytes | bytearray) -> tuple[SegmentHeader, Columns]:
    """Header and columns of that segment, its checksums compared."""
    data = loaded(unpacked, cell_id="/m/" + "long" * 900)
    header = unpack_header(data, len(data))
    columns = {}
    for column in header.columns:
        raw = data[column.offset : column.offset + column.nbytes]
        assert xxhash.xxh3_64_intdigest(raw) == column.checksum
        columns[column.name] = np.frombuffer(raw, column.dtype).reshape(column.shape)
    return header, columns


def sealed(unpacked: bytearray) -> bytearray:
    """The object with the CRC of its header."""
    struct.pack_into("<I", unpacked, 4024, zlib.crc32(memoryview(unpacked)[:4024]))
    return unpacked


def changed(good: bytes | bytearray, at: int, raw: bytes) -> bytearray:
    unpacked = bytearray(good)
    unpacked[at : at + len(raw)] = raw
    return sealed(unpacked)


def golden_object() -> bytes:
    page = bytearray(4224)
    for offset, text in GOLDEN.items():
        raw = bytes.fromhex(text)
        page[offset : offset + len(raw)] = raw
    return bytes(sealed(page))


def test_golden_bytes() -> None:
    assert bytes(bare_object(golden_segment())) == golden_object()


def test_equal_points_give_an_equal_object_wherever_they_are() -> None:
    one = bare_object(golden_segment())
    other = golden_segment(
        cell_id="/elsewhere/" + "x" * 5000 + ".pcd",
        box=(1.0, 2.0, 3.0, 4.0),
        source=SourceStamp(9, 9, 9),
        source_digest=bytes(range(16)),
    )
    assert bare_object(other) == one
    assert bare_object(golden_segment(z_max=3.0)) != one


@pytest.mark.parametrize("cell_id", ["/m/b.pcd", "/" + "x" * 9000 + ".pcd", "/karte/straße.pcd"])
def test_a_segment_made_of_it_has_the_columns_bit_by_bit(cell_id: str) -> None:
    source = golden_segment()
    made = loaded(bare_object(source), cell_id=cell_id)
    before, header = (unpack_header(one, len(one)) for one in (source, made))
    assert (header.cell_id, header.box, header.frame_id) == (cell_id, BOX, "town")
    assert header.source.token == STAMP
    assert header.source_digest == STAMP[:16]
    assert made[208:212] == bytes(4)
    assert made[header.header_bytes :] == source[before.header_bytes :]
    assert [column.checksum for column in header.columns] == [column.checksum for column in before.columns]
    assert (header.rows, header.source_points, header.dropped_points) == (2, 3, 1)


LARGE = np.random.default_rng(3)


@pytest.mark.parametrize(
    "columns",
    [
        {"xyz": np.zeros((0, 3), np.float32), "ring": np.zeros(0, np.uint16)},
        {"xyz": LARGE.normal(size=(1, 3))},
        {"xyz": LARGE.normal(size=(9000, 3)).astype(np.float32), "t": LARGE.normal(size=9000)},
        {"normal": LARGE.normal(size=(4097, 8)), "wide": LARGE.normal(size=(4097, 9)).astype(np.float32)},
        {"table": LARGE.integers(0, 9, (3, 4, 5)).astype(np.int32), "deep": np.ones((2, 1, 1, 3), np.int8)},
        {"none": np.zeros((4, 0), np.float32), "flag": np.ones(4, np.int8)},
    ],
    ids=["empty", "one", "points", "wide", "tables", "no-width"],
)
def test_columns_of_every_shape(columns: Columns) -> None:
    layer, lattice = "voxel(leaf=1.0)", Lattice((1.0, 1.0, 1.0), (0, 0, 0), (2, 2, 2))
    origin = SegmentOrigin("/map/a.pcd", BOX, "map", SourceStamp(1, 2, 3), bytes(range(16)), 5, 0)
    described: dict[str, Any] = {"layer": layer, "lattice": lattice, "origin": origin, "builder_version": 2}
    source = written(
        lambda fd: write_table(fd, columns, rows=len(columns), units={}, z_min=0.0, z_max=1.0, **described)
    )
    unpacked = bare_object(source)
    made = loaded(unpacked, layer)
    header = unpack_header(made, len(made))
    assert made[header.header_bytes :] == source[header.header_bytes :]
    assert header.lattice == lattice
    for column in unpack_header(memoryview(unpacked), len(unpacked)).columns:
        found = rows_of(unpacked, column)
        assert found.dtype == columns[column.name].dtype
        assert np.array_equal(found, columns[column.name], equal_nan=True)


def test_an_object_of_layout_1_2_is_read() -> None:
    assert loaded(changed(golden_object(), 10, b"\2\0")) == loaded(golden_object())


def test_frames_are_those_of_any_zstd() -> None:
    unpacked = golden_object()
    for level in (1, 3, 19):
        frame = zstandard.ZstdCompressor(level=level, write_checksum=level == 1).compress(unpacked)
        assert unpack_frame(frame, len(unpacked), name="it", exact=True) == unpacked


def refused(frame: bytes, name: ObjectName, layer: str = "points") -> MapDataError:
    with pytest.raises(MapDataError) as error:
        loaded(unpack_frame(frame, name.raw, name=name.path, exact=True), layer)
    return error.value


def test_a_frame_of_another_size_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 26))
    lies = ObjectName(sha256(bomb).digest(), len(bomb), 4224, bytes(32))
    assert "67,108,864" in str(refused(bomb, lies))
    unsized = zstandard.ZstdCompressor(write_content_size=False).compress(golden_object())
    lies = ObjectName(sha256(unsized).digest(), len(unsized), 4224, bytes(32))
    assert "unknown number" in str(refused(unsized, lies))


def test_more_than_one_frame_is_refused() -> None:
    frame = zstandard.ZstdCompressor().compress(b"x" * 100)
    for more in (frame + frame, frame + b"\0", frame[:-2]):
        with pytest.raises(MapDataError):
            unpack_frame(more, 1000, name="it")


@pytest.mark.parametrize("flags", [0, 2, 1 << 31 | 1], ids=["none", "mm", "unknown"])
def test_flags_that_this_reader_does_not_know(flags: int) -> None:
    name, frame = named(changed(golden_object(), 208, struct.pack("<I", flags)))
    error = refused(frame, name)
    assert (error.cause, error.hint) == ("newer", "update shmmap")


def test_another_layer_or_another_size_is_refused() -> None:
    name, frame = named(golden_object())
    assert "it is layer 'points', not 'ndt(leaf=2.0)'" in str(refused(frame, name, "ndt(leaf=2.0)"))
    name, frame = named(golden_object() + bytes(64))
    assert "its header says 4,224" in str(refused(frame, name))


# --- in millimetres ---------------------------------------------------------------------------------


def points(rows: int, at: tuple[float, float, float], size: float = 20.0) -> NDArray[np.float32]:
    rng = np.random.default_rng(rows)
    return (rng.uniform(0, size, (rows, 3)) + at).astype(np.float32)


@pytest.mark.parametrize(
    "at",
    [(0, 0, 0), (-10, -10, -3), (128, 200, 5), (1000, -1000, 40), (9000, 12000, 0), (9e4, -4e4, 8)],
)
def test_points_move_by_half_a_millimetre_and_half_a_step(at: tuple[float, float, float]) -> None:
    """The rows of all columns stay together; nothing is lost, nothing is made."""
    xyz = points(20_000, at)
    intensity = np.arange(len(xyz), dtype=np.uint32)
    colour = np.random.default_rng(1).integers(0, 255, (len(xyz), 3), np.uint8)
    unpacked = bare_object(segment({"xyz": xyz, "intensity": intensity, "rgb": colour}), millimetres=True)
    header, found = loaded_columns(unpacked)
    order = found["intensity"].astype(np.int64)
    assert sorted(order.tolist()) == list(range(len(xyz)))
    assert (found["rgb"] == colour[order]).all()
    assert found["xyz"].dtype == np.float32
    moved = np.abs(found["xyz"].astype(np.float64) - xyz[order])
    allowed = 0.0005 + np.spacing(np.maximum(np.abs(xyz[order]), np.abs(found["xyz"]))) / 2
    assert (moved <= allowed * (1 + 1e-9)).all()
    assert (header.z_min, header.z_max) == (found["xyz"][:, 2].min(), found["xyz"][:, 2].max())
    assert header.rows == len(xyz)
    bare = read_bare_header(unpacked, "points")
    for column in bare.columns:
        assert rows_of(unpacked, column).tobytes() == found[column.name].tobytes()
    for name, values in columns_of(bytes(unpacked), "points", 1).items():
        assert values.tobytes() == found[name].tobytes()


@pytest.mark.parametrize("rows", [1, 2, (1 << 14) - 1, 1 << 14, (1 << 15) + 1])
def test_any_number_of_rows(rows: int) -> None:
    xyz = points(rows, (50, 50, 0))
    _, found = loaded_columns(bare_object(segment({"xyz": xyz}), millimetres=True))
    assert np.abs(np.sort(found["xyz"], axis=0) - np.sort(xyz, axis=0)).max() < 0.00051


def test_near_rows_are_near_and_equal_points_keep_their_order() -> None:
    xyz = points(5000, (0, 0, 0))
    xyz[100:200] = xyz[50]
    rounded = to_millimetres(xyz)
    assert rounded is not None
    assert rounded.order.tolist() != list(range(5000))
    same = [row for row in rounded.order.tolist() if row == 50 or 100 <= row < 200]
    assert same == sorted(same)
    keys = []
    for counts in rounded.counts.tolist():
        bits = [(counts[axis] >> bit & 1) << (3 * bit + axis) for bit in range(16) for axis in range(3)]
        keys.append(sum(bits))
    assert keys == sorted(keys)
    again = to_millimetres(xyz)
    assert again is not None
    assert (again.counts == rounded.counts).all()


def _exact(columns: Columns) -> bool:
    made = segment(columns)
    rounded, exact = bare_object(made, millimetres=True), bare_object(made)
    assert (rounded == exact) == (struct.unpack_from("<I", rounded, 208) == (1,))
    return rounded == exact


def test_what_stays_exact() -> None:
    assert _exact({"xyz": points(10, (0, 0, 0)).astype(np.float64)})
    assert _exact({"xyz": np.empty((0, 3), np.float32)})
    wide = np.array([[0, 0, 0], [0, 65.535, 0]], np.float32)
    assert not _exact({"xyz": wide})
    wide[1, 1] = 65.537
    assert _exact({"xyz": wide})
    wide[:, 1] += 1000
    assert _exact({"xyz": wide})
    for value in (np.inf, np.nan, 3e38):
        assert _exact({"xyz": np.array([[0, 0, 0], [0, 0, value]], np.float32)})
    assert not _exact({"intensity": np.arange(2), "xyz": np.zeros((2, 3), np.float32)})


# of two points with an intensity; what is not zero, and not as in an exact object
GOLDEN_MILLIMETRES = {
    128: "0000000000000000000000e04d624040",  # z 0 .. 32.768 as f32
    208: "03000000000000000000000000000000",  # planes, millimetres
    296: "9a9999999999f93f",  # 1.6: floor of 1.6000000238 to millimetres
    304: "00000000000004c0",  # -2.5
    544: "00000000000000003c75320000000000",  # xyz of <u2
    608: "00000000000000000010000000000000",  # at 4096
    624: "0c00000000000000",  # 12 bytes
    736: "00000000000000004010000000000000",  # intensity at 4160
    4096: "00e80003",  # x: 0, 1000: first bytes of both, second bytes
    4100: "00000000",  # y
    4104: "00000080",  # z: 0, 32768
    4160: "04020301",  # 0x0304, 0x0102: the other way round
}


def golden_millimetres() -> bytearray:
    xyz = np.array([[2.6, -2.5, 32.768], [1.6, -2.5, 0.0]], np.float32)
    made = segment({"xyz": xyz, "intensity": np.array([0x0102, 0x0304], np.uint16)})
    return bare_object(made, millimetres=True)


def test_golden_bytes_in_millimetres() -> None:
    unpacked = golden_millimetres()
    assert len(unpacked) == 4224
    for at, text in GOLDEN_MILLIMETRES.items():
        raw = bytes.fromhex(text)
        assert unpacked[at : at + len(raw)].hex() == text, at
    assert struct.unpack_from("<I", unpacked, 4024) == (zlib.crc32(unpacked[:4024]),)
    xyz = np.array([[1.6, -2.5, 0.0], [2.6, -2.5, 32.768]], np.float32)
    assert struct.unpack_from("<Q", unpacked, 632) == (xxhash.xxh3_64_intdigest(xyz.tobytes()),)
    assert (loaded_columns(unpacked)[1]["xyz"] == xyz).all()


@pytest.mark.parametrize(
    ("at", "raw"),
    [
        (296, struct.pack("<d", float("nan"))),
        (312, struct.pack("<d", float("-inf"))),
        (512, b"xyy"),
        (544, bytes(8) + b"<i2"),
    ],
    ids=["origin", "origin of z", "no xyz", "signed"],
)
def test_what_its_flag_does_not_hold_for_is_damaged(at: int, raw: bytes) -> None:
    with pytest.raises(MapDataError) as caught:
        loaded(changed(golden_millimetres(), at, raw))
    assert caught.value.cause == "damaged"


def test_an_exact_object_with_the_flag_is_damaged() -> None:
    exact = bare_object(segment({"xyz": points(5, (0, 0, 0))}))
    with pytest.raises(MapDataError, match="not what their flag says"):
        loaded(changed(exact, 208, struct.pack("<I", 3)))


@pytest.mark.parametrize("good", [golden_object, golden_millimetres])
def test_whatever_is_in_a_frame_gives_a_segment_or_a_clear_error(
    good: Callable[[], bytes | bytearray],
) -> None:
    rng, sound = random.Random(5), bytes(good())
    outcomes = {"refused": 0, "made": 0}
    for _ in range(600):
        unpacked = bytearray(mutate_bytes(sound, rng, [sound]))
        if len(unpacked) > 4096 and rng.random() < 0.7:  # so that what comes behind the checksum is reached
            sealed(unpacked)
        try:
            loaded(unpacked)
            outcomes["made"] += 1
        except MapDataError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20, outcomes
