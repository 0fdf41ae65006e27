# SPDX-License-Identifier: Apache-2.0
"""Objects of a published map: golden bytes, back into a segment bit by bit, and whatever else is refused."""

from __future__ import annotations

import os
import random
import struct
import zlib
from hashlib import sha256
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.segment.header import unpack_header
from shmmap.segment.layout import Lattice, SourceStamp
from shmmap.segment.writer import SegmentOrigin, write_table
from tests.support.fuzzing import mutate_bytes
from tests.support.segments import write_segment as segment_of

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_object import (  # noqa: E402
    CellIdentity,
    ObjectName,
    bare_object,
    pack_object,
    rows_of,
    unpack_object,
    write_segment,
)
from shmmap.origin.remote.zstd_frame import unpack_frame  # noqa: E402

STAMP = bytes(range(200, 224))
BOX = (-20.0, 0.0, 0.0, 20.0)
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


def golden_columns() -> dict[str, NDArray[Any]]:
    return {
        "xyz": np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        "intensity": np.array([0x0102, 0x0304], np.uint16),
    }


def segment(columns: dict[str, NDArray[Any]], **described: Any) -> bytes:
    fd = os.memfd_create("segment")
    try:
        header = segment_of(fd, columns, **described)
        return os.pread(fd, header.total_bytes, 0)
    finally:
        os.close(fd)


def table(columns: dict[str, NDArray[Any]], layer: str, lattice: Lattice | None = None) -> bytes:
    fd = os.memfd_create("segment")
    try:
        origin = SegmentOrigin("/map/a.pcd", BOX, "map", SourceStamp(1, 2, 3), bytes(range(16)), 5, 0)
        header = write_table(
            fd, columns, layer=layer, rows=len(columns), origin=origin, builder_version=2, units={},
            lattice=lattice, z_min=0.0, z_max=1.0,
        )  # fmt: skip
        return os.pread(fd, header.total_bytes, 0)
    finally:
        os.close(fd)


def golden_segment(**described: Any) -> bytes:
    return segment(
        golden_columns(),
        **{"z_min": -1.5, "z_max": 2.25, "source_points": 3, "dropped_points": 1, **described},
    )


def named(unpacked: bytes | bytearray) -> tuple[ObjectName, bytes]:
    return pack_object(unpacked, sha256(unpacked).digest())


def loaded(unpacked: bytes | bytearray, layer: str = "points", cell_id: str = "/m/b.pcd") -> bytes:
    fd = os.memfd_create("loaded")
    try:
        reserved: list[int] = []
        header = write_segment(
            bytes(unpacked), fd, CellIdentity(cell_id, BOX, "town", STAMP), layer, reserve=reserved.append
        )
        assert reserved == [header.total_bytes] == [os.fstat(fd).st_size]
        return os.pread(fd, header.total_bytes, 0)
    finally:
        os.close(fd)


def golden_object() -> bytes:
    page = bytearray(4224)
    for offset, text in GOLDEN.items():
        raw = bytes.fromhex(text)
        page[offset : offset + len(raw)] = raw
    struct.pack_into("<I", page, 4024, zlib.crc32(memoryview(page)[:4024]))
    return bytes(page)


def test_golden_bytes() -> None:
    assert bytes(bare_object(memoryview(golden_segment()))) == golden_object()


def test_equal_points_give_an_equal_object_wherever_they_are() -> None:
    one = bare_object(memoryview(golden_segment()))
    other = golden_segment(
        cell_id="/elsewhere/" + "x" * 5000 + ".pcd",
        box=(1.0, 2.0, 3.0, 4.0),
        source=SourceStamp(9, 9, 9),
        source_digest=bytes(range(16)),
    )
    assert bare_object(memoryview(other)) == one
    assert bare_object(memoryview(golden_segment(z_max=3.0))) != one


