# SPDX-License-Identifier: Apache-2.0
"""Which voxel of a global lattice each point lies in.

The index along an axis is ``floor(x * (1 / leaf))``, computed in the points' own precision: in
float32 for float32 points, as PCL's VoxelGrid and VoxelGridCovariance do, so that points on a voxel's
face fall where they fall there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int32, int64, types

from shmmap.compiling import compiled, read_only

__all__ = ["bounds", "count_points", "number_voxels"]


@compiled(
    types.int64(read_only(float32, 2), float32, float32, float32, float64[::1]),
    types.int64(read_only(float64, 2), float64, float64, float64, float64[::1]),
)
def bounds(xyz: Any, inverse_x: Any, inverse_y: Any, inverse_z: Any, result: Any) -> Any:
    """Find the extent of finite points on the lattice.

    ``result`` (6,) receives the least and then the greatest index along x, y, z.  Returns how many
    points are finite.
    """
    kept = 0
    low_x, low_y, low_z = np.inf, np.inf, np.inf
    high_x, high_y, high_z = -np.inf, -np.inf, -np.inf
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        kept += 1
        # floor is monotonic: it can wait until the extreme is known
        a, b, c = x * inverse_x, y * inverse_y, z * inverse_z
        low_x = min(low_x, a)
        low_y = min(low_y, b)
        low_z = min(low_z, c)
        high_x = max(high_x, a)
        high_y = max(high_y, b)
        high_z = max(high_z, c)
    result[0], result[1], result[2] = np.floor(low_x), np.floor(low_y), np.floor(low_z)
    result[3], result[4], result[5] = np.floor(high_x), np.floor(high_y), np.floor(high_z)
    return kept


@compiled(
    types.int64(
        read_only(float32, 2), float32, float32, float32, read_only(int64, 1), read_only(int64, 1),
        int32[::1], int32[::1],
    ),
    types.int64(
        read_only(float64, 2), float64, float64, float64, read_only(int64, 1), read_only(int64, 1),
        int32[::1], int32[::1],
    ),
)  # fmt: skip
def count_points(
    xyz: Any, inverse_x: Any, inverse_y: Any, inverse_z: Any, first: Any, shape: Any, place: Any, table: Any
) -> Any:
    """Count the points of each voxel of a table.

    ``table`` (voxels,) is zero on entry, x fastest; ``place`` (N,) receives each point's position in
    it, -1 for a point that is not finite.  Returns how many voxels have points.
    """
    occupied = 0
    first_x, first_y, first_z = first[0], first[1], first[2]
    step_y = shape[0]
    step_z = shape[0] * shape[1]
    for n in range(xyz.shape[0]):
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            place[n] = -1
            continue
        at = (
            (int(np.floor(x * inverse_x)) - first_x)
            + (int(np.floor(y * inverse_y)) - first_y) * step_y
            + (int(np.floor(z * inverse_z)) - first_z) * step_z
        )
        place[n] = at
        if table[at] == 0:
            occupied += 1
        table[at] += 1
    return occupied


@compiled(types.int64(int32[::1], int32, int32[::1], int32[::1]))
def number_voxels(table: Any, least: Any, counts: Any, places: Any) -> Any:
    """Number the voxels that have at least ``least`` points, in the order of the table.

    ``table`` holds counts on entry, row numbers or -1 afterwards; ``counts`` and ``places`` (at least
    as long as there are occupied voxels) receive each row's count and position.  Returns the rows.
    """
    rows = 0
    for at in range(table.shape[0]):
        count = table[at]
        if count >= least and count > 0:
            counts[rows] = count
            places[rows] = at
            table[at] = rows
            rows += 1
        else:
            table[at] = -1
    return rows
