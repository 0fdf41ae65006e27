# SPDX-License-Identifier: Apache-2.0
"""Extremes and means of the heights in each row."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int32, types

from shmmap.compiling import compiled, read_only

__all__ = ["heights"]


_INDICES = read_only(int32, 1)
_HEIGHTS = float64[::1]


@compiled(
    types.void(read_only(float32, 2), _INDICES, _INDICES, _HEIGHTS, _HEIGHTS, _HEIGHTS),
    types.void(read_only(float64, 2), _INDICES, _INDICES, _HEIGHTS, _HEIGHTS, _HEIGHTS),
)
def heights(xyz: Any, rows: Any, counts: Any, low: Any, high: Any, mean: Any) -> None:
    """Fill in the lowest, highest and mean z of each row; means are summed about the row's first z."""
    first = np.empty(low.shape[0])
    low[:] = np.inf
    high[:] = -np.inf
    mean[:] = 0.0
    for n in range(xyz.shape[0]):
        row = rows[n]
        if row < 0:
            continue
        z = float(xyz[n, 2])
        if high[row] == -np.inf:
            first[row] = z
        low[row] = min(low[row], z)
        high[row] = max(high[row], z)
        mean[row] += z - first[row]
    for row in range(low.shape[0]):
        mean[row] = first[row] + mean[row] / counts[row]
