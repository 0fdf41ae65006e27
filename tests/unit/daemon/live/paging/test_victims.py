# SPDX-License-Identifier: Apache-2.0
"""Chunks that are given up come one after the other, and none is forgotten."""

from __future__ import annotations

import pytest

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.paging.records import Chunk, State
from shmmap.daemon.live.paging.victims import REVIEW_S, REVIEWED_OF_NEWS, Victims

MANY = 3 * REVIEWED_OF_NEWS


@pytest.fixture
def chunks() -> dict[ChunkKey, Chunk]:
    """Chunks that everybody wants, and in a better time nobody gives up."""
    keys = [ChunkKey(number, 0, 0) for number in range(MANY)]
    return {key: Chunk(key, State.CLEAN, active=key.x) for key in keys}


@pytest.fixture
def victims(chunks: dict[ChunkKey, Chunk]) -> Victims:
    def may_go(chunk: Chunk, now_s: float, *, short: bool) -> bool:
        del now_s
        return short or chunk.active == 0

    return Victims(chunks, may_go, lambda chunk, _: chunk.active)


def test_what_was_found_is_kept_while_memory_suffices(
    victims: Victims, chunks: dict[ChunkKey, Chunk]
) -> None:
    for active in range(MANY - 1, 1, -1):
        chunk = victims.next(State.CLEAN, 1.0, short=True, idle=False)
        assert chunk is not None
        assert chunk.active == active
        del chunks[chunk.key]
        assert victims.next(State.CLEAN, 1.0, short=False, idle=False) is None


def test_when_memory_suffices_only_what_nobody_wants_goes(victims: Victims) -> None:
    assert victims.next(State.CLEAN, 1.0, short=True, idle=False) is not None
    assert victims.next(State.CLEAN, 1.0, short=False, idle=False) is None
    chunk = victims.next(State.CLEAN, 1.0 + REVIEW_S, short=False, idle=False)
    assert chunk is not None
    assert chunk.active == 0


def test_where_nothing_else_goes_on_whatever_is_new_is_looked_at(
    victims: Victims, chunks: dict[ChunkKey, Chunk]
) -> None:
    """Else nothing would happen until the next time that all are gone over."""
    for chunk in chunks.values():
        chunk.state = State.LOADING
    assert victims.next(State.CLEAN, 1.0, short=True, idle=True) is None
    loaded = chunks[ChunkKey(5, 0, 0)]
    loaded.state = State.CLEAN
    victims.news += 1
    assert victims.next(State.CLEAN, 1.0, short=True, idle=False) is None
    assert victims.next(State.CLEAN, 1.0, short=True, idle=True) is loaded
