# SPDX-License-Identifier: Apache-2.0
"""Sum over the nearest neighbours of a point that has more than the limit; and the kernels' exponential."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types

from shmmap.compiling import compiled, inlined, read_only
from shmmap_clients.elements_at import float64_at, int32_at
from shmmap_clients.ndt_scan_matcher.matching.evaluation import NEGLIGIBLE_EXPONENT

MAP: Final = (
    read_only(types.int64, 2),  # table
    read_only(types.float64, 2),  # origins
    read_only(types.int64, 1),  # box
    read_only(types.int32, 1),  # column_start
    read_only(types.int32, 1),  # column_cell
    read_only(types.int64, 2),  # columns
    types.float64,  # radius squared; infinite for none
    types.float64,  # d1
    types.float64,  # d2
)
SCRATCH: Final = (types.float64[:, ::1], types.int64[::1])  # near, near_inverse
_CROWD: Final = types.void(
    *[types.float64] * 3,  # point, map frame
    *[types.int64] * 3,  # lattice index of the point
    *MAP,
    *SCRATCH,
    types.float64[::1],  # sum over the neighbours
)

# exp(-x) = 2^-n exp(n ln 2 - x): error of half a unit in the last place, and no call that spills registers
_LOG2E: Final = 1.4426950408889634
_LN2_HIGH: Final = 6.93147180369123816490e-01  # few bits, so that its multiples are exact (fdlibm, e_exp.c)
_LN2_LOW: Final = 1.90821492927058770002e-10
_POWERS: Final = 2.0 ** -np.arange(56.0)


@inlined
def exp_of_negated(x: Any) -> Any:
    """Return exp(-x) for x from 0 to `NEGLIGIBLE_EXPONENT`: Taylor's series on half an octave."""
    n = np.int64(x * _LOG2E + 0.5)
    r = (n * _LN2_HIGH - x) + n * _LN2_LOW
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + r2 * (0.5 + r * 0.16666666666666666)
    middle = (0.041666666666666664 + r * 0.008333333333333333) + r2 * (
        0.001388888888888889 + r * 0.0001984126984126984
    )
    high = (2.48015873015873e-05 + r * 2.7557319223985893e-06) + r2 * (
        2.755731922398589e-07 + r * 2.505210838544172e-08
    )
    top = 2.08767569878681e-09 + r * 1.6059043836821613e-10
    return (low + r4 * (middle + r4 * (high + r4 * top))) * _POWERS[n]


@compiled(_CROWD, boundscheck=False, fastmath={"contract"})
def add_nearest(
    px: Any,
    py: Any,
    pz: Any,
    i: Any,
    j: Any,
    k: Any,
    table: Any,
    origins: Any,
    box: Any,
    column_start: Any,
    column_cell: Any,
    columns: Any,
    radius2: Any,
    d1: Any,
    d2: Any,
    near: Any,
    near_inverse: Any,
    crowd: Any,
) -> None:
    """Sum the nearest neighbours of a point that has more than the limit; seldom called.

    Writes score, best share, g (3) and h (6) to ``crowd``.
    """
    most = near.shape[0]
    count = 0
    for column in range(columns.shape[0]):
        ci = i + columns[column, 0]
        cj = j + columns[column, 1]
        if ci < 0 or ci >= box[2] or cj < 0 or cj >= box[3]:
            continue
        place = ci * box[3] + cj
        for entry in range(column_start[place], column_start[place + 1]):
            cell = column_cell[entry]
            k0 = table[cell, 5]
            low = max(k + columns[column, 2] - k0, 0)
            high = min(k + columns[column, 3] - k0, table[cell, 6] - 1)
            offset = (ci + box[0] - table[cell, 3]) * table[cell, 7] + (cj + box[1] - table[cell, 4]) * table[
                cell, 8
            ]
            for dk in range(low, high + 1):
                voxel = np.int64(int32_at(table[cell, 0], offset + dk * table[cell, 9]))
                if voxel < 0 or voxel >= table[cell, 10]:
                    continue
                inverse = table[cell, 2] + voxel * 48
                if not float64_at(inverse, 0) > 0.0:  # refused in this variant
                    continue
                dx = px - origins[cell, 0] - float64_at(table[cell, 1], voxel * 3)
                dy = py - origins[cell, 1] - float64_at(table[cell, 1], voxel * 3 + 1)
                dz = pz - origins[cell, 2] - float64_at(table[cell, 1], voxel * 3 + 2)
                distance2 = dx * dx + dy * dy + dz * dz
                if distance2 > radius2:
                    continue
                slot = count
                if count == most:
                    slot = 0
                    for other in range(1, most):
                        if near[other, 3] >= near[slot, 3]:
                            slot = other
                    if distance2 >= near[slot, 3]:
                        continue
                else:
                    count += 1
                near[slot, 0] = dx
                near[slot, 1] = dy
                near[slot, 2] = dz
                near[slot, 3] = distance2
                near_inverse[slot] = inverse
    crowd[:] = 0.0
    for slot in range(count):
        dx = near[slot, 0]
        dy = near[slot, 1]
        dz = near[slot, 2]
        inverse = near_inverse[slot]
        c00 = float64_at(inverse, 0)
        c01 = float64_at(inverse, 1)
        c02 = float64_at(inverse, 2)
        c11 = float64_at(inverse, 3)
        c12 = float64_at(inverse, 4)
        c22 = float64_at(inverse, 5)
        q0 = c00 * dx + c01 * dy + c02 * dz
        q1 = c01 * dx + c11 * dy + c12 * dz
        q2 = c02 * dx + c12 * dy + c22 * dz
        exponent = 0.5 * d2 * (dx * q0 + dy * q1 + dz * q2)
        if not (exponent >= 0.0 and exponent < NEGLIGIBLE_EXPONENT):
            continue
        e = exp_of_negated(exponent)
        share = -d1 * e
        w = d1 * d2 * e
        v = w * d2
        crowd[0] += share
        crowd[1] = max(crowd[1], share)
        crowd[2] += w * q0
        crowd[3] += w * q1
        crowd[4] += w * q2
        crowd[5] += w * c00 - v * q0 * q0
        crowd[6] += w * c01 - v * q0 * q1
        crowd[7] += w * c02 - v * q0 * q2
        crowd[8] += w * c11 - v * q1 * q1
        crowd[9] += w * c12 - v * q1 * q2
        crowd[10] += w * c22 - v * q2 * q2