@pytest.mark.parametrize("cell_id", ["/m/b.pcd", "/" + "x" * 9000 + ".pcd", "/karte/straße.pcd"])
def test_a_segment_made_of_it_has_the_columns_bit_by_bit(cell_id: str) -> None:
    source = golden_segment()
    made = loaded(bare_object(memoryview(source)), cell_id=cell_id)
    before, header = (unpack_header(memoryview(one), len(one)) for one in (source, made))
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
def test_columns_of_every_shape(columns: dict[str, NDArray[Any]]) -> None:
    source = table(columns, "voxel(leaf=1.0)", Lattice((1.0, 1.0, 1.0), (0, 0, 0), (2, 2, 2)))
    unpacked = bare_object(memoryview(source))
    made = loaded(unpacked, "voxel(leaf=1.0)")
    header = unpack_header(memoryview(made), len(made))
    assert made[header.header_bytes :] == source[header.header_bytes :]
    assert header.lattice == Lattice((1.0, 1.0, 1.0), (0, 0, 0), (2, 2, 2))
    for column in unpack_header(memoryview(unpacked), len(unpacked)).columns:
        found = rows_of(unpacked, column)
        assert found.dtype == columns[column.name].dtype
        assert np.array_equal(found, columns[column.name], equal_nan=True)


def test_an_object_of_layout_1_2_is_read() -> None:
    unpacked = bytearray(golden_object())
    struct.pack_into("<H", unpacked, 10, 2)
    struct.pack_into("<I", unpacked, 4024, zlib.crc32(memoryview(unpacked)[:4024]))
    assert loaded(unpacked) == loaded(golden_object())


def test_frames_are_those_of_any_zstd() -> None:
    unpacked = golden_object()
    for level in (1, 3, 19):
        frame = zstandard.ZstdCompressor(level=level, write_checksum=level == 1).compress(unpacked)
        name = ObjectName(sha256(frame).digest(), len(frame), len(unpacked), sha256(unpacked).digest())
        assert unpack_object(frame, name) == unpacked


def refused(frame: bytes, name: ObjectName, layer: str = "points") -> MapDataError:
    with pytest.raises(MapDataError) as error:
        loaded(unpack_object(frame, name), layer)
    return error.value


def test_a_damaged_object_is_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    name, frame = named(golden_object())
    monkeypatch.setattr(zstandard, "ZstdDecompressor", None)
    for damaged in (frame[:-1], frame + b"\0", frame[:50] + b"\x77" + frame[51:]):
        assert refused(damaged, name).cause == "damaged"
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


@pytest.mark.parametrize(
    ("flags", "cause"),
    [(0, "newer"), (2, "newer"), (1 << 31 | 1, "newer")],
    ids=["none", "mm", "unknown"],
)
def test_flags_that_this_reader_does_not_know(flags: int, cause: str) -> None:
    unpacked = bytearray(golden_object())
    struct.pack_into("<I", unpacked, 208, flags)
    struct.pack_into("<I", unpacked, 4024, zlib.crc32(memoryview(unpacked)[:4024]))
    name, frame = named(unpacked)
    error = refused(frame, name)
    assert (error.cause, error.hint) == (cause, "update shmmap")


def test_another_layer_or_another_size_is_refused() -> None:
    name, frame = named(golden_object())
    assert "it is layer 'points', not 'ndt(leaf=2.0)'" in str(refused(frame, name, "ndt(leaf=2.0)"))
    name, frame = named(golden_object() + bytes(64))
    assert "its header says 4,224" in str(refused(frame, name))


def test_whatever_is_in_a_frame_gives_a_segment_or_a_clear_error() -> None:
    rng = random.Random(5)
    good = golden_object()
    outcomes = {"refused": 0, "made": 0}
    for _ in range(600):
        unpacked = bytearray(mutate_bytes(good, rng, [good]))
        if len(unpacked) > 4096 and rng.random() < 0.7:  # so that what comes behind the checksum is reached
            struct.pack_into("<I", unpacked, 4024, zlib.crc32(memoryview(unpacked)[:4024]))
        try:
            loaded(unpacked)
            outcomes["made"] += 1
        except MapDataError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 20, outcomes
