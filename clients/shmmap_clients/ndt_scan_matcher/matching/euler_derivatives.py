# SPDX-License-Identifier: Apache-2.0
"""Poses as six numbers, and how a rotated point moves with them.

A pose vector is (x, y, z, roll, pitch, yaw), metres and radians, with R = Rx(roll) Ry(pitch) Rz(yaw), as
PCL, ndt_omp and Autoware have it; first and second derivatives are eq. 6.19 and 6.21 of Magnusson 2009.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["SMALL_ANGLE", "euler_derivatives", "matrix_from_pose", "pose_from_matrix"]

SMALL_ANGLE: Final = 10e-5  # below it the originals take the angle for zero in derivatives


def _sines(pose: NDArray[np.float64], small: float) -> tuple[float, ...]:
    values: list[float] = []
    for angle in pose[3:6].tolist():
        values += (1.0, 0.0) if abs(angle) < small else (math.cos(angle), math.sin(angle))
    return tuple(values)


def matrix_from_pose(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a pose vector."""
    cx, sx, cy, sy, cz, sz = _sines(pose, 0.0)
    x, y, z = pose[:3].tolist()
    return np.array(
        [
            [cy * cz, -cy * sz, sy, x],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, y],
            [sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def pose_from_matrix(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the pose vector of a (4, 4) transform; pitch lies within a quarter turn."""
    matrix = np.asarray(T, np.float64)
    roll = math.atan2(-matrix[1, 2], matrix[2, 2])
    pitch = math.atan2(matrix[0, 2], math.hypot(matrix[0, 0], matrix[0, 1]))
    yaw = math.atan2(-matrix[0, 1], matrix[0, 0])
    return np.array([*matrix[:3, 3], roll, pitch, yaw])


def euler_derivatives(pose: NDArray[np.float64], pitch_sign: float = -1.0) -> NDArray[np.float64]:
    """Return nine matrices M with d(Rx)/dp = M x and d2(Rx)/dpdq = M x.

    Parameters
    ----------
    pose : (6,) float64
    pitch_sign
        Sign of the sine in the second derivative after pitch: -1 is right, +1 is what ndt_omp has.

    Returns
    -------
    (9, 3, 3) float64
        After roll, pitch, yaw; then roll-roll, roll-pitch, roll-yaw, pitch-pitch, pitch-yaw, yaw-yaw.
    """
    cx, sx, cy, sy, cz, sz = _sines(pose, SMALL_ANGLE)
    a = (-sx * sz + cx * sy * cz, -sx * cz - cx * sy * sz, -cx * cy)
    b = (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy)
    d = (sx * cy * cz, -sx * cy * sz, sx * sy)
    e = (-cx * cy * cz, cx * cy * sz, -cx * sy)
    g = (cx * cz - sx * sy * sz, -cx * sz - sx * sy * cz, 0.0)
    h = (sx * cz + cx * sy * sz, cx * sy * cz - sx * sz, 0.0)
    none = (0.0, 0.0, 0.0)
    return np.array(
        [
            [none, a, b],
            [(-sy * cz, sy * sz, cy), d, e],
            [(-cy * sz, -cy * cz, 0.0), g, h],
            # roll-roll
            [none, (-b[0], -b[1], -b[2]), a],
            # roll-pitch
            [none, (cx * cy * cz, -cx * cy * sz, cx * sy), d],
            # roll-yaw
            [none, (-sx * cz - cx * sy * sz, sx * sz - cx * sy * cz, 0.0), g],
            # pitch-pitch
            [
                (-cy * cz, cy * sz, pitch_sign * sy),
                (-sx * sy * cz, sx * sy * sz, sx * cy),
                (cx * sy * cz, -cx * sy * sz, -cx * cy),
            ],
            # pitch-yaw
            [(sy * sz, sy * cz, 0.0), (-sx * cy * sz, -sx * cy * cz, 0.0), (cx * cy * sz, cx * cy * cz, 0.0)],
            # yaw-yaw
            [
                (-cy * cz, cy * sz, 0.0),
                (-cx * sz - sx * sy * cz, -cx * cz + sx * sy * sz, 0.0),
                (-sx * sz + cx * sy * cz, -cx * sy * sz - sx * cz, 0.0),
            ],
        ]
    )
