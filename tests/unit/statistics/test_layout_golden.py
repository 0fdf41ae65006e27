# SPDX-License-Identifier: Apache-2.0
"""The statistics layout, byte by byte, against hex written down."""

from __future__ import annotations

import dataclasses
import struct

import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.statistics import layout
from shmmap.statistics.cell_rows import CellRow, pack_cell, unpack_cell
from shmmap.statistics.client_rows import ClientRow, Window, pack_client, unpack_client
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS, Counter
from shmmap.statistics.layout import State
from shmmap.statistics.live_rows import LiveRow, pack_live, unpack_live

TWO = (
    Counter("requests", "counter", "", "Requests received"),
    Counter("bytes", "gauge", "bytes", "Bytes held"),
)
LOAD = (Counter("load", "histogram", "ns", "How long"),)
GOLDEN_START = (
    "53484d5354415401 0100 0500 04030201"  # magic, 1.5, byte order
    "80000000 02000000 a0000000"  # descriptions at 128: 2 of 160 bytes
    "80020000 00400000"  # identity at 640, 16384 bytes each
    "80820000 80040000"  # state at 33408, 1152 bytes each
    "808b0000 00100200 00010000 00000200"  # table 35712, rows at 135168 of 256, at most 131072
    "b223c556"
    "01000000 82000000 00900000 00010000 00010000"  # 1 histogram of 130; clients at 36864, 256 of 256
    "c08b0000 00900100 00020000 40000000"
    + "00" * 24
    + "ed8068a8"  # changes at 35776; live at 102400, 64 of 512
)
GOLDEN_FIRST = "7265717565737473" + "00" * 40 + "00" + "5265717565737473207265636569766564" + "00" * 94
GOLDEN_SECOND = (
    "6279746573" + "00" * 27 + "6279746573" + "00" * 11 + "01" + "42797465732068656c64" + "00" * 101
)
GOLDEN_THIRD = "6c6f6164" + "00" * 28 + "6e73" + "00" * 14 + "02" + "486f77206c6f6e67" + "00" * 103
GOLDEN_STATE = (
    "0300000000000000 0500000000000000 0700000000000000 02000000 01000000 02000000 00000000"
    "0b00000000000000 f3ffffffffffffff 4b3f656d 00000000"
    "04000000 02000000 1100000000000000 1300000000000000 b924b90000000000"
)
GOLDEN_CLIENT = (
    "0807060504030201 4d000000 ffffffff"  # session, pid, uid
    "0300000000000000 0010000000000000 0900000000000000 0600000000000000"  # cells, bytes, requests, last
    "000000000000f83f 00000000000004c0 000000000000e03f"  # pose, heading
    "000000000000f03f 0000000000000040 0000000000004440 0000000000804440"  # window
    "02 03 0000 00000000 76c3a9" + "00" * 45 + "707974686f6e33" + "00" * 9 + "00" * 76 + "f84f0e29"
)
CLIENT = ClientRow(
    0x0102030405060708, 77, -1, 3, 4096, 9, 6, "vé", "python3",
    (1.5, -2.5), 0.5, Window("square", 1.0, 2.0, 40.0, 41.0),
)  # fmt: skip
GOLDEN_LIVE = (
    "6c6964c3a472" + "00" * 58 + "6469736b2066756c6c" + "00" * 247  # name, problem
    + "".join(f"{number:02x}" + "00" * 7 for number in range(1, 17))
    + "00" * 7 + "40" + "00" * 52 + "498faf27"
)  # fmt: skip
LIVE = LiveRow._make(("lidär", "disk full", *range(1, 17), 2**62))
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
    packed = layout.pack_header(layout.plan(TWO, LOAD))
    assert packed == bytes.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND + GOLDEN_THIRD)
    assert layout.unpack_header(packed) == layout.plan(TWO, LOAD)


def test_a_header_of_layout_1_0_is_read() -> None:
    """It ends with the counters; no histograms, no clients."""
    old = bytes.fromhex(
        "53484d5354415401 0100 0000 04030201 40000000 02000000 a0000000 80010000 00400000"
        "80810000 40000000 00820000 00900000 00010000 00000200 fedf4f8f" + GOLDEN_FIRST + GOLDEN_SECOND
    )
    header = layout.unpack_header(old + bytes(64))
    assert header == layout.Header(TWO, 384, 16384, 33152, 64, 33280, 36864, 256, 131072)
    state = bytes.fromhex(GOLDEN_STATE)[:64]
    assert layout.unpack_state(state, extended=False) == State(3, 5, 7, 2, 1, (11, -13))


def test_state() -> None:
    state = State(3, 5, 7, 2, 1, (11, -13), 4, (17, 19))
    assert layout.pack_state(state, struct.Struct("<2q")) == bytes.fromhex(GOLDEN_STATE)
    seen = layout.unpack_state(bytes.fromhex(GOLDEN_STATE))
    assert seen is not None
    assert seen._replace(histograms=tuple(seen.histograms)) == state


