# SPDX-License-Identifier: Apache-2.0
"""The statistics layout, byte by byte, against hex written down."""

from __future__ import annotations

import struct

import pytest

from shmmap.errors import SegmentCorrupt
from shmmap.statistics import layout
from shmmap.statistics.counters import COUNTERS, HISTOGRAMS, Counter
from shmmap.statistics.layout import State

TWO = (
    Counter("requests", "counter", "", "Requests received"),
    Counter("bytes", "gauge", "bytes", "Bytes held"),
)
LOAD = (Counter("load", "histogram", "ns", "How long"),)
GOLDEN_START = (
    "53484d5354415401 0300 0000 04030201"  # magic, 3.0, byte order
    "40000000 a0000000 02000000 01000000"  # descriptions at 64, of 160 bytes: 2 counters, 1 histogram
    "40020000 00400000"  # identity at 576, 16384 bytes each
    "40820000 80040000"  # state at 33344, 1152 bytes each
    "408b0000 82000000 00000000"  # change counter at 35648, 130 buckets
    "03c4ddcb"
)
GOLDEN_FIRST = "7265717565737473" + "00" * 40 + "00" + "5265717565737473207265636569766564" + "00" * 94
GOLDEN_SECOND = (
    "6279746573" + "00" * 27 + "6279746573" + "00" * 11 + "01" + "42797465732068656c64" + "00" * 101
)
GOLDEN_THIRD = "6c6f6164" + "00" * 28 + "6e73" + "00" * 14 + "02" + "486f77206c6f6e67" + "00" * 103
GOLDEN_STATE = (
    "0300000000000000 0500000000000000 0700000000000000 02000000 02000000"
    "0b00000000000000 f3ffffffffffffff 1100000000000000 1300000000000000 93127017"
)
GOLDEN_IDENTITY = "02000000000000000600000092abc882706964003100"


def test_header() -> None:
    packed = layout.pack_header(layout.plan(TWO, LOAD))
    assert packed == bytes.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND + GOLDEN_THIRD)
    assert layout.unpack_header(packed) == layout.plan(TWO, LOAD)


@pytest.mark.parametrize(
    ("version", "what"),
    [
        ((1, 0), "statistics 1.0 of an older daemon"),
        ((1, 5), "statistics 1.5 of an older daemon"),
        ((2, 0), "statistics 2.0 of an older daemon"),
        ((4, 1), "statistics 4.1 of a newer daemon"),
    ],
)
def test_another_major_version_is_named(version: tuple[int, int], what: str) -> None:
    other = bytes.fromhex(GOLDEN_START)[:8] + struct.pack("<HH", *version) + bytes(500)
    with pytest.raises(SegmentCorrupt, match=rf"{what}: this program reads 3\.x") as refused:
        layout.unpack_header(other)
    assert refused.value.hint == f"update the {'program' if version > (3, 0) else 'daemon'}, and restart it"


def test_state() -> None:
    state = State(3, 5, 7, (11, -13), (17, 19))
    assert layout.pack_state(state, struct.Struct("<4q")) == bytes.fromhex(GOLDEN_STATE)
    seen = layout.unpack_state(bytes.fromhex(GOLDEN_STATE))
    assert seen is not None
    assert seen._replace(histograms=tuple(seen.histograms)) == state


def test_identity() -> None:
    assert layout.pack_identity(2, b"pid\x001\x00", 64) == bytes.fromhex(GOLDEN_IDENTITY)
    assert layout.unpack_identity(bytes.fromhex(GOLDEN_IDENTITY) + bytes(42)) == (2, b"pid\x001\x00")


def test_a_torn_state_is_noticed() -> None:
    for at in range(68):
        torn = bytearray.fromhex(GOLDEN_STATE)
        torn[at] ^= 1
        assert layout.unpack_state(bytes(torn)) is None


def test_a_damaged_header_is_refused() -> None:
    for at in [*range(64), *range(64, 544, 7)]:
        damaged = bytearray.fromhex(GOLDEN_START + GOLDEN_FIRST + GOLDEN_SECOND + GOLDEN_THIRD)
        damaged[at] ^= 1
        with pytest.raises(SegmentCorrupt):
            layout.unpack_header(bytes(damaged))


def test_every_counter_fits_its_description() -> None:
    assert len({c.name for c in (*COUNTERS, *HISTOGRAMS)}) == len(COUNTERS) + len(HISTOGRAMS)
    header = layout.unpack_header(layout.pack_header(layout.plan(COUNTERS, HISTOGRAMS)))
    assert (header.counters, header.histograms) == (COUNTERS, HISTOGRAMS)
