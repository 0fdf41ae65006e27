# SPDX-License-Identifier: Apache-2.0
"""The statistics layout, byte by byte, against hex written down."""

from __future__ import annotations

import struct

import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.statistics import layout
from shmmap.statistics.counters import COUNTERS, Counter
from shmmap.statistics.layout import CellRow, State

TWO = (
    Counter("requests", "counter", "", "Requests received"),
    Counter("bytes", "gauge", "bytes", "Bytes held"),
)
GOLDEN_START = (
    "53484d5354415401 0100 0000 04030201"  # magic, 1.0, byte order
    "40000000 02000000 a0000000"  # descriptions at 64: 2 of 160 bytes
    "80010000 00400000"  # identity at 384, 16384 bytes each
    "80810000 40000000"  # state at 33152, 64 bytes each
    "00820000 00900000 00010000 00000200"  # table 33280, rows at 36864 of 256, at most 131072
    "fedf4f8f"
)
GOLDEN_FIRST = "7265717565737473" + "00" * 40 + "00" + "5265717565737473207265636569766564" + "00" * 94
GOLDEN_SECOND = (
    "6279746573" + "00" * 27 + "6279746573" + "00" * 11 + "01" + "42797465732068656c64" + "00" * 101
)
GOLDEN_STATE = (
    "0300000000000000 0500000000000000 0700000000000000 02000000 01000000 02000000 00000000"
    "0b00000000000000 f3ffffffffffffff 4b3f656d 00000000"
)
GOLDEN_IDENTITY = "02000000000000000600000092abc882706964003100"
GOLDEN_ROW = (
    "0807060504030201 0020000000000000 6400000000000000"  # version, bytes, points
    "0000000000000000 0000000000003440 0000000000003440 0000000000004440"  # box
    "0500000000000000 0600000000000000 0700000000000000"  # hits, last use, load
    "30303131323233333434353536366666"  # segment
    "02 00 0500 0600 0000"  # stale, id of 5, layer of 6
    "706f696e7473" + "00" * 34 + "612e706364" + "00" * 99 + "00000000 e415eb0e"
)
ROW = CellRow(
    "a.pcd", "points", 0x0102030405060708, "00112233445566ff", "stale", 8192, 100,
    (0.0, 20.0, 20.0, 40.0), 5, 6, 7,
)  # fmt: skip


def test_header() -> None:
    packed = layout.pack_header(layout.plan(TWO))
    assert packed == bytes.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND)
    assert layout.unpack_header(packed) == layout.plan(TWO)


def test_state() -> None:
    state = State(3, 5, 7, 2, 1, (11, -13))
    assert layout.pack_state(state, struct.Struct("<2q")) == bytes.fromhex(GOLDEN_STATE)
    assert layout.unpack_state(bytes.fromhex(GOLDEN_STATE)) == state


def test_identity() -> None:
    assert layout.pack_identity(2, b"pid\x001\x00", 64) == bytes.fromhex(GOLDEN_IDENTITY)
    assert layout.unpack_identity(bytes.fromhex(GOLDEN_IDENTITY) + bytes(42)) == (2, b"pid\x001\x00")


def test_row() -> None:
    assert layout.pack_row(ROW) == bytes.fromhex(GOLDEN_ROW)
    assert layout.unpack_row(memoryview(bytes.fromhex(GOLDEN_ROW))) == ROW


def test_a_torn_row_is_noticed() -> None:
    for at in range(256):
        torn = bytearray.fromhex(GOLDEN_ROW)
        torn[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            layout.unpack_row(memoryview(bytes(torn)))


def test_a_torn_state_is_noticed() -> None:
    for at in range(60):
        torn = bytearray.fromhex(GOLDEN_STATE)
        torn[at] ^= 1
        assert layout.unpack_state(bytes(torn)) is None


def test_a_damaged_header_is_refused() -> None:
    for at in [*range(64), *range(64, 384, 7)]:
        damaged = bytearray.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND)
        damaged[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            layout.unpack_header(bytes(damaged))


def test_states_never_written_are_left_out() -> None:
    assert layout.unpack_state(bytes(64)) is None
    assert layout.unpack_identity(bytes(64)) is None


def test_long_ids_keep_their_end_and_say_so() -> None:
    row = layout.unpack_row(
        memoryview(
            layout.pack_row(CellRow("ä" * 200 + "end", "l" * 90, 1, "0" * 16, "zombie", 1, 1, ROW.box))
        )
    )
    assert row is not None
    assert row.id_cut
    assert row.layer_cut
    assert row.id == "ä" * 50 + "end"
    assert row.layer == "l" * 40


def test_ids_that_are_no_utf8_survive() -> None:
    row = layout.unpack_row(
        memoryview(layout.pack_row(CellRow("\udcff.pcd", "points", 1, "", "resident", 1, 1, ROW.box)))
    )
    assert row is not None
    assert row.id == "\udcff.pcd"


def test_every_counter_fits_its_description() -> None:
    assert len({c.name for c in COUNTERS}) == len(COUNTERS)
    assert layout.unpack_header(layout.pack_header(layout.plan(COUNTERS))).counters == COUNTERS
