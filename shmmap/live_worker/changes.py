# SPDX-License-Identifier: Apache-2.0
"""The changes of a live map's chunks, by which readers find what is new."""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Final

from shmmap.chunks.voxels import ChunkKey

MAX_GONE: Final = 4000
"""How many chunks that left memory are remembered; all of them fit into one reply."""


class Changes:
    """Numbered changes of one map, since the worker began.

    Parameters
    ----------
    first
        First number, greater than any of a previous run.

    Attributes
    ----------
    number
        Number of the last change.
    """

    def __init__(self, first: int) -> None:
        self.number = self._forgotten = first
        self._changed: dict[ChunkKey, int] = {}  # most recently changed at the end
        self._gone: deque[tuple[int, ChunkKey]] = deque()

    def note_changed(self, key: ChunkKey) -> None:
        """Record that a chunk was loaded into memory, or changed there."""
        self.number += 1
        self._changed.pop(key, None)
        self._changed[key] = self.number

    def note_gone(self, key: ChunkKey) -> None:
        """Record that a chunk left memory."""
        self.number += 1
        self._changed.pop(key, None)
        self._gone.append((self.number, key))
        if len(self._gone) > MAX_GONE:
            self._forgotten, _ = self._gone.popleft()

    def known(self, since: int) -> bool:
        """Return whether all changes after ``since`` are remembered."""
        return self._forgotten <= since <= self.number

    def is_newer(self, key: ChunkKey, since: int) -> bool:
        """Return whether a chunk in memory changed after ``since``."""
        return self._changed.get(key, 0) > since

    def newer(self, since: int, most: int) -> list[ChunkKey] | None:
        """Return the chunks in memory that changed after ``since``; None if there are more than ``most``."""
        found: list[ChunkKey] = []
        for key, number in reversed(self._changed.items()):
            if number <= since:
                break
            if len(found) == most:
                return None
            found.append(key)
        return found

    def gone(self, since: int) -> list[ChunkKey]:
        """Return the chunks that left memory after ``since`` and were not loaded again."""
        newest_first = list(takewhile(lambda one: one[0] > since, reversed(self._gone)))
        keys = dict.fromkeys(key for _, key in reversed(newest_first))
        return [key for key in keys if key not in self._changed]
