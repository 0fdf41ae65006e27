# SPDX-License-Identifier: Apache-2.0
"""What changed in a live map, numbered, so that a reader is told only what it does not know."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Final

from shmmap.chunks.voxels import ChunkKey

__all__ = ["Changes"]

MOST_GONE: Final = 4000
"""Chunks that left memory and are remembered: all of them go into one answer."""


class Changes:
    """Changes of one map, since the worker began.

    Attributes
    ----------
    number
        Of the last change.

    Parameters
    ----------
    first
        Number to begin with: greater than any of an earlier life.
    """

    def __init__(self, first: int) -> None:
        self.number = self._forgotten = first
        self._changed: dict[ChunkKey, int] = {}  # the last one last
        self._gone: deque[tuple[int, ChunkKey]] = deque()

    def changed(self, key: ChunkKey) -> None:
        """A chunk came into memory, or was changed there."""
        self.number += 1
        self._changed.pop(key, None)
        self._changed[key] = self.number

    def gone(self, key: ChunkKey) -> None:
        """A chunk left memory."""
        self.number += 1
        self._changed.pop(key, None)
        self._gone.append((self.number, key))
        if len(self._gone) > MOST_GONE:
            self._forgotten, _ = self._gone.popleft()

    def known(self, since: int) -> bool:
        """Whether everything that happened after ``since`` is remembered."""
        return self._forgotten <= since <= self.number

    def is_newer(self, key: ChunkKey, since: int) -> bool:
        """Whether a chunk in memory changed after ``since``."""
        return self._changed.get(key, 0) > since

    def newer(self, since: int, most: int) -> list[ChunkKey] | None:
        """Chunks in memory that changed after ``since``, the last one first; None for more than ``most``."""
        found: list[ChunkKey] = []
        for key, number in reversed(self._changed.items()):
            if number <= since:
                break
            if len(found) == most:
                return None
            found.append(key)
        return found

    def left(self, since: int) -> list[ChunkKey]:
        """What left memory after ``since`` and did not come back, each once."""
        newest_first = list(takewhile(lambda one: one[0] > since, reversed(self._gone)))
        keys = dict.fromkeys(key for _, key in reversed(newest_first))
        return [key for key in keys if key not in self._changed]
