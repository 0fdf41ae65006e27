# SPDX-License-Identifier: Apache-2.0
"""Where the next scan was probably taken: from odometry, or at constant velocity."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.scans.trajectory import Trajectory

__all__ = ["ConstantVelocity", "MotionPrediction", "Odometry", "interpolate"]

Matrix = NDArray[np.float64]


class ConstantVelocity:
    """The next motion is the last one, scaled by the time it has.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    """

    def __init__(self, T_map_base: Matrix) -> None:
        self._last = T_map_base
        self._stamp_s: float | None = None
        self._twist = np.zeros(6)  # metres and radians per second, base frame

    def predict(self, stamp_s: float) -> Matrix:
        """Return the probable (4, 4) pose at a time, seconds."""
        if self._stamp_s is None:
            return self._last
        return np.asarray(self._last @ _moved(self._twist * (stamp_s - self._stamp_s)), np.float64)

    def correct(self, stamp_s: float, T_map_base: Matrix) -> None:
        """Learn where it was."""
        if self._stamp_s is not None and stamp_s > self._stamp_s:
            self._twist = _motion(np.linalg.inv(self._last) @ T_map_base) / (stamp_s - self._stamp_s)
        self._last, self._stamp_s = T_map_base, stamp_s

    def hold(self) -> None:
        """Forget the velocity: the last two poses do not tell it, or it was long ago."""
        self._twist = np.zeros(6)

    @property
    def velocity(self) -> tuple[float, float]:
        """Metres per second along the map's x and y."""
        v = self._last[:3, :3] @ self._twist[:3]
        return float(v[0]), float(v[1])


class Odometry(ConstantVelocity):
    """The next motion is what the odometry says; beyond its last entry, constant velocity.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    odometry
        Gives what is known now: poses in any fixed frame, in order of time.
    """

    def __init__(self, T_map_base: Matrix, odometry: Callable[[], Trajectory]) -> None:
        super().__init__(T_map_base)
        self._odometry = odometry

    def predict(self, stamp_s: float) -> Matrix:
        """Return the probable (4, 4) pose at a time, seconds."""
        if self._stamp_s is None:
            return self._last
        known = self._odometry()
        before, now = (interpolate(known, s) for s in (self._stamp_s, stamp_s))
        if before is None or now is None:
            return super().predict(stamp_s)
        return np.asarray(self._last @ np.linalg.inv(before) @ now, np.float64)


MotionPrediction = ConstantVelocity


def interpolate(trajectory: Trajectory, stamp_s: float) -> Matrix | None:
    """Return the pose at a time between two entries; None outside of them."""
    stamps = trajectory.stamps_s
    if not len(stamps) or stamp_s < stamps[0] or stamp_s > stamps[-1]:
        return None
    after = int(np.searchsorted(stamps, stamp_s))
    if stamps[after] == stamp_s:
        return np.asarray(trajectory.T_map_sensor[after], np.float64)
    a, b = trajectory.T_map_sensor[after - 1], trajectory.T_map_sensor[after]
    share = (stamp_s - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
    return np.asarray(a @ _moved(_motion(np.linalg.inv(a) @ b) * share), np.float64)


def _motion(T: Matrix) -> NDArray[np.float64]:
    """Translation and rotation vector of a transform."""
    R = T[:3, :3]
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(axis)) / 2.0, (float(np.trace(R)) - 1.0) / 2.0
    angle = math.atan2(sine, cosine)
    # near half a turn the axis is lost; no vehicle turns so far between two scans
    scale = 0.5 if sine < 1e-9 else angle / (2.0 * sine)
    return np.concatenate([T[:3, 3], axis * scale])


def _moved(motion: NDArray[np.float64]) -> Matrix:
    """The transform of a translation and a rotation vector (Rodrigues)."""
    x, y, z = motion[3:]
    angle = math.sqrt(x * x + y * y + z * z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    if angle > 1e-12:
        T[:3, :3] += math.sin(angle) / angle * K + (1 - math.cos(angle)) / angle**2 * (K @ K)
    T[:3, 3] = motion[:3]
    return T
