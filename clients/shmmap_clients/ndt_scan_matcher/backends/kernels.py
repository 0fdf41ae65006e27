# SPDX-License-Identifier: Apache-2.0
"""The compiled loops: neighbours, score, gradient and Hessian in one pass over the points; work per pose.

Importing this module compiles the kernels, or loads them from numba's cache within tenths of a second.

The loop over points keeps all values that it reads repeatedly in local variables: a compiler that cannot
exclude aliasing would reload them from the arrays after each store.  So the loop is one long function.

Work done once per pose (derivatives of the rotation, sum over the points, the next step) is compiled, too.
In Python this would be about a hundred small operations, and their code would no longer be in the
processor's caches at the next scan.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import types

from shmmap.compiling import compiled, inlined, read_only
from shmmap_clients.elements_at import float64_at, int32_at
from shmmap_clients.ndt_scan_matcher.backends.crowded_kernel import MAP, SCRATCH, add_nearest, exp_of_negated
from shmmap_clients.ndt_scan_matcher.matching.evaluation import NEGLIGIBLE_EXPONENT
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import FLAT, SINGULAR, SMALL_ANGLE

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
CONTRACTED: Final = 48  # score, nearest, four counts; gradient; Hessian
_SWEEPS: Final = 30  # limit for Jacobi's method; six are enough for any matrix of six rows
_EPSILON: Final = float(np.finfo(np.float64).eps)
_TINY: Final = float(np.finfo(np.float64).tiny)
_DERIVE: Final = types.void(
    read_only(types.float64, 2),  # poses
    types.float64,  # pitch sign
    types.float64[:, :, ::1],  # T
    types.float64[:, :, :, ::1],  # M
)
_CONTRACT: Final = types.void(
    read_only(types.float64, 2),  # rows
    types.int64,  # chunks of the source
    read_only(types.float64, 4),  # M
    types.float64[:, ::1],  # contracted sums of each pose
)
_STEP: Final = types.void(
    read_only(types.float64, 2),  # Hessian
    read_only(types.float64, 1),  # gradient
    types.boolean,  # steady
    types.float64[::1],  # the step
)


@compiled(_SIGNATURE, boundscheck=False, fastmath={"contract"})
def accumulate(
    source: Any,
    chunks: Any,
    chunk_points: Any,
    first: Any,
    last: Any,
    T: Any,
    M: Any,
    inverse_leaf: Any,
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
    rows: Any,
) -> None:
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
        known = -1  # cell whose table row is in local variables
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
            # outside the map or not a number; this test also keeps the conversions to integers defined
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
                    px,
                    py,
                    pz,
                    i,
                    j,
                    k,
                    table,
                    origins,
                    box,
                    column_start,
                    column_cell,
                    columns,
                    radius2,
                    d1,
                    d2,
                    near,
                    near_inverse,
                    crowd,
                )
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
            score,
            nearest,
            found,
            neighbours,
            cut_points,
            cut_neighbours,
        )
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
    """Return whether the kernel was loaded from numba's cache, not compiled."""
    return bool(accumulate.stats.cache_hits)  # type: ignore[attr-defined]


