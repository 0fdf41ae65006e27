# SPDX-License-Identifier: Apache-2.0
"""Points in millimetres: how far they move, which stay exact, golden bytes, back into a segment."""

from __future__ import annotations

import os
import random
import struct
import zlib
from hashlib import sha256
from typing import Any

import numpy as np
import pytest
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.segment.header import unpack_header
from shmmap.segment.layout import SegmentHeader
from tests.support.fuzzing import mutate_bytes
from tests.support.published_maps import columns_of
from tests.support.segments import write_segment as segment_of

zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.origin.remote.published_object import (  # noqa: E402
    CellIdentity,
    bare_object,
    pack_object,
    read_bare_header,
    rows_of,
    to_millimetres,
    unpack_object,
    write_segment,
)

BOX = (0.0, 0.0, 20.0, 20.0)
STAMP = bytes(24)


def segment(columns: dict[str, NDArray[Any]]) -> memoryview:
    fd = os.memfd_create("segment")
    try:
        header = segment_of(fd, columns)
        return memoryview(os.pread(fd, header.total_bytes, 0))
    finally:
        os.close(fd)


def loaded(unpacked: bytes | bytearray) -> tuple[SegmentHeader, dict[str, NDArray[Any]]]:
    """Header and columns of the segment that a loader makes, its checksums compared."""
    name, frame = pack_object(unpacked, sha256(unpacked).digest())
    fd = os.memfd_create("loaded")
    try:
        identity = CellIdentity("/m/" + "long" * 900, BOX, "map", STAMP)
        reserved: list[int] = []
        write_segment(unpack_object(frame, name), fd, identity, "points", reserve=reserved.append)
        data = os.pread(fd, os.fstat(fd).st_size, 0)
        assert reserved == [len(data)]
    finally:
        os.close(fd)
    header = unpack_header(memoryview(data), len(data))
    assert header.total_bytes == len(data)
    columns = {}
    for column in header.columns:
        raw = data[column.offset : column.offset + column.nbytes]
        assert xxhash.xxh3_64_intdigest(raw) == column.checksum
        columns[column.name] = np.frombuffer(raw, column.dtype).reshape(column.shape)
    return header, columns


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
    header, found = loaded(unpacked)
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
    _, found = loaded(bare_object(segment({"xyz": xyz}), millimetres=True))
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


def _exact(columns: dict[str, NDArray[Any]]) -> bool:
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
GOLDEN = {
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


def golden() -> bytearray:
    xyz = np.array([[2.6, -2.5, 32.768], [1.6, -2.5, 0.0]], np.float32)
    made = segment({"xyz": xyz, "intensity": np.array([0x0102, 0x0304], np.uint16)})
    return bare_object(made, millimetres=True)


def test_golden_bytes() -> None:
    unpacked = golden()
    assert len(unpacked) == 4224
    for at, text in GOLDEN.items():
        raw = bytes.fromhex(text)
        assert unpacked[at : at + len(raw)].hex() == text, at
    assert struct.unpack_from("<I", unpacked, 4024) == (zlib.crc32(unpacked[:4024]),)
    xyz = np.array([[1.6, -2.5, 0.0], [2.6, -2.5, 32.768]], np.float32)
    assert struct.unpack_from("<Q", unpacked, 632) == (xxhash.xxh3_64_intdigest(xyz.tobytes()),)
    assert (loaded(unpacked)[1]["xyz"] == xyz).all()


def _changed(at: int, raw: bytes) -> bytearray:
    unpacked = golden()
    unpacked[at : at + len(raw)] = raw
    struct.pack_into("<I", unpacked, 4024, zlib.crc32(unpacked[:4024]))
    return unpacked


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
        loaded(_changed(at, raw))
    assert caught.value.cause == "damaged"


def test_an_exact_object_with_the_flag_is_damaged() -> None:
    unpacked = bare_object(segment({"xyz": points(5, (0, 0, 0))}))
    struct.pack_into("<I", unpacked, 208, 3)
    struct.pack_into("<I", unpacked, 4024, zlib.crc32(unpacked[:4024]))
    with pytest.raises(MapDataError, match="not what their flag says"):
        loaded(unpacked)


def test_whatever_is_in_a_frame_gives_a_segment_or_a_clear_error() -> None:
    rng, good = random.Random(6), bytes(golden())
    outcomes = {"refused": 0, "made": 0}
    for _ in range(600):
        unpacked = bytearray(mutate_bytes(good, rng, [good]))
        if len(unpacked) > 4096 and rng.random() < 0.7:
            struct.pack_into("<I", unpacked, 4024, zlib.crc32(memoryview(unpacked)[:4024]))
        name, frame = pack_object(unpacked, sha256(unpacked).digest())
        fd = os.memfd_create("loaded")
        try:
            identity = CellIdentity("/m/a.pcd", BOX, "map", STAMP)
            write_segment(unpack_object(frame, name), fd, identity, "points")
            outcomes["made"] += 1
        except MapDataError:
            outcomes["refused"] += 1
        finally:
            os.close(fd)
    assert min(outcomes.values()) > 20
