# SPDX-License-Identifier: Apache-2.0
"""LZF against an encoder and a decoder written from the format's description."""

from __future__ import annotations

import random
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.errors import MapDataError
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.reader import PcdReader
from tests.support.cloud_bytes import Field, column, header, lzf_decode, lzf_encode

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


@pytest.mark.slow
@pytest.mark.parametrize("bad_at", ["start", "end"])
def test_a_large_bad_stream_is_refused_before_its_output_exists(tmp_path: Path, bad_at: str) -> None:
    """A megabyte that claims 79 MB of zeros, with a reference before the start."""
    runs = 300_000
    plain = 1 + 264 * runs
    good = b"\x00\x00" + b"\xe0\xff\x00" * runs
    assert lzf.first_error(good, plain) is None
    bad = good[:2] + b"\xff\xff\xff" + good[5:] if bad_at == "start" else good[:-1]
    fields = [*(column(name, "F4", []) for name in "xyz"), Field("w", "U", 1, (), plain % 12 + 12)]
    points = plain // (12 + fields[3].count)
    size = points * (12 + fields[3].count)
    change: dict[str, str | None] = {"POINTS": str(points), "WIDTH": str(points)}
    for packed in (bad, good[: 2 + 3 * (size // 264)]):
        path = tmp_path / "cloud.pcd"
        head = header(fields, "binary_compressed", change=change)
        path.write_bytes(head + struct.pack("<II", len(packed), size) + packed)
        tracemalloc.start()
        with PcdReader(path) as reader, pytest.raises(MapDataError) as caught:
            next(reader.blocks())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert caught.value.cause == "bad_lzf"
        assert peak < 10 << 20


def test_a_large_sound_stream_is_read(tmp_path: Path) -> None:
    runs = 300_000
    size = 264 * runs
    packed = b"\x00\x00" + b"\xe0\xff\x00" * (runs - 1) + b"\xe0\xfe\x00"
    fields = [column(name, "F8", []) for name in "xyz"]
    points = size // 24
    change: dict[str, str | None] = {"POINTS": str(points), "WIDTH": str(points)}
    path = tmp_path / "cloud.pcd"
    head = header(fields, "binary_compressed", change=change)
    path.write_bytes(head + struct.pack("<II", len(packed), size) + packed)
    with PcdReader(path) as reader:
        assert (
            sum(len(block[0]) - np.count_nonzero(block[0].any(axis=1)) for block in reader.blocks()) == points
        )
