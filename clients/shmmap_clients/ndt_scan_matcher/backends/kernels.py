# SPDX-License-Identifier: Apache-2.0
"""The compiled inner loop: neighbours, score, gradient and Hessian in one pass over the points.

Importing this module compiles the kernel, or loads it from numba's cache (tenths of a second).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import types

from shmmap_clients.compiling import compiled, float64_at, int32_at, read_only
from shmmap_clients.ndt_scan_matcher.matching.evaluation import NEGLIGIBLE_EXPONENT

__all__ = ["accumulate", "loaded_from_cache"]

_SIGNATURE: Final = types.void(
    read_only(types.float64, 2),  # source
    types.int64,  # first chunk
    types.int64,  # last chunk
    types.int64,  # points in a chunk
    read_only(types.float64, 2),  # T
    read_only(types.float64, 3),  # derivatives of the rotation
    read_only(types.int64, 2),  # table
    read_only(types.float64, 2),  # origins
    read_only(types.int64, 1),  # box
    read_only(types.int32, 1),  # column_start
    read_only(types.int32, 1),  # column_cell
    read_only(types.int64, 2),  # columns
    types.float64,  # 1 / leaf
    types.float64,  # radius squared; infinite for none
    types.float64,  # d1
    types.float64,  # d2
    types.float64[:, ::1],  # near
    types.int64[::1],  # near_inverse
    types.float64[:, ::1],  # rows
)


@compiled(_SIGNATURE, boundscheck=False, fastmath={"contract"})
def accumulate(
    source: Any, first: Any, last: Any, chunk_points: Any, T: Any, M: Any, table: Any, origins: Any,
    box: Any, column_start: Any, column_cell: Any, columns: Any, inverse_leaf: Any, radius2: Any, d1: Any,
    d2: Any, near: Any, near_inverse: Any, rows: Any,
) -> None:  # fmt: skip
    """Write the sums of chunks [first, last) of the source into their rows."""
    most = near.shape[0]
    for chunk in range(first, last):
        begin = chunk * chunk_points
        end = min(begin + chunk_points, source.shape[0])
        score = 0.0
        nearest = 0.0
        found = 0
        neighbours = 0
        cut_points = 0
        cut_neighbours = 0
        a0 = a1 = a2 = 0.0
        s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
        b00 = b01 = b02 = b11 = b12 = b22 = 0.0
        t00 = t01 = t02 = t10 = t11 = t12 = t20 = t21 = t22 = 0.0
        r00 = r01 = r02 = r11 = r12 = r22 = 0.0
        for point in range(begin, end):
            x = source[point, 0]
            y = source[point, 1]
            z = source[point, 2]
            px = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            py = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            pz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            fi = np.floor(px * inverse_leaf) - box[0]
            fj = np.floor(py * inverse_leaf) - box[1]
            fk = np.floor(pz * inverse_leaf)
            # outside, or not a number; also keeps the conversions to integers defined
            if not (fi >= -1 and fi <= box[2] and fj >= -1 and fj <= box[3] and abs(fk) < 2**30):
                continue
            i = np.int64(fi)
            j = np.int64(fj)
            k = np.int64(fk)
            # gather: who is near, at most as many as there is room for, the nearest of them
            count = 0
            surplus = 0
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
                    offset = (ci + box[0] - table[cell, 3]) * table[cell, 7] + (
                        cj + box[1] - table[cell, 4]
                    ) * table[cell, 8]
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
                            surplus += 1
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
            if count == 0:
                continue
            found += 1
            neighbours += count
            if surplus > 0:
                cut_points += 1
                cut_neighbours += surplus
            best = 0.0
            g0 = g1 = g2 = 0.0
            h00 = h01 = h02 = h11 = h12 = h22 = 0.0
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
                e = math.exp(-exponent)
                share = -d1 * e
                score += share
                best = max(best, share)
                w = d1 * d2 * e
                v = w * d2
                g0 += w * q0
                g1 += w * q1
                g2 += w * q2
                h00 += w * c00 - v * q0 * q0
                h01 += w * c01 - v * q0 * q1
                h02 += w * c02 - v * q0 * q2
                h11 += w * c11 - v * q1 * q1
                h12 += w * c12 - v * q1 * q2
                h22 += w * c22 - v * q2 * q2
            nearest += best
            a0 += g0
            a1 += g1
            a2 += g2
            s00 += g0 * x
            s01 += g0 * y
            s02 += g0 * z
            s10 += g1 * x
            s11 += g1 * y
            s12 += g1 * z
            s20 += g2 * x
            s21 += g2 * y
            s22 += g2 * z
            b00 += h00
            b01 += h01
            b02 += h02
            b11 += h11
            b12 += h12
            b22 += h22
            # columns of J: how the point moves with roll, pitch, yaw
            ry = M[0, 1, 0] * x + M[0, 1, 1] * y + M[0, 1, 2] * z
            rz = M[0, 2, 0] * x + M[0, 2, 1] * y + M[0, 2, 2] * z
            ux = M[1, 0, 0] * x + M[1, 0, 1] * y + M[1, 0, 2] * z
            uy = M[1, 1, 0] * x + M[1, 1, 1] * y + M[1, 1, 2] * z
            uz = M[1, 2, 0] * x + M[1, 2, 1] * y + M[1, 2, 2] * z
            wx = M[2, 0, 0] * x + M[2, 0, 1] * y
            wy = M[2, 1, 0] * x + M[2, 1, 1] * y
            wz = M[2, 2, 0] * x + M[2, 2, 1] * y
            # B J
            l00 = h01 * ry + h02 * rz
            l10 = h11 * ry + h12 * rz
            l20 = h12 * ry + h22 * rz
            l01 = h00 * ux + h01 * uy + h02 * uz
            l11 = h01 * ux + h11 * uy + h12 * uz
            l21 = h02 * ux + h12 * uy + h22 * uz
            l02 = h00 * wx + h01 * wy + h02 * wz
            l12 = h01 * wx + h11 * wy + h12 * wz
            l22 = h02 * wx + h12 * wy + h22 * wz
            t00 += l00
            t01 += l01
            t02 += l02
            t10 += l10
            t11 += l11
            t12 += l12
            t20 += l20
            t21 += l21
            t22 += l22
            # J^T B J
            r00 += ry * l10 + rz * l20
            r01 += ry * l11 + rz * l21
            r02 += ry * l12 + rz * l22
            r11 += ux * l01 + uy * l11 + uz * l21
            r12 += ux * l02 + uy * l12 + uz * l22
            r22 += wx * l02 + wy * l12 + wz * l22
        row = rows[chunk]
        row[0] = score
        row[1] = nearest
        row[2] = found
        row[3] = neighbours
        row[4] = cut_points
        row[5] = cut_neighbours
        row[6] = a0
        row[7] = a1
        row[8] = a2
        row[9] = s00
        row[10] = s01
        row[11] = s02
        row[12] = s10
        row[13] = s11
        row[14] = s12
        row[15] = s20
        row[16] = s21
        row[17] = s22
        row[18] = b00
        row[19] = b01
        row[20] = b02
        row[21] = b11
        row[22] = b12
        row[23] = b22
        row[24] = t00
        row[25] = t01
        row[26] = t02
        row[27] = t10
        row[28] = t11
        row[29] = t12
        row[30] = t20
        row[31] = t21
        row[32] = t22
        row[33] = r00
        row[34] = r01
        row[35] = r02
        row[36] = r11
        row[37] = r12
        row[38] = r22


def loaded_from_cache() -> bool:
    """Whether the kernel came from numba's cache, not from the compiler."""
    return bool(accumulate.stats.cache_hits)  # type: ignore[attr-defined]
