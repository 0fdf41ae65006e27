# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory is from the truth: absolutely, and over stretches of the way."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.spread import RunningSpread, Spread

__all__ = ["RunningErrors", "TrajectoryErrors", "pose_errors"]

_STRETCHES_M: Final = (10.0, 50.0, 100.0)
_START_EVERY_M: Final = 0.05  # a vehicle that stands begins no stretches

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of a trajectory.

    Attributes
    ----------
    ate_m, ate_deg
        Absolute error of each pose; the map is the frame, nothing is fitted.
    ate_rmse_m
        Root of the mean square.
    rte
        By length of stretch in metres: mean error of the motion over it, metres per 100 m.
    """

    ate_m: Spread
    ate_deg: Spread
    ate_rmse_m: float
    rte: dict[float, float]


def pose_errors(
    poses: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return metres and degrees between (N, 4, 4) poses and the truth."""
    off = np.linalg.inv(truth) @ poses
    cosine = np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(np.arccos(cosine))


class RunningErrors:
    """Compares pose after pose with the truth; its size does not depend on how many."""

    def __init__(self) -> None:
        self._ate_m, self._ate_deg = RunningSpread(), RunningSpread()
        self._way = 0.0
        self._last: Matrix | None = None
        # by length of stretch: where stretches have begun whose end has not come, with both poses
        self._starts: dict[float, deque[tuple[float, Matrix, Matrix]]] = {m: deque() for m in _STRETCHES_M}
        self._rte = {metres: RunningSpread() for metres in _STRETCHES_M}

    def add(self, pose: Matrix, truth: Matrix) -> None:
        """Take the next pose, (4, 4), and the true one."""
        metres, degrees = pose_errors(pose[None], truth[None])
        self._ate_m.add(float(metres[0]))
        self._ate_deg.add(float(degrees[0]))
        if self._last is not None:
            self._way += float(np.linalg.norm(truth[:3, 3] - self._last[:3, 3]))
        self._last = truth
        for stretch, starts in self._starts.items():
            while starts and starts[0][0] + stretch <= self._way:
                _, pose_then, truth_then = starts.popleft()
                ours = np.linalg.inv(pose_then) @ pose
                theirs = np.linalg.inv(truth_then) @ truth
                off = np.linalg.inv(theirs) @ ours
                self._rte[stretch].add(float(np.linalg.norm(off[:3, 3])) * 100.0 / stretch)
            if not starts or self._way - starts[-1][0] >= _START_EVERY_M:
                starts.append((self._way, pose, truth))

    @property
    def errors(self) -> TrajectoryErrors | None:
        """Of the poses so far; None where there is none."""
        if not self._ate_m.count:
            return None
        rte = {metres: running.spread.mean for metres, running in self._rte.items() if running.count}
        return TrajectoryErrors(self._ate_m.spread, self._ate_deg.spread, self._ate_m.root_mean_square, rte)
