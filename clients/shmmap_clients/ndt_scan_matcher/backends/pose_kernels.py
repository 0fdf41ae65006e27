# SPDX-License-Identifier: Apache-2.0
"""What is computed once a pose, compiled: its rotation's derivatives, its sums' contraction, the next step.

In Python these are some hundred small operations an evaluation, and their code is what has left the
processor's caches by the time of the next scan.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numba import types

from shmmap.compiling import compiled, read_only
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import FLAT, SINGULAR, SMALL_ANGLE

__all__ = ["CONTRACTED", "contract", "derive", "step_into"]

CONTRACTED: Final = 48  # score, nearest, four counts; gradient; Hessian
_SWEEPS: Final = 30  # of Jacobi's method; six are enough for any matrix of six rows
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
    types.float64[:, ::1],  # what they come to
)
_STEP: Final = types.void(
    read_only(types.float64, 2),  # Hessian
    read_only(types.float64, 1),  # gradient
    types.boolean,  # steady
    types.float64[::1],  # the step
)


@compiled(_DERIVE, boundscheck=False)
def derive(poses: Any, pitch_sign: Any, T: Any, M: Any) -> None:
    """Write each pose's matrix, and its `derivatives_of_poses`, at the beginning of T and M."""
    for pose in range(poses.shape[0]):
        roll, pitch, yaw = poses[pose, 3], poses[pose, 4], poses[pose, 5]
        cx, sx = math.cos(roll), math.sin(roll)
        cy, sy = math.cos(pitch), math.sin(pitch)
        cz, sz = math.cos(yaw), math.sin(yaw)
        t = T[pose]
        t[0, 0], t[0, 1], t[0, 2], t[0, 3] = cy * cz, -cy * sz, sy, poses[pose, 0]
        t[1, 0], t[1, 1], t[1, 2], t[1, 3] = (
            cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, poses[pose, 1],
        )  # fmt: skip
        t[2, 0], t[2, 1], t[2, 2], t[2, 3] = (
            sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy, poses[pose, 2],
        )  # fmt: skip
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
    """Add each pose's rows in their order, and write what they come to, see `evaluations_of`."""
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


@compiled(_STEP, boundscheck=False)
def step_into(hessian: Any, gradient: Any, steady: Any, step: Any) -> None:
    """Write `upward_step` if steady, else `newton_step`.

    A symmetric matrix's singular values are its eigenvalues' magnitudes: both steps come from these, and they
    from Jacobi's method, which has them to the last digits also where translations and rotations differ by
    orders of magnitude (Demmel and Veselic 1992).
    """
    a = hessian.copy()
    v = np.eye(6)
    for i in range(6):
        for j in range(6):
            if not np.isfinite(a[i, j]):
                step[:] = np.nan
                return
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
