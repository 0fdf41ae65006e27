# SPDX-License-Identifier: Apache-2.0
"""Prediction of the next scan's pose: from odometry, or at constant velocity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.scans.trajectory import Trajectory, interpolate, motion_of, moved

LONGEST_STEP_S: Final = 1.0 + 1e-3
"""Longest time between two scans of a 1 Hz scanner, with tolerance; more is a pause or a clock jump."""
_STEADY_S: Final = 0.5  # Autoware's five lost scans at 10 Hz; hard braking changes the path by 0.6 m
_ON_ROUTE_M: Final = 10.0

Matrix = NDArray[np.float64]


class ConstantVelocity:
    """Predict that the last motion continues, scaled to the next time step, at most `LONGEST_STEP_S`.

    A clock jump gives no motion: after a step that is zero, negative or longer than that, the pose is
    unchanged, and the velocity is unknown until two consecutive poses are known again.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    twist : (6,), optional
        Velocity at the first pose, if known: metres and radians per second, base frame.

    Attributes
    ----------
    T_known : (4, 4)
        The last known pose, where a search for a lost vehicle begins.
    """

    def __init__(self, T_map_base: Matrix, twist: NDArray[np.float64] | None = None) -> None:
        self.restart(T_map_base, twist)

    def restart(self, T_map_base: Matrix, twist: NDArray[np.float64] | None = None) -> None:
        """Begin again at a pose, as for the first scan."""
        self.T_known = T_map_base
        self._twist = twist
        self._stamp_s: float | None = None  # of the last scan
        self._since_s: float | None = (
            0.0  # from the last known pose to the last scan; None: the clock jumped meanwhile
        )

    def predict(self, stamp_s: float) -> Matrix:
        """Return the predicted (4, 4) pose at a time, seconds."""
        elapsed_s = self._elapsed(stamp_s)
        if elapsed_s is None or self._twist is None:
            return self.T_known
        return np.asarray(self.T_known @ moved(self._twist * min(elapsed_s, LONGEST_STEP_S)), np.float64)

    def step(self, stamp_s: float) -> float | None:
        """Return the time since the last scan, seconds; 0 for the first, None where the clock has jumped."""
        if self._stamp_s is None:
            return 0.0
        step_s = stamp_s - self._stamp_s
        return step_s if 0.0 < step_s <= LONGEST_STEP_S else None

    @property
    def knows_velocity(self) -> bool:
        """Whether the velocity is known."""
        return self._twist is not None

    def is_blind(self, stamp_s: float) -> bool:
        """Whether the motion since the last known pose is uncertain: no velocity, or an old one."""
        if self._stamp_s is None:
            return False
        elapsed_s = self._elapsed(stamp_s)
        return self._twist is None or elapsed_s is None or elapsed_s >= _STEADY_S

    def correct(self, stamp_s: float, T_map_base: Matrix | None) -> None:
        """Record the pose of a scan; None if it is unknown."""
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
        """Forget the velocity, because the last two poses do not give one or are too old."""
        self._twist = None

    @property
    def velocity(self) -> tuple[float, float]:
        """Velocity along the map's x and y, metres per second; 0 if unknown."""
        if self._twist is None:
            return 0.0, 0.0
        v = self.T_known[:3, :3] @ self._twist[:3]
        return float(v[0]), float(v[1])

    def _elapsed(self, stamp_s: float) -> float | None:
        """Return the time since the last known pose; None if the clock has jumped since."""
        step_s = self.step(stamp_s)
        return None if step_s is None or self._since_s is None else self._since_s + step_s


class Odometry(ConstantVelocity):
    """Predict the motion from odometry; beyond its last entry, at constant velocity.

    A step back in the odometry's times begins a new run; the motion between two runs is unknown.

    Parameters
    ----------
    T_map_base : (4, 4)
        The first pose.
    odometry
        Returns the poses received so far, in any fixed frame, ordered by time within each run.
    """

    def __init__(self, T_map_base: Matrix, odometry: Callable[[], Trajectory]) -> None:
        super().__init__(T_map_base)
        self._odometry = odometry
        self._run = 0  # run of the odometry that the scans have reached

    def predict(self, stamp_s: float) -> Matrix:
        """Return the predicted (4, 4) pose at a time, seconds."""
        motion = self._motion(stamp_s)
        return super().predict(stamp_s) if motion is None else np.asarray(self.T_known @ motion, np.float64)

    def is_blind(self, stamp_s: float) -> bool:
        """Whether the vehicle's motion is known neither from odometry nor from a velocity."""
        return super().is_blind(stamp_s) and self._motion(stamp_s) is None

    def correct(self, stamp_s: float, T_map_base: Matrix | None) -> None:
        """Record the pose of a scan; None: extend the last known pose by odometry."""
        if T_map_base is None and (motion := self._motion(stamp_s)) is not None:
            T_map_base = np.asarray(self.T_known @ motion, np.float64)
        if self._stamp_s is not None and stamp_s < self._stamp_s:
            self._run += 1
        super().correct(stamp_s, T_map_base)

    def _motion(self, stamp_s: float) -> Matrix | None:
        """Return the motion since the last scan, (4, 4); None if the odometry does not cover it."""
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
    """Return the constant velocity from one pose to another, (6,), metres and radians per second."""
    return motion_of(np.linalg.inv(T_before) @ T_after) / seconds


def first_twist(drive: Trajectory) -> NDArray[np.float64] | None:
    """Return the velocity at the first pose of a drive; None if the first two times do not give it."""
    seconds = float(drive.stamps_s[1] - drive.stamps_s[0]) if len(drive) > 1 else 0.0
    if not 0.0 < seconds <= LONGEST_STEP_S:
        return None
    return twist_between(drive.T_map_sensor[0], drive.T_map_sensor[1], seconds)


def twist_on_route(route: Trajectory, T_map_base: Matrix) -> NDArray[np.float64] | None:
    """Return the velocity of a vehicle on a timed route; None if the route's times do not give it.

    Parameters
    ----------
    route
        Poses along the route; only positions and times are used.
    T_map_base : (4, 4)
        Pose of the vehicle.
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
