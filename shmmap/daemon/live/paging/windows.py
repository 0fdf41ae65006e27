# SPDX-License-Identifier: Apache-2.0
"""Which chunks are near a client: around each there is a window of them, and all windows count."""

from __future__ import annotations

import math
from typing import TypeAlias

from shmmap.chunks.voxels import ChunkKey

__all__ = ["Windows", "place_ahead"]

Place: TypeAlias = tuple[float, float, float]


def place_ahead(before: Place, here: Place, passed_s: float, ahead_s: float, most: float) -> Place:
    """Where a client will be if it goes on as it does.

    Parameters
    ----------
    before, here
        Where it was, and where it is now.
    passed_s, ahead_s
        Seconds between the two, and from now on.
    most
        It is not looked further ahead along any axis; the direction stays the same.
    """
    way = [now - then for now, then in zip(here, before, strict=True)]
    longest = max(map(abs, way))
    factor = min(ahead_s / passed_s, most / longest) if longest else 0.0
    x, y, z = (at + part * factor for at, part in zip(here, way, strict=True))
    return x, y, z


class Windows:
    """The clients of one map.

    Parameters
    ----------
    radius
        Chunks around a client's that are near, along each axis; 1 for its 26 neighbours.
    hysteresis
        How far a client has to be in another chunk until its window follows, as a part of a chunk.

    Attributes
    ----------
    near
        Chunks that are near a client, with their distance to the nearest.
    """

    def __init__(self, radius: int, hysteresis: float) -> None:
        self._radius = radius
        self._hysteresis = hysteresis
        self._centers: dict[object, ChunkKey] = {}
        self._distances: dict[ChunkKey, int] = {}  # what was asked for since a window moved
        self.near: dict[ChunkKey, int] = {}

    def move(self, client: object, position: tuple[float, float, float]) -> bool:
        """A client is somewhere, in chunks; whether its window follows.

        It does when the client is more than ``hysteresis`` beyond the border of the window's middle on each
        axis that changes, or at once when it is more than a chunk away.
        """
        key = ChunkKey(*(math.floor(value) for value in position))
        center = self._centers.get(client)
        if center is not None and (
            center == key or (key.distance(center) == 1 and not self._left(center, position))
        ):
            return False
        self._centers[client] = key
        self._look_around()
        return True

    def _left(self, center: ChunkKey, position: tuple[float, float, float]) -> bool:
        """Whether a position is far enough out of a chunk next to it."""
        into = [
            max(low - value, value - low - 1.0)
            for low, value in zip(center, position, strict=True)
            if math.floor(value) != low
        ]
        return min(into) >= self._hysteresis

    def leave(self, client: object) -> bool:
        """A client has gone; whether it had a window."""
        if self._centers.pop(client, None) is None:
            return False
        self._look_around()
        return True

    def center(self, client: object) -> ChunkKey | None:
        """The middle of a client's window."""
        return self._centers.get(client)

    def _look_around(self) -> None:
        reach = range(-self._radius, self._radius + 1)
        self._distances.clear()
        self.near = {}
        for center in self._centers.values():
            for x in reach:
                for y in reach:
                    for z in reach:
                        key = ChunkKey(center.x + x, center.y + y, center.z + z)
                        distance = max(abs(x), abs(y), abs(z))
                        self.near[key] = min(self.near.get(key, distance), distance)

    def distance(self, key: ChunkKey) -> int:
        """Chunks to the nearest client; 0 where there is none."""
        found = self._distances.get(key)
        if found is None:
            found = min((key.distance(center) for center in self._centers.values()), default=0)
            self._distances[key] = found
        return found
