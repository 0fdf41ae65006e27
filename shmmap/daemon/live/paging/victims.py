# SPDX-License-Identifier: Apache-2.0
"""Which chunks are given up next: all are gone over seldom, and then come one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.paging.records import Chunk, State

__all__ = ["REVIEW_S", "Victims"]

REVIEW_S: Final = 0.1
"""How often, at most, all chunks are gone over for what may be given up; 30 000 take 30 ms."""
REVIEWED_OF_NEWS: Final = 32
"""Where memory is short, they are also gone over when one in so many came or changed since."""


class _MayGo(Protocol):
    def __call__(self, chunk: Chunk, now_s: float, *, short: bool) -> bool:
        """Whether a chunk may be given up; where memory is ``short``, also one that somebody wants."""


class Victims:
    """Those of one map.

    Parameters
    ----------
    chunks
        All that there are.
    may_go, leaves_last
        Whether a chunk may be given up; how late, as something to sort by: the greatest is given up first.

    Attributes
    ----------
    news
        How much came, changed or was saved since all chunks were gone over.
    """

    def __init__(
        self,
        chunks: Mapping[ChunkKey, Chunk],
        may_go: _MayGo,
        leaves_last: Callable[[Chunk, float], Any],
    ) -> None:
        self._chunks, self._may_go, self._leaves_last = chunks, may_go, leaves_last
        self._found: dict[State, list[Chunk]] = {State.CLEAN: [], State.DIRTY: []}  # the first last
        self._review_s = -math.inf
        self._reviewed_short = False
        self.news = 0

    def look_again(self) -> None:
        """Other chunks may be wanted now."""
        self._review_s = -math.inf

    def saved(self, chunk: Chunk) -> None:
        """A chunk that was saved to be given up is clean."""
        self._found[State.CLEAN].append(chunk)

    def next(self, state: State, now_s: float, *, short: bool, idle: bool) -> Chunk | None:
        """The next of these, clean or dirty, if there is one; ``idle``: nothing goes on but this."""
        if self._is_review_due(now_s, short=short, idle=idle):
            self._review(now_s, short=short)
        left = self._found[state]
        while left:
            chunk = left.pop()
            if chunk.state is state and self._chunks.get(chunk.key) is chunk and chunk.retry_s <= now_s:
                if self._may_go(chunk, now_s, short=short):
                    return chunk
                if self._reviewed_short and not short:  # its turn comes when memory is short again
                    left.append(chunk)
                    return None
        return None

    def _is_review_due(self, now_s: float, *, short: bool, idle: bool) -> bool:
        """Whether all chunks are gone over again: seldom, or where memory is short and much has happened."""
        if any(self._found.values()):
            return self._reviewed_short and not short and now_s >= self._review_s
        much = self.news > 0 if idle else self.news * REVIEWED_OF_NEWS >= len(self._chunks)
        return now_s >= self._review_s or (short and (much or not self._reviewed_short))

    def _review(self, now_s: float, *, short: bool) -> None:
        self._review_s, self._reviewed_short, self.news = now_s + REVIEW_S, short, 0
        found = [chunk for chunk in self._chunks.values() if self._may_go(chunk, now_s, short=short)]
        found.sort(key=lambda chunk: self._leaves_last(chunk, now_s))
        for state, left in self._found.items():
            left[:] = (chunk for chunk in found if chunk.state is state)