@compiled(_DERIVE, boundscheck=False)
def derive(poses: Any, pitch_sign: Any, T: Any, M: Any) -> None:
    """Write each pose's matrix to T and its `derivatives_of_poses` to M, from row 0."""
    for pose in range(poses.shape[0]):
        roll, pitch, yaw = poses[pose, 3], poses[pose, 4], poses[pose, 5]
        cx, sx = math.cos(roll), math.sin(roll)
        cy, sy = math.cos(pitch), math.sin(pitch)
        cz, sz = math.cos(yaw), math.sin(yaw)
        t = T[pose]
        t[0, 0], t[0, 1], t[0, 2], t[0, 3] = cy * cz, -cy * sz, sy, poses[pose, 0]
        t[1, 0], t[1, 1], t[1, 2], t[1, 3] = (
            cx * sz + sx * sy * cz,
            cx * cz - sx * sy * sz,
            -sx * cy,
            poses[pose, 1],
        )
        t[2, 0], t[2, 1], t[2, 2], t[2, 3] = (
            sx * sz - cx * sy * cz,
            cx * sy * sz + sx * cz,
            cx * cy,
            poses[pose, 2],
        )
        t[3, 0] = t[3, 1] = t[3, 2] = 0.0
        t[3, 3] = 1.0
        if abs(roll) < SMALL_ANGLE:
            cx, sx = 1.0, 0.0
        if abs(pitch) < SMALL_ANGLE:
            cy, sy = 1.0, 0.0
        if abs(yaw) < SMALL_ANGLE:
            cz, sz = 1.0, 0.0
        m = M[pose]
        a0, a1, a2 = -sx * sz + cx * sy * cz, -sx * cz - cx * sy * sz, -cx * cy
        b0, b1, b2 = cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy
        d0, d1, d2 = sx * cy * cz, -sx * cy * sz, sx * sy
        e0, e1, e2 = -cx * cy * cz, cx * cy * sz, -cx * sy
        g0, g1 = cx * cz - sx * sy * sz, -cx * sz - sx * sy * cz
        h0, h1 = sx * cz + cx * sy * sz, cx * sy * cz - sx * sz
        for matrix in (0, 3, 4, 5):
            m[matrix, 0, 0] = m[matrix, 0, 1] = m[matrix, 0, 2] = 0.0
        # roll, pitch, yaw
        m[0, 1, 0], m[0, 1, 1], m[0, 1, 2] = a0, a1, a2
        m[0, 2, 0], m[0, 2, 1], m[0, 2, 2] = b0, b1, b2
        m[1, 0, 0], m[1, 0, 1], m[1, 0, 2] = -sy * cz, sy * sz, cy
        m[1, 1, 0], m[1, 1, 1], m[1, 1, 2] = d0, d1, d2
        m[1, 2, 0], m[1, 2, 1], m[1, 2, 2] = e0, e1, e2
        m[2, 0, 0], m[2, 0, 1], m[2, 0, 2] = -cy * sz, -cy * cz, 0.0
        m[2, 1, 0], m[2, 1, 1], m[2, 1, 2] = g0, g1, 0.0
        m[2, 2, 0], m[2, 2, 1], m[2, 2, 2] = h0, h1, 0.0
        # roll-roll, roll-pitch, roll-yaw
        m[3, 1, 0], m[3, 1, 1], m[3, 1, 2] = -b0, -b1, -b2
        m[3, 2, 0], m[3, 2, 1], m[3, 2, 2] = a0, a1, a2
        m[4, 1, 0], m[4, 1, 1], m[4, 1, 2] = cx * cy * cz, -cx * cy * sz, cx * sy
        m[4, 2, 0], m[4, 2, 1], m[4, 2, 2] = d0, d1, d2
        m[5, 1, 0], m[5, 1, 1], m[5, 1, 2] = -sx * cz - cx * sy * sz, sx * sz - cx * sy * cz, 0.0
        m[5, 2, 0], m[5, 2, 1], m[5, 2, 2] = g0, g1, 0.0
        # pitch-pitch, pitch-yaw, yaw-yaw
        m[6, 0, 0], m[6, 0, 1], m[6, 0, 2] = -cy * cz, cy * sz, pitch_sign * sy
        m[6, 1, 0], m[6, 1, 1], m[6, 1, 2] = -sx * sy * cz, sx * sy * sz, sx * cy
        m[6, 2, 0], m[6, 2, 1], m[6, 2, 2] = cx * sy * cz, -cx * sy * sz, -cx * cy
        m[7, 0, 0], m[7, 0, 1], m[7, 0, 2] = sy * sz, sy * cz, 0.0
        m[7, 1, 0], m[7, 1, 1], m[7, 1, 2] = -sx * cy * sz, -sx * cy * cz, 0.0
        m[7, 2, 0], m[7, 2, 1], m[7, 2, 2] = cx * cy * sz, cx * cy * cz, 0.0
        m[8, 0, 0], m[8, 0, 1], m[8, 0, 2] = -cy * cz, cy * sz, 0.0
        m[8, 1, 0], m[8, 1, 1], m[8, 1, 2] = -cx * sz - sx * sy * cz, -cx * cz + sx * sy * sz, 0.0
        m[8, 2, 0], m[8, 2, 1], m[8, 2, 2] = -sx * sz + cx * sy * cz, -cx * sy * sz - sx * cz, 0.0


