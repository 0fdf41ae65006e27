# SPDX-License-Identifier: Apache-2.0
"""LZF against an encoder and a decoder written from the format's description."""

from __future__ import annotations

import random
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.formats import lzf
from tests.support.pcd_bytes import lzf_decode, lzf_encode

PLAIN = [
    b"a",
    b"aa",
    b"abc" * 5,
    bytes(1000),
    bytes(range(256)) * 40,
    random.Random(1).randbytes(5000),  # does not shrink
    b"x" * 31 + b"y",
    b"ab" + bytes(9000) + b"ab",
]


def decompressed(data: bytes, size: int) -> bytes | None:
    output = np.zeros(size, np.uint8)
    return output.tobytes() if lzf.decompress(np.frombuffer(data, np.uint8), output) else None


@pytest.mark.parametrize("plain", PLAIN, ids=range(len(PLAIN)))
def test_both_directions_agree_with_the_description(plain: bytes) -> None:
    assert decompressed(lzf_encode(plain), len(plain)) == plain
    assert lzf_decode(lzf.compress(plain)) == plain
    assert lzf.first_error(lzf_encode(plain), len(plain)) is None


@given(st.binary(max_size=300), st.integers(1, 400))
def test_any_stream_decodes_as_described_or_is_refused(data: bytes, size: int) -> None:
    try:
        expected = lzf_decode(data)
    except (ValueError, IndexError):
        expected = None
    sound = expected is not None and len(expected) == size
    assert decompressed(data, size) == (expected if sound else None)
    assert (lzf.first_error(data, size) is None) == sound


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=20), st.integers(1, 60)), max_size=12))
def test_repetitive_data_round_trips(parts: list[tuple[bytes, int]]) -> None:
    plain = b"".join(part * times for part, times in parts)
    assert lzf_decode(lzf.compress(plain)) == plain
    if plain:
        assert decompressed(lzf.compress(plain), len(plain)) == plain


def test_the_fallback_through_the_module_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lzf, "_native", lambda: None)
    for plain in PLAIN:
        packed = lzf_encode(plain)
        assert decompressed(packed, len(plain)) == plain
        assert decompressed(packed, len(plain) + 1) is None
        assert decompressed(packed[:-1], len(plain)) is None


def test_empty() -> None:
    assert lzf.compress(b"") == b""
    assert decompressed(b"", 0) == b""
    assert decompressed(b"\0a", 0) is None
    assert decompressed(b"", 1) is None


def test_an_impossible_ratio_is_refused_without_trying() -> None:
    output = np.empty(89 * 1000, np.uint8)
    assert not lzf.decompress(np.zeros(1000, np.uint8), output)


def test_a_large_bad_stream_leaves_its_output_untouched() -> None:
    """Highly compressed zeros, with a reference before the start at the very end."""
    packed = b"\x00\x00" + b"\xe0\xff\x00" * (70 * 1024 * 1024 // 264) + b"\xff\xff\xff"
    made = 1 + 264 * ((len(packed) - 5) // 3) + 264
    output = np.full(made, 7, np.uint8)
    bad = packed[:2] + b"\xff\xff\xff" + packed[5:]
    assert lzf.first_error(bad, made) == 2
    tracemalloc.start()
    assert not lzf.decompress(np.frombuffer(bad, np.uint8), output)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20
    assert output[0] == 7
    assert lzf.decompress(np.frombuffer(packed[:-3] + b"\xe0\xff\x00", np.uint8), output)
    assert not output.any()
