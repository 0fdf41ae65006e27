# SPDX-License-Identifier: Apache-2.0
"""The compiled comparison: one thread, without the GIL, directly on shared memory.

Importing this module compiles the kernel, or loads it from numba's cache within tenths of a second.
"""

from __future__ import annotations

from typing import Any, Final

import numba
import numpy as np
from numba import types

from shmmap.compiling import compiled, read_only
from shmmap_clients.compare_map_filter.rule import SLACK, VOXEL, VOXEL_DISTANCE
from shmmap_clients.compare_map_filter.search_table import (
    ADDRESS_START,
    ADDRESS_TILE,
    ADDRESS_XYZ,
    FIRST_X,
    FIRST_Y,
    IS_DOUBLE,
    TILES_X,
    TILES_Y,
)
from shmmap_clients.elements_at import float32_at, float64_at, int32_at


@numba.njit(inline="always")
def _coordinate(address: Any, double: Any, index: Any) -> Any:
    if double:
        return float64_at(address, index)
    return np.float64(float32_at(address, index))


@numba.njit(inline="always")
def _first_above(address: Any, double: Any, begin: Any, end: Any, z: Any) -> Any:
    """Return the first row of ``begin`` to ``end`` whose z is at least ``z``, by bisection."""
    while begin < end:
        middle = (begin + end) >> 1
        if _coordinate(address, double, 3 * middle + 2) < z:
            begin = middle + 1
        else:
            end = middle
    return begin


_ARGUMENTS: Final = (
    read_only(types.float64, 2),  # T_map_sensor
    types.int64,  # mode
    types.float64,  # distance
    types.float64,  # distance along z
    types.float64,  # leaf
    read_only(types.int64, 2),  # rows of the table
    types.int64,  # columns in a bin
    types.int64,  # first bin, x
    types.int64,  # first bin, y
    types.int64,  # bins along x
    types.int64,  # bins along y
    read_only(types.int32, 1),  # bin_start
    read_only(types.int32, 1),  # bin_cells
    types.boolean[::1],  # result
)
_SIGNATURES: Final = [types.void(read_only(t, 2), *_ARGUMENTS) for t in (types.float32, types.float64)]


@compiled(*_SIGNATURES)
def explain(  # noqa: C901  its parts would take a dozen arguments each
    points: Any,
    T: Any,
    mode: Any,
    d: Any,
    d_z: Any,
    leaf: Any,
    rows: Any,
    bin_columns: Any,
    bin_first_x: Any,
    bin_first_y: Any,
    bins_x: Any,
    bins_y: Any,
    bin_start: Any,
    bin_cells: Any,
    explained: Any,
) -> None:
    """Write for each point whether the map explains it; equal to `rule.explain`."""
    inverse = 1.0 / leaf
    inverse_z = 1.0 / d_z
    reach = d + SLACK
    reach_z = (d_z if mode == VOXEL else d) + SLACK
    squared = d * d
    for n in range(points.shape[0]):
        explained[n] = False
        sx, sy, sz = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        x = T[0, 0] * sx + T[0, 1] * sy + T[0, 2] * sz + T[0, 3]
        y = T[1, 0] * sx + T[1, 1] * sy + T[1, 2] * sz + T[1, 3]
        z = T[2, 0] * sx + T[2, 1] * sy + T[2, 2] * sz + T[2, 3]
        if not (abs(x) < 1e9 and abs(y) < 1e9 and np.isfinite(z)):
            continue
        own_x = np.int64(np.floor(x * inverse))
        own_y = np.int64(np.floor(y * inverse))
        bin_x = np.int64(np.floor(own_x / bin_columns)) - bin_first_x
        bin_y = np.int64(np.floor(own_y / bin_columns)) - bin_first_y
        if not (0 <= bin_x < bins_x and 0 <= bin_y < bins_y):
            continue
        low_x = np.int64(np.floor((x - reach) * inverse))
        high_x = np.int64(np.floor((x + reach) * inverse))
        low_y = np.int64(np.floor((y - reach) * inverse))
        high_y = np.int64(np.floor((y + reach) * inverse))
        voxel_z = np.floor(z * inverse_z)
        low_z, high_z = z - reach_z, z + reach_z
        if mode == VOXEL_DISTANCE:
            low_z, high_z = min(low_z, z - d_z - SLACK), max(high_z, z + d_z + SLACK)
        at = bin_y * bins_x + bin_x
        found = False
        for entry in range(bin_start[at], bin_start[at + 1]):
            cell = bin_cells[entry]
            first_x, first_y = rows[cell, FIRST_X], rows[cell, FIRST_Y]
            tiles_x, tiles_y = rows[cell, TILES_X], rows[cell, TILES_Y]
            from_x, to_x = max(low_x, first_x), min(high_x, first_x + tiles_x * 8 - 1)
            from_y, to_y = max(low_y, first_y), min(high_y, first_y + tiles_y * 8 - 1)
            if from_x > to_x or from_y > to_y:
                continue
            address, double = rows[cell, ADDRESS_XYZ], rows[cell, IS_DOUBLE] != 0
            # own column first, which explains most points of a scan
            width = to_x - from_x + 1
            columns = width * (to_y - from_y + 1)
            own = -1
            if from_x <= own_x <= to_x and from_y <= own_y <= to_y:
                own = (own_y - from_y) * width + own_x - from_x
            for k in range(-1, columns):
                place = k
                if k == -1:
                    place = own
                    if own < 0:
                        continue
                elif k == own:
                    continue
                c_x = from_x + place % width
                c_y = from_y + place // width
                right, up = c_x - first_x, c_y - first_y
                tile = np.int64(int32_at(rows[cell, ADDRESS_TILE], (up >> 3) * tiles_x + (right >> 3)))
                if tile < 0:
                    continue
                column = tile * 64 + (up & 7) * 8 + (right & 7)
                begin = np.int64(int32_at(rows[cell, ADDRESS_START], column))
                end = np.int64(int32_at(rows[cell, ADDRESS_START], column + 1))
                if begin == end:
                    continue
                row = _first_above(address, double, begin, end, low_z)
                while row < end:
                    m_z = _coordinate(address, double, 3 * row + 2)
                    if m_z > high_z:
                        break
                    d_x = _coordinate(address, double, 3 * row) - x
                    d_y = _coordinate(address, double, 3 * row + 1) - y
                    away_z = m_z - z
                    if mode == VOXEL:
                        found = abs(d_x) < d and abs(d_y) < d and abs(away_z) < d_z
                    else:
                        found = d_x * d_x + d_y * d_y + away_z * away_z <= squared
                        if mode == VOXEL_DISTANCE and not found:
                            found = c_x == own_x and c_y == own_y and np.floor(m_z * inverse_z) == voxel_z
                    if found:
                        break
                    row += 1
                if found:
                    break
            if found:
                break
        explained[n] = found
