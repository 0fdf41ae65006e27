# SPDX-License-Identifier: Apache-2.0
"""Marks byte by byte, and what is no marks."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace

from shmmap.chunks.marks import Marks, decode_marks, encode_marks, marks_bytes
from shmmap.errors import BadRequest

MAP = bytes(range(16))
MARKS = Marks(
    keys=np.array([[-1, 0, 2], [3, 0, 0]], np.int32),
    hits=np.array([1, 0], np.uint32),
    misses=np.array([1, 2], np.uint32),
    bits=np.array([1, 1 << 63, 0x0102030405060708, 2], np.uint64),
    words=np.array([4095, 7, 1, 258], np.uint16),
)
GOLDEN = (
    "53484d4d41524b530100000004030201"  # SHMMARKS, 1.0, byte order
    "000102030405060708090a0b0c0d0e0f"  # the map
    "07000000020000002a00000000000000"  # mapper 7, 2 chunks, scan 42
    "04000000000000000000000000000000"  # 4 words
    "ffffffff0000000002000000010000000100000000000000"  # -1, 0, 2: a word of hits, one of misses
    "030000000000000000000000000000000200000000000000"  # 3, 0, 0: two of misses
    "0100000000000000000000000000008008070605040302010200000000000000"
    "ff0f070001000201"
)  # fmt: skip


def test_golden_bytes() -> None:
    data = encode_marks(MARKS, MAP, 7, 42)
    assert data.hex() == GOLDEN
    assert len(data) == marks_bytes(2, 4)


def test_there_and_back() -> None:
    marks = decode_marks(bytes.fromhex(GOLDEN), MAP, 7, 42)
    for name in marks.__struct_fields__:
        assert np.array_equal(getattr(marks, name), getattr(MARKS, name)), name
    assert marks.starts.tolist() == [0, 2, 4]
    assert [key.text for key in marks.chunks] == ["-1_0_2", "3_0_0"]


def test_a_scan_of_nothing() -> None:
    nothing = Marks(MARKS.keys[:0], MARKS.hits[:0], MARKS.misses[:0], MARKS.bits[:0], MARKS.words[:0])
    assert len(decode_marks(encode_marks(nothing, MAP, 1, 1), MAP, 1, 1).keys) == 0


def patched(at: int, form: str, *values: object) -> Callable[[bytearray], None]:
    return lambda data: struct.pack_into(form, data, at, *values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (patched(0, "<B", 0), "something else"),
        (patched(12, "<I", 0x04030201), "something else"),
        (patched(8, "<H", 2), r"version 2\.0"),
        (patched(16, "<B", 99), "not scan 42"),
        (patched(32, "<I", 8), "mapper 8"),
        (patched(40, "<Q", 43), "scan 43"),
        (patched(36, "<I", 4097), "4097 chunks"),
        (patched(36, "<I", 3), "not those of 3 chunks"),
        (patched(48, "<Q", 2**63), "bytes, not those"),
        (patched(48, "<Q", 5), "and 5 words"),
        (patched(64, "<i", 2**24), "further away"),
        (patched(64, "<i", -(2**31)), "further away"),
        (patched(64, "<3i", 3, 0, 0), "named twice"),
        (patched(76, "<I", 2), "more or fewer"),
        (patched(76, "<I", 2**32 - 1), "more or fewer"),
        (patched(144, "<H", 4096), "no place"),
        (patched(112, "<Q", 0), "no voxels"),
        (patched(148, "<H", 258), "rising order"),
    ],
)
def test_what_is_no_marks_is_refused(change: Callable[[bytearray], None], said: str) -> None:
    data = bytearray.fromhex(GOLDEN)
    change(data)
    with pytest.raises(BadRequest, match=said):
        decode_marks(bytes(data), MAP, 7, 42)


def test_every_truncation_is_refused() -> None:
    data = bytes.fromhex(GOLDEN)
    for size in range(len(data)):
        with pytest.raises(BadRequest):
            decode_marks(data[:size], MAP, 7, 42)
    with pytest.raises(BadRequest):
        decode_marks(data + b"\0", MAP, 7, 42)


def test_words_begin_again_with_each_list() -> None:
    """Rising within hits and within misses; nothing is said of one against the other."""
    marks = replace(MARKS, words=np.array([0, 0, 0, 1], np.uint16))
    assert decode_marks(encode_marks(marks, MAP, 7, 42), MAP, 7, 42).words.tolist() == [0, 0, 0, 1]