@compiled(_CONTRACT, boundscheck=False)
def contract(rows: Any, chunks: Any, M: Any, found: Any) -> None:
    """Add each pose's rows in order, and write the contracted sums, see `evaluations_of`."""
    sums = np.empty(39)
    rotation = np.empty(9)
    for pose in range(found.shape[0]):
        sums[:] = 0.0
        for row in range(pose * chunks, (pose + 1) * chunks):
            for slot in range(39):
                sums[slot] += rows[row, slot]
        for matrix in range(9):
            value = 0.0
            for i in range(3):
                for j in range(3):
                    value += M[pose, matrix, i, j] * sums[9 + 3 * i + j]
            rotation[matrix] = value
        out = found[pose]
        for slot in range(9):
            out[slot] = sums[slot]
        out[9], out[10], out[11] = rotation[0], rotation[1], rotation[2]
        h = out[12:].reshape((6, 6))
        at = 0
        for i in range(3):
            for j in range(i, 3):
                h[i, j] = h[j, i] = sums[18 + at]
                h[3 + i, 3 + j] = h[3 + j, 3 + i] = sums[33 + at] + rotation[3 + at]
                at += 1
            for j in range(3):
                h[i, 3 + j] = h[3 + j, i] = sums[24 + 3 * i + j]


@inlined
def _diagonalize(a: Any, v: Any) -> None:
    """Diagonalize the symmetric ``a`` in place; the columns of ``v`` become its eigenvectors.

    ``v`` must be the identity.  Jacobi's method is accurate to the last digits even where translations and
    rotations differ by orders of magnitude (Demmel and Veselic 1992).
    """
    for _ in range(_SWEEPS):
        rotated = False
        for p in range(5):
            for q in range(p + 1, 6):
                apq = a[p, q]
                if (
                    abs(apq) <= _EPSILON * math.sqrt(abs(a[p, p])) * math.sqrt(abs(a[q, q]))
                    or abs(apq) < _TINY
                ):
                    continue
                rotated = True
                theta = (a[q, q] - a[p, p]) / (2.0 * apq)
                t = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(6):
                    akp, akq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * akp - s * akq, s * akp + c * akq
                for k in range(6):
                    apk, aqk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * apk - s * aqk, s * apk + c * aqk
                a[p, q] = a[q, p] = 0.0
                for k in range(6):
                    vkp, vkq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * vkp - s * vkq, s * vkp + c * vkq
        if not rotated:
            break


@compiled(_STEP, boundscheck=False)
def step_into(hessian: Any, gradient: Any, steady: Any, step: Any) -> None:
    """Write the next step: `upward_step` if steady, else `newton_step`.

    Singular values of a symmetric matrix are the magnitudes of its eigenvalues, which give both steps.
    """
    a = hessian.copy()
    v = np.eye(6)
    for i in range(6):
        for j in range(6):
            if not np.isfinite(a[i, j]):
                step[:] = np.nan
                return
    _diagonalize(a, v)
    most = 0.0
    for i in range(6):
        most = max(most, abs(a[i, i]))
    step[:] = 0.0
    if not most > 0.0:
        return
    for i in range(6):
        along = 0.0
        for k in range(6):
            along += v[k, i] * gradient[k]
        if steady:
            along /= max(abs(a[i, i]), most * FLAT)
        elif abs(a[i, i]) > max(most * SINGULAR, _TINY):
            along /= -a[i, i]
        else:
            continue
        for k in range(6):
            step[k] += along * v[k, i]