def test_client() -> None:
    assert pack_client(CLIENT) == bytes.fromhex(GOLDEN_CLIENT)
    assert unpack_client(bytes.fromhex(GOLDEN_CLIENT)) == CLIENT
    assert unpack_client(pack_client(None)) is None
    bare = ClientRow(1, 0, -1, 0, 0, 0, 0, "ä" * 30, "c" * 20)
    assert unpack_client(pack_client(bare)) == bare._replace(client="ä" * 24, command="c" * 16)
    far = bare._replace(client="", command="", uid=2**32 - 2)  # a user id may have all 32 bits
    assert unpack_client(pack_client(far)) == far
    for at in range(256):
        torn = bytearray.fromhex(GOLDEN_CLIENT)
        torn[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            unpack_client(bytes(torn))


def test_live_map() -> None:
    assert pack_live(LIVE) == bytes.fromhex(GOLDEN_LIVE)
    assert unpack_live(bytes.fromhex(GOLDEN_LIVE)) == LIVE
    assert unpack_live(bytes(512)) is None
    assert unpack_live(pack_live(LIVE._replace(problem="ä" * 200))) == LIVE._replace(problem="ä" * 128)
    assert LIVE.states == {"loading": 4, "clean": 0, "dirty": 5, "saving": 6}
    for at in range(512):
        torn = bytearray.fromhex(GOLDEN_LIVE)
        torn[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            unpack_live(bytes(torn))


def test_identity() -> None:
    assert layout.pack_identity(2, b"pid\x001\x00", 64) == bytes.fromhex(GOLDEN_IDENTITY)
    assert layout.unpack_identity(bytes.fromhex(GOLDEN_IDENTITY) + bytes(42)) == (2, b"pid\x001\x00")


def test_row() -> None:
    assert pack_cell(ROW) == bytes.fromhex(GOLDEN_ROW)
    assert unpack_cell(memoryview(bytes.fromhex(GOLDEN_ROW))) == ROW


def test_a_row_of_what_nobody_has_asked_for_yet() -> None:
    """Its flag is the third bit; a reader of layout 1.3 takes it for any resident one."""
    packed = pack_cell(dataclasses.replace(ROW, state="resident", ahead=True))
    assert packed[96:98] == bytes([1, 4])
    row = unpack_cell(memoryview(packed))
    assert row is not None
    assert (row.state, row.ahead, row.id_cut, row.layer_cut) == ("resident", True, False, False)


def test_a_torn_row_is_noticed() -> None:
    for at in range(256):
        torn = bytearray.fromhex(GOLDEN_ROW)
        torn[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            unpack_cell(memoryview(bytes(torn)))


def test_a_torn_state_is_noticed() -> None:
    for at in [*range(60), *range(64, 92)]:
        torn = bytearray.fromhex(GOLDEN_STATE)
        torn[at] ^= 1
        assert layout.unpack_state(bytes(torn)) is None


def test_a_damaged_header_is_refused() -> None:
    for at in [*range(128), *range(128, 608, 7)]:
        damaged = bytearray.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND + GOLDEN_THIRD)
        damaged[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            layout.unpack_header(bytes(damaged))


def test_states_never_written_are_left_out() -> None:
    assert layout.unpack_state(bytes(64)) is None
    assert layout.unpack_identity(bytes(64)) is None


def test_long_ids_keep_their_end_and_say_so() -> None:
    row = unpack_cell(
        memoryview(pack_cell(CellRow("ä" * 200 + "end", "l" * 90, 1, "0" * 16, "zombie", 1, 1, ROW.box)))
    )
    assert row is not None
    assert row.id_cut
    assert row.layer_cut
    assert row.id == "ä" * 50 + "end"
    assert row.layer == "l" * 40


@pytest.mark.parametrize(
    "layer", ["ndt(leaf=2.0,min_points=6,regularization=0.01)", "l" * 135, "ä" * 67, "l" * 40]
)
def test_a_long_layer_is_whole_where_the_row_has_room(layer: str) -> None:
    """What its field lacks lies behind the id."""
    row = unpack_cell(
        memoryview(pack_cell(CellRow("20_0.pcd", layer, 1, "0" * 16, "resident", 1, 1, ROW.box)))
    )
    assert row is not None
    assert (row.id, row.layer, row.layer_cut, row.whole_layer) == ("20_0.pcd", layer, False, layer)
    wide = unpack_cell(
        memoryview(pack_cell(CellRow("x" * 100, layer, 1, "0" * 16, "resident", 1, 1, ROW.box)))
    )
    assert wide is not None
    assert wide.id == "x" * 100
    assert wide.layer_cut == (len(layer.encode()) > 44)
    assert wide.whole_layer == layer or (
        wide.whole_layer == wide.layer + "…" and layer.startswith(wide.layer)
    )


def test_ids_that_are_no_utf8_survive() -> None:
    row = unpack_cell(
        memoryview(pack_cell(CellRow("\udcff.pcd", "points", 1, "", "resident", 1, 1, ROW.box)))
    )
    assert row is not None
    assert row.id == "\udcff.pcd"


def test_every_counter_fits_its_description() -> None:
    assert len({c.name for c in (*COUNTERS, *HISTOGRAMS)}) == len(COUNTERS) + len(HISTOGRAMS)
    header = layout.unpack_header(layout.pack_header(layout.plan(COUNTERS, HISTOGRAMS)))
    assert (header.counters, header.histograms) == (COUNTERS, HISTOGRAMS)
