# SPDX-License-Identifier: Apache-2.0
"""Computations per pose by whole-array operations: matrices, derivatives, evaluations, the next step.

The result of a pose is the same to the bit, alone or in a batch.  First and second derivatives
are eq. 6.19 and 6.21 of Magnusson 2009.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    AX,
    BJ,
    CUT_NEIGHBOURS,
    CUT_POINTS,
    FOUND,
    JBJ,
    NEAREST,
    NEIGHBOURS,
    SCORE,
    A,
    B,
    Evaluation,
)

SMALL_ANGLE: Final = 10e-5  # below it, derivatives in the originals take the angle as zero
# threshold of zero in Eigen's JacobiSVD: as many roundings as the matrix has rows
SINGULAR: Final = 6 * float(np.finfo(np.float64).eps)

FLAT: Final = 1e-9  # least ratio to the greatest curvature that a step divides by

# index of the Hessian's elements among b (6), bj (9) and the rotation's (6)
_HESSIAN: Final = np.array(
    [
        [0, 1, 2, 6, 7, 8],
        [1, 3, 4, 9, 10, 11],
        [2, 4, 5, 12, 13, 14],
        [6, 9, 12, 15, 16, 17],
        [7, 10, 13, 16, 18, 19],
        [8, 11, 14, 17, 19, 20],
    ]
)


def _sines(poses: NDArray[np.float64], small: float) -> list[NDArray[np.float64]]:
    found = []
    for angles in poses[:, 3:6].T.tolist():
        near = [abs(angle) < small for angle in angles]
        found.append(np.array([1.0 if zero else math.cos(a) for a, zero in zip(angles, near, strict=True)]))
        found.append(np.array([0.0 if zero else math.sin(a) for a, zero in zip(angles, near, strict=True)]))
    return found


def matrices_from_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (k, 4, 4) transforms of (k, 6) pose vectors, as `matrix_from_pose`."""
    cx, sx, cy, sy, cz, sz = _sines(poses, 0.0)
    T = np.zeros((len(poses), 4, 4))
    T[:, 0, :3] = np.stack([cy * cz, -cy * sz, sy], axis=1)
    T[:, 1, :3] = np.stack([cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy], axis=1)
    T[:, 2, :3] = np.stack([sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy], axis=1)
    T[:, :3, 3] = poses[:, :3]
    T[:, 3, 3] = 1.0
    return T


def derivatives_of_poses(poses: NDArray[np.float64], pitch_sign: float = -1.0) -> NDArray[np.float64]:
    """Return nine matrices M of each pose with d(Rx)/dp = M x and d2(Rx)/dpdq = M x.

    Parameters
    ----------
    poses : (k, 6) float64
    pitch_sign
        As in `Scoring`.

    Returns
    -------
    (k, 9, 3, 3) float64
        By roll, pitch, yaw; then roll-roll, roll-pitch, roll-yaw, pitch-pitch, pitch-yaw, yaw-yaw.
    """
    cx, sx, cy, sy, cz, sz = _sines(poses, SMALL_ANGLE)
    none = np.zeros(len(poses))
    a = (-sx * sz + cx * sy * cz, -sx * cz - cx * sy * sz, -cx * cy)
    b = (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy)
    d = (sx * cy * cz, -sx * cy * sz, sx * sy)
    e = (-cx * cy * cz, cx * cy * sz, -cx * sy)
    g = (cx * cz - sx * sy * sz, -cx * sz - sx * sy * cz, none)
    h = (sx * cz + cx * sy * sz, cx * sy * cz - sx * sz, none)
    nothing = (none, none, none)
    rows = (
        *(nothing, a, b),
        *((-sy * cz, sy * sz, cy), d, e),
        *((-cy * sz, -cy * cz, none), g, h),
        *(nothing, (-b[0], -b[1], -b[2]), a),
        *(nothing, (cx * cy * cz, -cx * cy * sz, cx * sy), d),
        *(nothing, (-sx * cz - cx * sy * sz, sx * sz - cx * sy * cz, none), g),
        *((-cy * cz, cy * sz, pitch_sign * sy), (-sx * sy * cz, sx * sy * sz, sx * cy)),
        (cx * sy * cz, -cx * sy * sz, -cx * cy),
        *((sy * sz, sy * cz, none), (-sx * cy * sz, -sx * cy * cz, none), (cx * cy * sz, cx * cy * cz, none)),
        *((-cy * cz, cy * sz, none), (-cx * sz - sx * sy * cz, -cx * cz + sx * sy * sz, none)),
        (-sx * sz + cx * sy * cz, -cx * sy * sz - sx * cz, none),
    )
    flat = np.stack([value for row in rows for value in row], axis=1)
    return flat.reshape(-1, 9, 3, 3)


def evaluations_of(rows: NDArray[np.floating], derivatives: NDArray[np.float64]) -> list[Evaluation]:
    """Add rows of sums, in their order, and contract them to evaluations.

    Parameters
    ----------
    rows : (k, chunks, SUMS)
        Rows of each pose.
    derivatives : (k, 9, 3, 3) float64
        Output of `derivatives_of_poses`.
    """
    number, chunks, width = rows.shape
    sums = np.zeros((number, width))
    if chunks:
        sums = np.add.accumulate(rows, axis=1, dtype=np.float64)[:, -1]
    contracted = (derivatives.reshape(-1, 9, 9) * sums[:, None, AX]).sum(axis=2)
    gradients = np.concatenate([sums[:, A], contracted[:, :3]], axis=1)
    parts = np.concatenate([sums[:, B], sums[:, BJ], sums[:, JBJ] + contracted[:, 3:]], axis=1)
    hessians = parts[:, _HESSIAN]
    return [
        Evaluation(
            score=values[SCORE],
            gradient=gradient,
            hessian=hessian,
            nearest=values[NEAREST],
            found=int(values[FOUND]),
            neighbours=int(values[NEIGHBOURS]),
            cut_points=int(values[CUT_POINTS]),
            cut_neighbours=int(values[CUT_NEIGHBOURS]),
        )
        for values, gradient, hessian in zip(sums[:, :6].tolist(), gradients, hessians, strict=True)
    ]


def newton_step(at: Evaluation) -> NDArray[np.float64]:
    """Solve H step = -gradient in the least-squares sense, as JacobiSVD does."""
    if not np.isfinite(at.hessian).all():
        return np.full(6, np.nan)
    u, s, vt = np.linalg.svd(at.hessian)
    if not s[0] > 0:
        return np.zeros(6)
    usable = s > max(s[0] * SINGULAR, np.finfo(np.float64).tiny)
    coefficients = np.zeros(6)
    coefficients[usable] = (u.T @ -at.gradient)[usable] / s[usable]
    return np.asarray(vt.T @ coefficients, np.float64)


def upward_step(at: Evaluation) -> NDArray[np.float64]:
    """Return the step to the peak of a paraboloid that curves down by the Hessian's magnitudes."""
    if not np.isfinite(at.hessian).all():
        return np.full(6, np.nan)
    values, vectors = np.linalg.eigh(at.hessian)
    curvature = np.abs(values)
    if not curvature.max() > 0:
        return np.zeros(6)
    curvature = np.maximum(curvature, curvature.max() * FLAT)
    return np.asarray(vectors @ ((vectors.T @ at.gradient) / curvature), np.float64)


def numpy_step(at: Evaluation, steady: bool) -> NDArray[np.float64]:
    """Return the next step: `upward_step` if steady, else `newton_step`."""
    return upward_step(at) if steady else newton_step(at)
