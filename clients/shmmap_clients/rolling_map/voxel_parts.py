# SPDX-License-Identifier: Apache-2.0
"""All voxels of a live map, part by part where one list would take more memory than the daemon has for it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import Box
from shmmap.errors import OverBudget
from shmmap.live import LiveMap

__all__ = ["all_voxels"]

_SIDE: Final = 64  # of a chunk, voxels


def all_voxels(live: LiveMap, kind: str, scope: str = "memory") -> NDArray[np.float64]:
    """Middles of all occupied or free voxels, (N, 3) metres in the map's frame.

    Parameters
    ----------
    kind, scope
        As `shmmap.live.LiveMap.voxels` takes them.

    Raises
    ------
    OverBudget
        The daemon has no memory for a list at all.
    """
    rows = live.chunks(saved=scope != "memory")
    keys = np.array([row.key for row in rows], np.int64).reshape(-1, 3) * _SIDE
    counts = np.array([row.occupied if kind == "occupied" else row.free for row in rows], np.int64)
    found = [np.empty((0, 3))]
    if not len(keys):
        return found[0]
    waiting = [(keys.min(axis=0), keys.max(axis=0) + _SIDE)]
    too_many = math.inf
    while waiting:
        low, high = waiting.pop()
        inside = (keys < high).all(axis=1) & (keys + _SIDE > low).all(axis=1)
        expected = int(counts[inside].sum())
        if expected and (expected < too_many or inside.sum() == 1):
            try:
                found.append(live.voxels(kind, _box(low, high, live.resolution), scope=scope).xyz)
            except OverBudget:
                if (high - low).max() == 1:
                    raise
                too_many = min(too_many, expected)
                waiting += _halves(low, high)
        elif expected:
            waiting += _halves(low, high)
    return np.concatenate(found)


def _box(low: NDArray[np.int64], high: NDArray[np.int64], resolution: float) -> Box:
    """The box of voxels from ``low`` to below ``high``: no voxel has its middle on its faces."""
    (x0, y0, z0), (x1, y1, z1) = (low * resolution).tolist(), (high * resolution).tolist()
    return Box(x0, y0, x1, y1, (z0, z1))


def _halves(
    low: NDArray[np.int64], high: NDArray[np.int64]
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Two halves along the longest axis, between chunks as long as there are several."""
    axis = int((high - low).argmax())
    size = int(high[axis] - low[axis])
    half = size // 2 if size <= _SIDE else size // _SIDE // 2 * _SIDE
    middle_high, middle_low = high.copy(), low.copy()
    middle_high[axis] = middle_low[axis] = low[axis] + half
    return [(low, middle_high), (middle_low, high)]
