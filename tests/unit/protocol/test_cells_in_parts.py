# SPDX-License-Identifier: Apache-2.0
"""Replies put together from handles encoded earlier are byte for byte what encoding them at once gives."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.protocol.codec import PackedArray, decode_reply, encode, encode_cells, encode_handle
from shmmap.protocol.messages import Cells, FailedCell, Handle, Holder, PendingCell

numbers = st.integers(0, (1 << 64) - 1)
small = st.integers(0, 1 << 40)
texts = st.text(st.characters(codec="utf-8"), max_size=40)
floats = st.floats(allow_nan=False)

handles = st.builds(
    Handle, texts, numbers, texts, texts, small, small, small, floats, floats, floats, floats, st.booleans()
)
holders = st.builds(Holder, numbers, small, st.integers(-1, 1 << 32), texts, small, small)
failed = st.builds(FailedCell, texts, texts, texts, texts, st.lists(holders, max_size=3).map(tuple))


@settings(max_examples=200, deadline=None)
@given(
    st.tuples(numbers, numbers, numbers),
    st.lists(handles, max_size=20),
    st.lists(texts, max_size=20),
    st.binary(max_size=80),
    st.lists(st.builds(PendingCell, texts, texts), max_size=20),
    st.lists(failed, max_size=20),
    st.lists(texts, max_size=3),
    st.booleans(),
)
def test_any_content(
    ids: tuple[int, int, int],
    cells: list[Handle],
    removed: list[str],
    packed: bytes,
    pending: list[PendingCell],
    failures: list[FailedCell],
    layers: list[str],
    covered: bool,
) -> None:
    whole = Cells(
        *ids, tuple(cells), tuple(removed), packed, tuple(pending), tuple(failures), tuple(layers), covered
    )
    halves = PackedArray(failures[:7])
    halves.add(failures[7:])
    parts = encode_cells(
        *ids, [encode_handle(h) for h in cells], tuple(removed), packed,
        tuple(layers), covered, PackedArray(pending), halves,
    )  # fmt: skip
    assert parts == encode(whole)
    assert decode_reply(parts) == whole


@pytest.mark.parametrize("count", [0, 1, 15, 16, 255, 256, 65535, 65536, 70000])
def test_any_number_of_handles(count: int) -> None:
    """The head of a MessagePack array has one byte, three or five."""
    handle = Handle("a.pcd", 1, "points", "0" * 16, 0, 4096, 10, 0.0, 0.0, 20.0, 20.0)
    parts = encode_cells(1, 2, 3, [encode_handle(handle)] * count, (), b"", ())
    assert parts == encode(Cells(1, 2, 3, (handle,) * count))


@pytest.mark.parametrize("count", [0, 15, 16, 65535, 65536])
def test_any_number_of_removed_ids(count: int) -> None:
    removed = ("x",) * count
    assert encode_cells(1, 2, 3, [], removed, b"", ()) == encode(Cells(1, 2, 3, (), removed))
    assert encode_cells(1, 2, 3, [], (), bytes(count), ()) == encode(Cells(1, 2, 3, (), (), bytes(count)))


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 65535, 65536])
@pytest.mark.parametrize("at_once", [1, 16, 64])
def test_an_array_in_parts(count: int, at_once: int) -> None:
    array = PackedArray()
    for begin in range(0, count, at_once):
        array.add([begin] * min(at_once, count - begin))
    whole = [number // at_once * at_once for number in range(count)]
    assert bytes(array) == encode(whole)
