# SPDX-License-Identifier: Apache-2.0
"""The compiled inner loop: neighbours, score, gradient and Hessian in one pass over the points.

Importing this module compiles the kernels, or loads them from numba's cache (tenths of a second).
Everything that a loop reads again and again is in local variables: a compiler that cannot know that a
store does not change an array would load it again each time.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import types

from shmmap.compiling import compiled, read_only
from shmmap_clients.elements_at import float64_at, int32_at
from shmmap_clients.ndt_scan_matcher.backends.crowded_kernel import MAP, SCRATCH, add_nearest, exp_of_negated
from shmmap_clients.ndt_scan_matcher.matching.evaluation import NEGLIGIBLE_EXPONENT

__all__ = ["accumulate", "loaded_from_cache"]

_SIGNATURE: Final = types.void(
    read_only(types.float64, 2),  # source
    types.int64,  # chunks of the source
    types.int64,  # points in a chunk
    types.int64,  # first unit
    types.int64,  # last unit
    read_only(types.float64, 3),  # T of each pose
    read_only(types.float64, 4),  # derivatives of each pose's rotation
    types.float64,  # 1 / leaf
    *MAP,
    *SCRATCH,
    types.float64[::1],  # crowd
    types.float64[:, ::1],  # rows
)


@compiled(_SIGNATURE, boundscheck=False, fastmath={"contract"})
def accumulate(
    source: Any, chunks: Any, chunk_points: Any, first: Any, last: Any, T: Any, M: Any, inverse_leaf: Any,
    table: Any, origins: Any, box: Any, column_start: Any, column_cell: Any, columns: Any, radius2: Any,
    d1: Any, d2: Any, near: Any, near_inverse: Any, crowd: Any, rows: Any,
) -> None:  # fmt: skip
    """Write the sums of units [first, last) into their rows; a unit is a chunk of the source at one pose."""
    most = near.shape[0]
    searched = columns.shape[0]
    box_i = box[0]
    box_j = box[1]
    ni = box[2]
    nj = box[3]
    half_d2 = 0.5 * d2
    d1_d2 = d1 * d2
    for unit in range(first, last):
        pose = unit // chunks
        begin = (unit - pose * chunks) * chunk_points
        end = min(begin + chunk_points, source.shape[0])
        t00, t01, t02, t03 = T[pose, 0, 0], T[pose, 0, 1], T[pose, 0, 2], T[pose, 0, 3]
        t10, t11, t12, t13 = T[pose, 1, 0], T[pose, 1, 1], T[pose, 1, 2], T[pose, 1, 3]
        t20, t21, t22, t23 = T[pose, 2, 0], T[pose, 2, 1], T[pose, 2, 2], T[pose, 2, 3]
        m010, m011, m012 = M[pose, 0, 1, 0], M[pose, 0, 1, 1], M[pose, 0, 1, 2]
        m020, m021, m022 = M[pose, 0, 2, 0], M[pose, 0, 2, 1], M[pose, 0, 2, 2]
        m100, m101, m102 = M[pose, 1, 0, 0], M[pose, 1, 0, 1], M[pose, 1, 0, 2]
        m110, m111, m112 = M[pose, 1, 1, 0], M[pose, 1, 1, 1], M[pose, 1, 1, 2]
        m120, m121, m122 = M[pose, 1, 2, 0], M[pose, 1, 2, 1], M[pose, 1, 2, 2]
        m200, m201 = M[pose, 2, 0, 0], M[pose, 2, 0, 1]
        m210, m211 = M[pose, 2, 1, 0], M[pose, 2, 1, 1]
        m220, m221 = M[pose, 2, 2, 0], M[pose, 2, 2, 1]
        known = -1  # the cell of which the table's row is at hand
        lattice = mean = inverses = voxels = np.int64(0)
        i0 = j0 = k0 = nk = si = sj = sk = np.int64(0)
        ox = oy = oz = 0.0
        score = 0.0
        nearest = 0.0
        found = 0
        neighbours = 0
        cut_points = 0
        cut_neighbours = 0
        a0 = a1 = a2 = 0.0
        s00 = s01 = s02 = s10 = s11 = s12 = s20 = s21 = s22 = 0.0
        b00 = b01 = b02 = b11 = b12 = b22 = 0.0
        j00 = j01 = j02 = j10 = j11 = j12 = j20 = j21 = j22 = 0.0
        r00 = r01 = r02 = r11 = r12 = r22 = 0.0
        for point in range(begin, end):
            x = source[point, 0]
            y = source[point, 1]
            z = source[point, 2]
            px = t00 * x + t01 * y + t02 * z + t03
            py = t10 * x + t11 * y + t12 * z + t13
            pz = t20 * x + t21 * y + t22 * z + t23
            fi = np.floor(px * inverse_leaf) - box_i
            fj = np.floor(py * inverse_leaf) - box_j
            fk = np.floor(pz * inverse_leaf)
            # outside, or not a number; also keeps the conversions to integers defined
            if not (fi >= -1 and fi <= ni and fj >= -1 and fj <= nj and abs(fk) < 2**30):
                continue
            i = np.int64(fi)
            j = np.int64(fj)
            k = np.int64(fk)
            count = 0
            total = 0.0
            best = 0.0
            g0 = g1 = g2 = 0.0
            h00 = h01 = h02 = h11 = h12 = h22 = 0.0
            for column in range(searched):
                ci = i + columns[column, 0]
                cj = j + columns[column, 1]
                if ci < 0 or ci >= ni or cj < 0 or cj >= nj:
                    continue
                place = ci * nj + cj
                for entry in range(column_start[place], column_start[place + 1]):
                    cell = column_cell[entry]
                    if cell != known:
                        known = cell
                        lattice = table[cell, 0]
                        mean = table[cell, 1]
                        inverses = table[cell, 2]
                        i0 = table[cell, 3] - box_i
                        j0 = table[cell, 4] - box_j
                        k0 = table[cell, 5]
                        nk = table[cell, 6]
                        si = table[cell, 7]
                        sj = table[cell, 8]
                        sk = table[cell, 9]
                        voxels = table[cell, 10]
                        ox = origins[cell, 0]
                        oy = origins[cell, 1]
                        oz = origins[cell, 2]
                    low = max(k + columns[column, 2] - k0, 0)
                    high = min(k + columns[column, 3] - k0, nk - 1)
                    offset = (ci - i0) * si + (cj - j0) * sj
                    for dk in range(low, high + 1):
                        voxel = np.int64(int32_at(lattice, offset + dk * sk))
                        if voxel < 0 or voxel >= voxels:
                            continue
                        inverse = inverses + voxel * 48
                        c00 = float64_at(inverse, 0)
                        if not c00 > 0.0:  # refused in this variant
                            continue
                        dx = px - ox - float64_at(mean, voxel * 3)
                        dy = py - oy - float64_at(mean, voxel * 3 + 1)
                        dz = pz - oz - float64_at(mean, voxel * 3 + 2)
                        if dx * dx + dy * dy + dz * dz > radius2:
                            continue
                        count += 1
                        c01 = float64_at(inverse, 1)
                        c02 = float64_at(inverse, 2)
                        c11 = float64_at(inverse, 3)
                        c12 = float64_at(inverse, 4)
                        c22 = float64_at(inverse, 5)
                        q0 = c00 * dx + c01 * dy + c02 * dz
                        q1 = c01 * dx + c11 * dy + c12 * dz
                        q2 = c02 * dx + c12 * dy + c22 * dz
                        exponent = half_d2 * (dx * q0 + dy * q1 + dz * q2)
                        if not (exponent >= 0.0 and exponent < NEGLIGIBLE_EXPONENT):
                            continue
                        e = exp_of_negated(exponent)
                        share = -d1 * e
                        w = d1_d2 * e
                        v = w * d2
                        total += share
                        best = max(best, share)
                        g0 += w * q0
                        g1 += w * q1
                        g2 += w * q2
                        h00 += w * c00 - v * q0 * q0
                        h01 += w * c01 - v * q0 * q1
                        h02 += w * c02 - v * q0 * q2
                        h11 += w * c11 - v * q1 * q1
                        h12 += w * c12 - v * q1 * q2
                        h22 += w * c22 - v * q2 * q2
            if count == 0:
                continue
            found += 1
            neighbours += min(count, most)
            if count > most:
                cut_points += 1
                cut_neighbours += count - most
                add_nearest(
                    px, py, pz, i, j, k, table, origins, box, column_start, column_cell, columns, radius2,
                    d1, d2, near, near_inverse, crowd,
                )  # fmt: skip
                total = crowd[0]
                best = crowd[1]
                g0 = crowd[2]
                g1 = crowd[3]
                g2 = crowd[4]
                h00 = crowd[5]
                h01 = crowd[6]
                h02 = crowd[7]
                h11 = crowd[8]
                h12 = crowd[9]
                h22 = crowd[10]
            score += total
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
            ry = m010 * x + m011 * y + m012 * z
            rz = m020 * x + m021 * y + m022 * z
            ux = m100 * x + m101 * y + m102 * z
            uy = m110 * x + m111 * y + m112 * z
            uz = m120 * x + m121 * y + m122 * z
            wx = m200 * x + m201 * y
            wy = m210 * x + m211 * y
            wz = m220 * x + m221 * y
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
            j00 += l00
            j01 += l01
            j02 += l02
            j10 += l10
            j11 += l11
            j12 += l12
            j20 += l20
            j21 += l21
            j22 += l22
            # J^T B J
            r00 += ry * l10 + rz * l20
            r01 += ry * l11 + rz * l21
            r02 += ry * l12 + rz * l22
            r11 += ux * l01 + uy * l11 + uz * l21
            r12 += ux * l02 + uy * l12 + uz * l22
            r22 += wx * l02 + wy * l12 + wz * l22
        row = rows[unit]
        row[0], row[1], row[2], row[3], row[4], row[5] = (
            score, nearest, found, neighbours, cut_points, cut_neighbours,
        )  # fmt: skip
        row[6], row[7], row[8] = a0, a1, a2
        row[9], row[10], row[11] = s00, s01, s02
        row[12], row[13], row[14] = s10, s11, s12
        row[15], row[16], row[17] = s20, s21, s22
        row[18], row[19], row[20], row[21], row[22], row[23] = b00, b01, b02, b11, b12, b22
        row[24], row[25], row[26] = j00, j01, j02
        row[27], row[28], row[29] = j10, j11, j12
        row[30], row[31], row[32] = j20, j21, j22
        row[33], row[34], row[35], row[36], row[37], row[38] = r00, r01, r02, r11, r12, r22


def loaded_from_cache() -> bool:
    """Whether the kernel came from numba's cache, not from the compiler."""
    return bool(accumulate.stats.cache_hits)  # type: ignore[attr-defined]
