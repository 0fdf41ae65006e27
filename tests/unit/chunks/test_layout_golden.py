# SPDX-License-Identifier: Apache-2.0
"""A chunk byte by byte, against hex written down; what is no chunk, or contradicts itself, is refused."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.chunks.layout import (
    ChunkIdentity,
    ChunkView,
    check_consistent,
    new_header,
    read_identity,
)
from shmmap.chunks.marking import Marker
from shmmap.chunks.occupancy import ScanFilter
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import SegmentCorrupt
from tests.support.chunk_memory import MAP_ID, ChunkMemory

IDENTITY = ChunkIdentity(MAP_ID, ChunkKey(-2, 0, 513), 0.25, -1992, 3476, 1386, -847, 7, "map")
GOLDEN = (
    "53484d4348554e4b0200000004030201"  # SHMCHUNK, 2.0, byte order
    "000102030405060708090a0b0c0d0e0f"
    "feffffff000000000102000040000000"  # -2, 0, 513; 64 a side
    "000000000000d03f38f8940d6a05b1fc"  # 0.25 m; -1992, 3476, 1386, -847
    "07000000000000000000000000000000"  # generation 7
    "6d6170" + "00" * 37  # map
)  # fmt: skip


def used_chunk() -> ChunkView:
    """A chunk that took in two scans, the second of another mapper."""
    memory, marker = ChunkMemory(0.1), Marker(0.1, ScanFilter(0.0, 9.0, -9.0, 9.0))
    pose = np.eye(4)
    pose[:3, 3] = 3.0
    points = np.random.default_rng(7).uniform(-2.5, 2.5, (50, 3))
    for number, mapper in enumerate((3, 4), 1):
        memory.apply(marker.mark(points, pose)[0], mapper=mapper, scan=10 * number, known=(3, 4))
    (view,) = memory.chunks.values()
    return view


def test_golden_header() -> None:
    page = new_header(IDENTITY)
    assert len(page) == 4096
    assert page[:120].hex() == GOLDEN
    assert page[120:128] == struct.pack("<II", zlib.crc32(bytes.fromhex(GOLDEN)), 0)
    assert not any(page[128:])
    assert read_identity(page) == IDENTITY


def test_what_changes_stands_where_the_document_says() -> None:
    view = used_chunk()
    data = view.data
    sequence, version, saved, state, bricks, active, occupied, free, _, changed = struct.unpack_from(
        "<QQQIIIIIIQ", data, 128
    )
    assert (sequence, version, saved, state, changed) == (4, 2, 0, 0, 20)
    index = np.frombuffer(data, "<u2", 1024, 2048)
    assert sorted(index[index != 0].tolist()) == list(range(1, bricks + 1))
    cells = np.frombuffer(data, "<i2", bricks * 256, 4096)
    assert (active, occupied, free) == ((cells != 0).sum(), (cells > 0).sum(), (cells < 0).sum())
    assert struct.unpack_from("<IIQIIQI", data, 256) == (3, 0, 10, 4, 0, 20, 0)
    assert not any(data[184:256])
    assert not any(data[768:2048])
    dense = view.dense()
    for place in np.flatnonzero(dense).tolist():
        assert dense[place] == cells[(int(index[place >> 8]) - 1) * 256 + (place & 255)]
    check_consistent(view)


@pytest.mark.parametrize("at", range(128))
def test_a_bit_that_flips_in_what_never_changes_is_noticed(at: int) -> None:
    page = new_header(IDENTITY)
    page[at] ^= 1 << at % 8
    if at >= 124:  # reserved
        assert read_identity(page) == IDENTITY
    else:
        with pytest.raises(SegmentCorrupt):
            read_identity(page)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"resolution": 0.0}, "no chunk -2_0_513"),
        ({"resolution": float("nan")}, "no chunk"),
        ({"key": ChunkKey(2**24, 0, 0)}, "no chunk 16777216_0_0"),
    ],
)
def test_what_cannot_be_is_refused_although_its_checksum_is_right(
    changed: dict[str, object], said: str
) -> None:
    with pytest.raises(SegmentCorrupt, match=said):
        read_identity(new_header(replace(IDENTITY, **changed)))


def test_too_few_bytes_and_other_versions_are_refused() -> None:
    page = new_header(IDENTITY)
    with pytest.raises(SegmentCorrupt, match="127 bytes are too few"):
        read_identity(page[:127])
    for major, minor in ((1, 0), (2, 9)):  # an earlier daemon's chunks are adopted
        struct.pack_into("<HH", page, 8, major, minor)
        struct.pack_into("<I", page, 120, zlib.crc32(page[:120]))
        assert read_identity(page) == IDENTITY
    struct.pack_into("<HH", page, 8, 3, 0)
    with pytest.raises(SegmentCorrupt, match=r"version 3\.0"):
        read_identity(page)


def test_names_that_do_not_fit_are_refused() -> None:
    assert read_identity(new_header(replace(IDENTITY, frame_id="m" * 40))).frame_id == "m" * 40
    for changed in ({"frame_id": "m" * 41}, {"map_id": b"short"}):
        with pytest.raises(ValueError, match="does not fit"):
            new_header(replace(IDENTITY, **changed))


def counter(name: str) -> Callable[[ChunkView], None]:
    def change(view: ChunkView) -> None:
        view.state[name] += 1

    return change


def index_at(at: int, value: int) -> Callable[[ChunkView], None]:
    def change(view: ChunkView) -> None:
        view.index[np.flatnonzero(view.index)[at]] = value

    return change


def two_in_one_place(view: ChunkView) -> None:
    first, second = np.flatnonzero(view.index)[:2]
    view.index[first] = view.index[second]


def cell(value: int) -> Callable[[ChunkView], None]:
    def change(view: ChunkView) -> None:
        view.bricks[0, 0] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (counter("active"), "are active"),
        (counter("occupied"), "are occupied"),
        (counter("free"), "are free"),
        (counter("bricks"), "does not fit"),
        (index_at(0, 0), "does not fit"),
        (index_at(0, 1000), "names brick 1000"),
        (two_in_one_place, "does not fit"),
        (cell(3477), "beyond the clamps"),
        (cell(-1993), "beyond the clamps"),
    ],
)
def test_a_chunk_that_contradicts_itself_is_noticed(change: Callable[[ChunkView], None], said: str) -> None:
    view = used_chunk()
    change(view)
    with pytest.raises(SegmentCorrupt, match=said):
        check_consistent(view)
