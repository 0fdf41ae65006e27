# SPDX-License-Identifier: Apache-2.0
"""The lowest surface of each column: clusters, and the mean height of the chosen one.

Importing this module compiles the kernel, or loads it from numba's cache within tenths of a second.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from shmmap.compiling import compiled, inlined
from shmmap_clients.elevation_map.heights import ElevationRule


def surface_heights(
    xyz: NDArray[Any], column: NDArray[np.int64], rule: ElevationRule
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the columns with points, ascending, and their heights.

    Parameters
    ----------
    xyz
        (N, 3) float32 or float64, metres.
    column
        (N,) int64: column of each point.
    rule
        Tolerance, height range and least number of points.

    Returns
    -------
    (M,) int64 and (M,) float64, metres; NaN where no cluster is large enough.
    """
    order = np.lexsort((xyz[:, 2], column))
    ordered = xyz[order].astype(np.float64)
    columns, start = np.unique(column[order], return_index=True)
    bounds = np.append(start, len(order)).astype(np.int64)
    heights = np.empty(len(columns))
    _surface(ordered, bounds, rule.tolerance, rule.height_range, rule.min_points, heights)
    return columns, heights


@inlined
def _root(parent: Any, member: Any) -> Any:
    while parent[member] != member:
        parent[member] = parent[parent[member]]  # halves the path for the next lookup
        member = parent[member]
    return member


@inlined
def _join(xyz: Any, first: Any, size: Any, tolerance: Any, parent: Any) -> None:
    """Join points of a column into clusters; ``parent`` links each point to its cluster's lowest."""
    squared = tolerance * tolerance
    for k in range(size):
        parent[k] = k
        x, y, z = xyz[first + k, 0], xyz[first + k, 1], xyz[first + k, 2]
        own = k
        for other in range(k - 1, -1, -1):
            d_z = z - xyz[first + other, 2]
            if d_z > tolerance:
                break
            root = _root(parent, other)
            if root == own:
                continue
            d_x, d_y = x - xyz[first + other, 0], y - xyz[first + other, 1]
            if d_x * d_x + d_y * d_y + d_z * d_z <= squared:
                # keep the older root, which may already be own
                low, high = min(root, own), max(root, own)
                parent[high] = low
                own = low


@compiled(
    types.void(
        types.float64[:, ::1], types.int64[::1], types.float64, types.float64, types.int64, types.float64[::1]
    ),
)
def _surface(xyz: Any, bounds: Any, tolerance: Any, height_range: Any, min_points: Any, heights: Any) -> None:
    """Return ``xyz`` sorted by column and height; column n is in rows ``bounds[n] : bounds[n + 1]``."""
    largest = 0
    for n in range(heights.shape[0]):
        largest = max(largest, bounds[n + 1] - bounds[n])
    parent = np.empty(largest, np.int64)
    count = np.empty(largest, np.int64)
    total = np.empty(largest, np.float64)
    for n in range(heights.shape[0]):
        first, size = bounds[n], bounds[n + 1] - bounds[n]
        heights[n] = np.nan
        if size < min_points:
            continue
        _join(xyz, first, size, tolerance, parent)
        base = xyz[first, 2]
        for k in range(size):
            count[k] = 0
            total[k] = 0.0
        for k in range(size):
            root = _root(parent, k)
            count[root] += 1
            total[root] += xyz[first + k, 2] - base
        lowest = np.inf
        for k in range(size):
            if count[k] >= min_points:
                lowest = min(lowest, total[k] / count[k])
        chosen, most = np.inf, 0
        for k in range(size):
            if count[k] >= min_points:
                mean = total[k] / count[k]
                if mean - lowest <= height_range and (
                    count[k] > most or (count[k] == most and mean < chosen)
                ):
                    chosen, most = mean, count[k]
        if most > 0:
            heights[n] = base + chosen
