# SPDX-License-Identifier: Apache-2.0
"""Chunks near clients: each client has a window of chunks around it, and a chunk in any window is near."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.voxels import ChunkKey

Place: TypeAlias = tuple[float, float, float]


def place_ahead(before: Place, here: Place, passed_s: float, ahead_s: float, longest: float) -> Place:
    """Return the place a client will reach at its present velocity.

    Parameters
    ----------
    before, here
        The client's previous and present place.
    passed_s, ahead_s
        Seconds between the two places, and seconds to look ahead.
    longest
        Longest look-ahead along any axis; the direction stays the same.
    """
    moved = [now - then for now, then in zip(here, before, strict=True)]
    most = max(map(abs, moved))
    factor = min(ahead_s / passed_s, longest / most) if most else 0.0
    x, y, z = (at + part * factor for at, part in zip(here, moved, strict=True))
    return x, y, z


class Windows:
    """The clients of one map.

    Parameters
    ----------
    radius
        Chunks around a client's chunk that are near, along each axis; 1 for its 26 neighbours.
    hysteresis
        How far a client has to enter another chunk until its window follows, as a fraction of a chunk.

    Attributes
    ----------
    near
        Chunks near a client, with the number of windows that they are in.
    """

    def __init__(self, radius: int, hysteresis: float) -> None:
        self._radius = radius
        self._hysteresis = hysteresis
        self._centers: dict[object, ChunkKey] = {}
        self.near: dict[ChunkKey, int] = {}

    def move(self, client: object, position: Place) -> tuple[list[ChunkKey], list[ChunkKey]]:
        """Move a client to a position in chunks; return the chunks that entered and left all windows.

        Its window follows when the client is more than ``hysteresis`` beyond the border of the window's
        centre on each axis that changes, or at once when it is more than a chunk away.
        """
        key = ChunkKey(*(math.floor(value) for value in position))
        center = self._centers.get(client)
        if center is not None and (
            center == key or (key.distance(center) == 1 and not self._is_beyond(center, position))
        ):
            return [], []
        self._centers[client] = key
        entered = [one for one in self._only_around(key, center) if self._enter(one)]
        return entered, [] if center is None else self._leave(center, key)

    def _is_beyond(self, center: ChunkKey, position: Place) -> bool:
        """Return whether a position is far enough outside the window's central chunk."""
        into = [
            max(low - value, value - low - 1.0)
            for low, value in zip(center, position, strict=True)
            if math.floor(value) != low
        ]
        return min(into) >= self._hysteresis

    def leave(self, client: object) -> list[ChunkKey]:
        """Forget a client; return the chunks that are near no client any more."""
        center = self._centers.pop(client, None)
        return [] if center is None else self._leave(center, None)

    def center(self, client: object) -> ChunkKey | None:
        """Return the central chunk of a client's window."""
        return self._centers.get(client)

    def _enter(self, key: ChunkKey) -> bool:
        """Count one more window around a chunk; return whether it is the first."""
        count = self.near[key] = self.near.get(key, 0) + 1
        return count == 1

    def _leave(self, center: ChunkKey, now: ChunkKey | None) -> list[ChunkKey]:
        """Remove a window around a chunk, except around ``now``; return chunks near no client any more."""
        left = []
        for key in self._only_around(center, now):
            self.near[key] -= 1
            if not self.near[key]:
                del self.near[key]
                left.append(key)
        return left

    def _only_around(self, center: ChunkKey, other: ChunkKey | None) -> Iterator[ChunkKey]:
        """Yield the chunks in the window around one chunk that are not in the window around another."""
        reach = self._radius
        ranges = [range(at - reach, at + reach + 1) for at in center]
        if other is not None:
            for axis, at in enumerate(other):
                mine, theirs = ranges[axis], range(at - reach, at + reach + 1)
                for alone in (
                    range(mine.start, min(mine.stop, theirs.start)),
                    range(max(mine.start, theirs.stop), mine.stop),
                ):
                    slab = [*ranges[:axis], alone, *ranges[axis + 1 :]]
                    yield from (ChunkKey(*key) for key in product(*slab))
                ranges[axis] = range(max(mine.start, theirs.start), min(mine.stop, theirs.stop))
            return
        yield from (ChunkKey(*key) for key in product(*ranges))

    def distances(self, keys: Sequence[ChunkKey]) -> NDArray[np.int64]:
        """Return the distance of each chunk to the nearest client, (N,) chunks; 0 without clients."""
        if not self._centers or not keys:
            return np.zeros(len(keys), np.int64)
        places = np.array(keys, np.int64)
        nearest = np.full(len(keys), np.iinfo(np.int64).max)
        for center in set(self._centers.values()):
            np.minimum(nearest, np.abs(places - np.array(center)).max(axis=1), out=nearest)
        return nearest
