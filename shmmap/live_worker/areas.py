# SPDX-License-Identifier: Apache-2.0
"""Areas in readers' requests: check them, and find the chunks and voxels in them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.voxels import CHUNK_SIDE, FURTHEST_INDEX, ChunkKey
from shmmap.errors import BadRequest
from shmmap.live_worker.paging.key_index import EVERYWHERE, KeyRange
from shmmap.protocol.areas import FURTHEST_M, LiveArea, SphereMessage


def check_area(area: LiveArea) -> None:
    """Raise `BadRequest` if an area is invalid."""
    low, high = _ends(area)
    if isinstance(area, SphereMessage):
        numbers = (area.x, area.y, area.z, area.radius)
        good = all(abs(number) < FURTHEST_M for number in numbers) and area.radius >= 0.0
    else:
        if (area.z_min is None) != (area.z_max is None):
            raise BadRequest("area: a z range has two ends")
        some = slice(2 if area.z_min is None else 3)
        good = all(map(math.isfinite, [*low[some], *high[some]]))
    if not good or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise BadRequest("area: it is not finite, or nothing can lie in it")


def _ends(area: LiveArea) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest x, y, z of an area, metres; infinity where it has no end."""
    if isinstance(area, SphereMessage):
        middle = (area.x, area.y, area.z)
        return [at - area.radius for at in middle], [at + area.radius for at in middle]
    return (
        [area.min_x, area.min_y, -math.inf if area.z_min is None else area.z_min],
        [area.max_x, area.max_y, math.inf if area.z_max is None else area.z_max],
    )


def touches(area: LiveArea | None, key: ChunkKey, resolution: float) -> bool:
    """Return whether a chunk and an area intersect."""
    if area is None:
        return True
    low_x, low_y, low_z, high_x, high_y, high_z = key.box(resolution)
    if isinstance(area, SphereMessage):
        axes = (area.x, low_x, high_x), (area.y, low_y, high_y), (area.z, low_z, high_z)
        gaps = (max(low - value, 0.0, value - high) for value, low, high in axes)
        return sum(gap * gap for gap in gaps) <= area.radius * area.radius
    low, high = _ends(area)
    return (
        (low_x <= high[0] and high_x >= low[0])
        and (low_y <= high[1] and high_y >= low[1])
        and (low_z <= high[2] and high_z >= low[2])
    )


def inside(area: LiveArea, centers: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which places, (N, 3) metres, lie in an area, (N,)."""
    found: NDArray[np.bool_]
    if isinstance(area, SphereMessage):
        away = centers - np.array([area.x, area.y, area.z])
        found = (away * away).sum(axis=1) <= area.radius * area.radius
        return found
    found = np.ones(len(centers), np.bool_)
    for axis, low, high in zip(centers.T, *_ends(area), strict=True):
        found &= (axis >= low) & (axis <= high)
    return found


def key_range(area: LiveArea | None, resolution: float) -> KeyRange:
    """Return a range of keys that includes every chunk that touches an area, despite rounding."""
    if area is None:
        return EVERYWHERE
    low, high = _ends(area)
    side, furthest = CHUNK_SIDE * resolution, FURTHEST_INDEX // CHUNK_SIDE + 1

    def key(place: list[float], beyond: int) -> ChunkKey:
        chunks = (min(max(value / side, -furthest), furthest) for value in place)
        return ChunkKey(*(math.floor(value) + beyond for value in chunks))

    return key(low, -1), key(high, 1)
