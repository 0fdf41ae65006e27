# SPDX-License-Identifier: Apache-2.0
"""Where the next scan was probably taken: from odometry, or at constant velocity."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.scans.trajectory import Trajectory

__all__ = [
    "LONGEST_STEP_S",
    "ConstantVelocity",
    "MotionPrediction",
    "Odometry",
    "first_twist",
    "interpolate",
    "twist_between",
    "twist_on_route",
]

LONGEST_STEP_S: Final = 1.0 + 1e-3
"""Between two scans; more is a pause or a clock that was set.  A scanner of 1 Hz is not exact."""
_STEADY_S: Final = 0.5  # as Autoware's five lost scans at 10 Hz; braking hard, 0.6 m
_ON_ROUTE_M: Final = 10.0

Matrix = NDArray[np.float64]


class ConstantVelocity:
    """The next motion is the last one, scaled by the time it has, at most `LONGEST_STEP_S` of it.

    A clock that jumps says nothing of motion: a step of no time, back, or of more than that predicts none,
    and the velocity is unknown until two poses in a row are known again.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    twist : (6,), optional
        The velocity there, where it is known: metres and radians per second, base frame.

    Attributes
    ----------
    T_known : (4, 4)
        The last pose that was known: where a search for a lost vehicle begins.
    """

    def __init__(self, T_map_base: Matrix, twist: NDArray[np.float64] | None = None) -> None:
        self.T_known = T_map_base
        self._twist = twist
        self._stamp_s: float | None = None  # of the last scan
        self._since_s: float | None = (
            0.0  # from the known pose to that scan; None: the clock jumped meanwhile
        )

    def predict(self, stamp_s: float) -> Matrix:
        """Return the probable (4, 4) pose at a time, seconds."""
        elapsed_s = self._elapsed(stamp_s)
        if elapsed_s is None or self._twist is None:
            return self.T_known
        return np.asarray(self.T_known @ _moved(self._twist * min(elapsed_s, LONGEST_STEP_S)), np.float64)

    def step(self, stamp_s: float) -> float | None:
        """Return the time since the last scan, seconds; 0 for the first, None where the clock has jumped."""
        if self._stamp_s is None:
            return 0.0
        step_s = stamp_s - self._stamp_s
        return step_s if 0.0 < step_s <= LONGEST_STEP_S else None

    @property
    def knows_velocity(self) -> bool:
        """Whether there is a velocity to go by."""
        return self._twist is not None

    def is_blind(self, stamp_s: float) -> bool:
        """Whether little says how it has moved since the last known pose: no velocity, or an old one."""
        if self._stamp_s is None:
            return False
        elapsed_s = self._elapsed(stamp_s)
        return self._twist is None or elapsed_s is None or elapsed_s >= _STEADY_S

    def correct(self, stamp_s: float, T_map_base: Matrix | None) -> None:
        """Learn where a scan was taken; None: that is not known."""
        elapsed_s = self._elapsed(stamp_s)
        if elapsed_s is None or elapsed_s > LONGEST_STEP_S:
            self._twist = None
        if T_map_base is None:
            self._since_s = elapsed_s
        else:
            if elapsed_s is not None and 0.0 < elapsed_s <= LONGEST_STEP_S:
                self._twist = twist_between(self.T_known, T_map_base, elapsed_s)
            self.T_known, self._since_s = T_map_base, 0.0
        self._stamp_s = stamp_s

    def hold(self) -> None:
        """Forget the velocity: the last two poses do not give it, or are too old."""
        self._twist = None

    @property
    def velocity(self) -> tuple[float, float]:
        """Metres per second along the map's x and y; 0 where it is unknown."""
        if self._twist is None:
            return 0.0, 0.0
        v = self.T_known[:3, :3] @ self._twist[:3]
        return float(v[0]), float(v[1])

    def _elapsed(self, stamp_s: float) -> float | None:
        """Return the time since the last known pose; None where the clock has jumped since."""
        step_s = self.step(stamp_s)
        return None if step_s is None or self._since_s is None else self._since_s + step_s


