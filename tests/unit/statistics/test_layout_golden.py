# SPDX-License-Identifier: Apache-2.0
"""The statistics layout, byte by byte, against hex written down."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import msgspec
import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.protocol.rows import CellRow, ClientRow, LiveMapRow, Window
from shmmap.statistics import layout
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS, Counter
from shmmap.statistics.layout import State
from shmmap.statistics.rows import FREE_ROW, pack_row, unpack_row
from tests.support.message_pack import pack

TWO = (
    Counter("requests", "counter", "", "Requests received"),
    Counter("bytes", "gauge", "bytes", "Bytes held"),
)
LOAD = (Counter("load", "histogram", "ns", "How long"),)
GOLDEN_START = (
    "53484d5354415401 0200 0000 04030201"  # magic, 2.0, byte order
    "80000000 02000000 a0000000"  # descriptions at 128: 2 of 160 bytes
    "80020000 00400000"  # identity at 640, 16384 bytes each
    "80820000 80040000"  # state at 33408, 1152 bytes each
    "808b0000 00900200 00010000 00000200"  # table 35712, rows at 167936 of 256, at most 131072
    "cc154863"
    "01000000 82000000 00900000 00010000 00010000"  # 1 histogram of 130; clients at 36864, 256 of 256
    "c08b0000 00900100 00040000 40000000"
    + "00" * 24
    + "26ff5804"  # changes at 35776; live at 102400, 64 of 1024
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
GOLDEN_IDENTITY = "02000000000000000600000092abc882706964003100"
CELL = CellRow(
    "a.pcd",
    "points",
    0x0102030405060708,
    "00112233445566ff",
    "stale",
    8192,
    100,
    (0.0, 20.0, 20.0, 40.0),
    5,
    6,
    7,
)
CLIENT = ClientRow(
    0x0102030405060708, 77, -1, 9, "vé", "python3", 3, 4096, 9, 6, (1.5, -2.5), 0.5,
    Window("square", 1.0, 2.0, 40.0, 41.0),
)  # fmt: skip
LIVE = LiveMapRow(
    "lidär", "/m", 0.5, "map", 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, ("x.chunk: torn",), ("0/front",),
    "disk full", 2**62, 13, ((14, 15),), 1, 1,
)  # fmt: skip
ROWS: list[tuple[Any, int, str]] = [
    (
        CELL,
        layout.CELL_ROW_BYTES,
        (
            "5c000000 5bcf6a95 9d"  # length, checksum, an array of 13
            "a5612e706364 a6706f696e7473 cf0102030405060708"  # id, layer, version
            "b030303131323233333434353536366666 a57374616c65"  # segment, state
            "cd2000 64"  # bytes, points
            "94cb0000000000000000cb4034000000000000cb4034000000000000cb4044000000000000"  # box
            "05 06 07 c2 90"  # hits, last use, load, not ahead, no holders
        ),
    ),
    (
        CLIENT,
        layout.CLIENT_ROW_BYTES,
        (
            "6c000000 da78a8a6 dc0010"
            "cf0102030405060708 4d ff 09 a376c3a9 a7707974686f6e33"  # session, pid, uid, gid, client, command
            "03 cd1000 09 06"  # cells, bytes, requests, last request
            "92cb3ff8000000000000cbc004000000000000 cb3fe0000000000000"  # pose, heading
            "95a6737175617265cb3ff0000000000000cb4000000000000000cb4044000000000000cb4044800000000000"
            "00 00 00"
        ),
    ),
    (
        LIVE,
        layout.LIVE_ROW_BYTES,
        (
            "58000000 b5aa7ca9 dc0018"
            "a66c6964c3a472 a22f6d cb3fe0000000000000 a36d6170"  # name, path, resolution, frame
            "01 02 03 04 05 06 07 08 09 0a 0b 0c"
            "91ad782e6368756e6b3a20746f726e 91a7302f66726f6e74"  # damaged, mappers
            "a96469736b2066756c6c cf4000000000000000 0d 91920e0f 01 01"  # problem, change, readers, counts
        ),
    ),
]


def test_header() -> None:
    packed = layout.pack_header(layout.plan(TWO, LOAD))
    assert packed == bytes.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND + GOLDEN_THIRD)
    assert layout.unpack_header(packed) == layout.plan(TWO, LOAD)


@pytest.mark.parametrize(
    ("version", "what"),
    [
        ((1, 0), "statistics 1.0 of an older daemon"),
        ((1, 5), "statistics 1.5 of an older daemon"),
        ((3, 1), "statistics 3.1 of a newer daemon"),
    ],
)
def test_another_major_version_is_named(version: tuple[int, int], what: str) -> None:
    other = bytes.fromhex(GOLDEN_START)[:8] + struct.pack("<HH", *version) + bytes(500)
    with pytest.raises(SegmentCorrupt, match=rf"{what}: this program reads 2\.x") as refused:
        layout.unpack_header(other)
    assert refused.value.hint == f"update the {'program' if version > (2,) else 'daemon'}, and restart it"


def test_state() -> None:
    state = State(3, 5, 7, 2, 1, (11, -13), 4, (17, 19))
    assert layout.pack_state(state, struct.Struct("<2q")) == bytes.fromhex(GOLDEN_STATE)
    seen = layout.unpack_state(bytes.fromhex(GOLDEN_STATE))
    assert seen is not None
    assert seen._replace(histograms=tuple(seen.histograms)) == state


def framed(elements: list[object]) -> bytes:
    """Return a row as the page has it."""
    data = pack(elements)
    length = struct.pack("<I", len(data))
    return length + struct.pack("<I", zlib.crc32(length + data)) + data


@pytest.mark.parametrize(("row", "size", "golden"), ROWS, ids=["cell", "client", "live"])
def test_rows(row: Any, size: int, golden: str) -> None:
    data = bytes.fromhex(golden)
    elements = msgspec.to_builtins(row)
    assert pack_row(row, size) == data
    assert data[8:] == pack(elements)
    assert unpack_row(type(row), memoryview(data + b"left from a longer row")) == row
    assert unpack_row(type(row), memoryview(FREE_ROW + data[8:])) is None
    for at in range(len(data)):
        torn = bytearray(data)
        torn[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            unpack_row(type(row), memoryview(bytes(torn)))
    assert unpack_row(type(row), memoryview(framed([*elements, "later"]))) == row
    with pytest.raises(SegmentCorrupt, match="does not decode"):
        unpack_row(type(row), memoryview(framed(elements[1:])))


def test_identity() -> None:
    assert layout.pack_identity(2, b"pid\x001\x00", 64) == bytes.fromhex(GOLDEN_IDENTITY)
    assert layout.unpack_identity(bytes.fromhex(GOLDEN_IDENTITY) + bytes(42)) == (2, b"pid\x001\x00")


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


@pytest.mark.parametrize(
    ("row", "size", "shown"),
    [
        (
            msgspec.structs.replace(CELL, id="ä" * 200 + "end", layer="l" * 90),
            layout.CELL_ROW_BYTES,
            {"id": "…" + "ä" * 48 + "end", "layer": "l" * 60 + "…"},
        ),
        (msgspec.structs.replace(CELL, layer="ä" * 60), layout.CELL_ROW_BYTES, {"layer": "ä" * 60}),
        (msgspec.structs.replace(CELL, id="\udcff.pcd"), layout.CELL_ROW_BYTES, {"id": "\\udcff.pcd"}),
        (
            msgspec.structs.replace(CLIENT, client="ä" * 200, uid=2**32 - 2, pid=2**31 - 1),
            layout.CLIENT_ROW_BYTES,
            {"client": "ä" * 65 + "…"},
        ),
        (
            msgspec.structs.replace(LIVE, damaged=("x" * 100,) * 64, damaged_count=99, mappers=("m" * 60,)),
            layout.LIVE_ROW_BYTES,
            {"damaged": (), "mappers": ()},
        ),
        (
            msgspec.structs.replace(LIVE, path="/" + "d" * 3000, problem="p" * 3000),
            layout.LIVE_ROW_BYTES,
            {"damaged": (), "mappers": (), "path": "…" + "d" * 200, "problem": "p" * 752 + "…"},
        ),
    ],
)
def test_what_is_too_long_is_cut(row: Any, size: int, shown: dict[str, object]) -> None:
    """A cell keeps the end of its id, a live map the numbers of what is not listed."""
    data = pack_row(row, size)
    assert len(data) <= size
    assert unpack_row(type(row), memoryview(data)) == msgspec.structs.replace(row, **shown)


def test_every_counter_fits_its_description() -> None:
    assert len({c.name for c in (*COUNTERS, *HISTOGRAMS)}) == len(COUNTERS) + len(HISTOGRAMS)
    header = layout.unpack_header(layout.pack_header(layout.plan(COUNTERS, HISTOGRAMS)))
    assert (header.counters, header.histograms) == (COUNTERS, HISTOGRAMS)
