# SPDX-License-Identifier: Apache-2.0
"""Keys in their order, by area, a part at a time: the same as sorting all of them each time."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.paging.key_index import EVERYWHERE, KeyIndex, KeyRange, merged_part

PART = st.integers(-3, 3)
KEY = st.builds(ChunkKey, PART, PART, PART)
RANGE = st.one_of(st.just(EVERYWHERE), st.tuples(KEY, KEY))


def whole(indexes: list[KeyIndex], within: KeyRange, most: int) -> list[ChunkKey]:
    """All parts, one after the other."""
    found: list[ChunkKey] = []
    after = None
    while True:
        keys, after = merged_part(indexes, after, within, most)
        assert all(key > found[-1] for key in keys[:1] if found)
        assert len(keys) <= most * len(indexes)
        found += keys
        if after is None:
            return found


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.tuples(st.booleans(), KEY), max_size=40), st.lists(KEY, max_size=20), RANGE, st.integers(1, 9)
)
def test_parts_are_what_a_sort_gives(
    changes: list[tuple[bool, ChunkKey]], others: list[ChunkKey], within: KeyRange, most: int
) -> None:
    one, two, keys = KeyIndex(), KeyIndex(others), set()
    for there, key in changes:
        if there:
            one.add(key)
            keys.add(key)
        else:
            one.discard(key)
            keys.discard(key)
    low, high = within

    def chosen(some: set[ChunkKey]) -> list[ChunkKey]:
        return sorted(key for key in some if all(a <= b <= c for a, b, c in zip(low, key, high, strict=True)))

    assert len(one) == len(keys)
    assert whole([one], within, most) == chosen(keys)
    assert whole([one, two], within, most) == chosen(keys | set(others))


def test_what_comes_between_two_parts_does_not_disturb() -> None:
    index = KeyIndex(ChunkKey(x, 0, 0) for x in range(10))
    keys, last = index.part(None, EVERYWHERE, 4)
    assert [key.x for key in keys] == [0, 1, 2, 3]
    assert last is not None
    index.discard(ChunkKey(1, 0, 0))
    index.add(ChunkKey(1, 5, 0))
    index.add(ChunkKey(0, 9, 0))
    rest, last = index.part(last, EVERYWHERE, 100)
    assert (last, rest[0]) == (None, ChunkKey(4, 0, 0))
    assert [key.x for key in rest] == list(range(4, 10))


@pytest.mark.parametrize("side", [10, 1000])
def test_a_part_costs_what_it_looks_at(side: int) -> None:
    """Not what there is: a small area in a large map takes as many looks as in a small one."""
    index = KeyIndex(ChunkKey(x, y, 0) for x in range(side) for y in range(10))
    found, last = index.part(None, (ChunkKey(4, 4, -9), ChunkKey(6, 6, 9)), 13)
    assert (len(found), last) == (9, None)
    empty, last = index.part(None, (ChunkKey(0, 50, 0), ChunkKey(10**6, 60, 0)), 5)
    assert empty == []
    assert last is not None, "columns in which there is nothing are looked at, too"