class Odometry(ConstantVelocity):
    """The next motion is what the odometry says; beyond its last entry, constant velocity.

    Where the odometry's times go back, a new run begins; the motion between two runs is not known.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    odometry
        Gives what is known now: poses in any fixed frame, in order of time within each run.
    """

    def __init__(self, T_map_base: Matrix, odometry: Callable[[], Trajectory]) -> None:
        super().__init__(T_map_base)
        self._odometry = odometry
        self._run = 0  # of the odometry, that the scans have come to

    def predict(self, stamp_s: float) -> Matrix:
        """Return the probable (4, 4) pose at a time, seconds."""
        motion = self._motion(stamp_s)
        return super().predict(stamp_s) if motion is None else np.asarray(self.T_known @ motion, np.float64)

    def is_blind(self, stamp_s: float) -> bool:
        """Whether neither odometry nor a velocity says how the vehicle has moved."""
        return super().is_blind(stamp_s) and self._motion(stamp_s) is None

    def correct(self, stamp_s: float, T_map_base: Matrix | None) -> None:
        """Learn where a scan was taken; None: as far as odometry says from the last known pose."""
        if T_map_base is None and (motion := self._motion(stamp_s)) is not None:
            T_map_base = np.asarray(self.T_known @ motion, np.float64)
        if self._stamp_s is not None and stamp_s < self._stamp_s:
            self._run += 1
        super().correct(stamp_s, T_map_base)

    def _motion(self, stamp_s: float) -> Matrix | None:
        """Return the motion since the last scan, (4, 4); None where the odometry does not have it."""
        if self._stamp_s is None or self._since_s != 0.0 or stamp_s <= self._stamp_s:
            return None
        known = self._odometry()
        ends = [*(np.flatnonzero(np.diff(known.stamps_s) < 0) + 1).tolist(), len(known)]
        for run in range(min(self._run, len(ends) - 1), len(ends)):
            part = slice(ends[run - 1] if run else 0, ends[run])
            entries = Trajectory(known.stamps_s[part], known.T_map_sensor[part])
            before, now = (interpolate(entries, s) for s in (self._stamp_s, stamp_s))
            if before is not None and now is not None:
                self._run = run
                return np.asarray(np.linalg.inv(before) @ now, np.float64)
        return None


MotionPrediction = ConstantVelocity


def twist_between(T_before: Matrix, T_after: Matrix, seconds: float) -> NDArray[np.float64]:
    """Return the velocity that leads from one pose to another, (6,), metres and radians per second."""
    return _motion(np.linalg.inv(T_before) @ T_after) / seconds


def first_twist(drive: Trajectory) -> NDArray[np.float64] | None:
    """Return the velocity at the first pose of a drive; None where the first two times do not say it."""
    seconds = float(drive.stamps_s[1] - drive.stamps_s[0]) if len(drive) > 1 else 0.0
    if not 0.0 < seconds <= LONGEST_STEP_S:
        return None
    return twist_between(drive.T_map_sensor[0], drive.T_map_sensor[1], seconds)


def twist_on_route(route: Trajectory, T_map_base: Matrix) -> NDArray[np.float64] | None:
    """Return the velocity of a vehicle that is on a route as its times say; None where they do not say it.

    Parameters
    ----------
    route
        Poses that will be passed; only places and times are used.
    T_map_base : (4, 4)
        Where it is.
    """
    away = np.linalg.norm(route.T_map_sensor[:, :2, 3] - T_map_base[:2, 3], axis=1)
    nearest = min(int(np.argmin(away)), max(0, len(route) - 2))
    if len(route) < 2 or away[nearest] > _ON_ROUTE_M:
        return None
    seconds = float(route.stamps_s[nearest + 1] - route.stamps_s[nearest])
    metres = route.T_map_sensor[nearest + 1, :3, 3] - route.T_map_sensor[nearest, :3, 3]
    if not 0.0 < seconds <= LONGEST_STEP_S:
        return None
    return np.concatenate([T_map_base[:3, :3].T @ metres / seconds, np.zeros(3)])


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
    """Return the translation and rotation vector of a transform, (6,)."""
    R = T[:3, :3]
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(axis)) / 2.0, (float(np.trace(R)) - 1.0) / 2.0
    angle = math.atan2(sine, cosine)
    # near half a turn the axis is lost; no vehicle turns so far between two scans
    scale = 0.5 if sine < 1e-9 else angle / (2.0 * sine)
    return np.concatenate([T[:3, 3], axis * scale])


def _moved(motion: NDArray[np.float64]) -> Matrix:
    """Return the transform, (4, 4), of a translation and a rotation vector (Rodrigues)."""
    x, y, z = motion[3:]
    angle = math.sqrt(x * x + y * y + z * z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    if angle > 1e-12:
        T[:3, :3] += math.sin(angle) / angle * K + (1 - math.cos(angle)) / angle**2 * (K @ K)
    T[:3, 3] = motion[:3]
    return T
