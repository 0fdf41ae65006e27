# SPDX-License-Identifier: Apache-2.0
"""How far a trajectory is from the truth: absolutely, and over stretches of the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["DriveErrors", "Spread", "drive_errors", "pose_errors"]

_STRETCHES_M: Final = (10.0, 50.0, 100.0)


@dataclass(frozen=True, slots=True)
class Spread:
    """What a row of numbers is like; NaN where there are none."""

    mean: float
    variance: float
    p50: float
    p99: float
    max: float

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Spread:
        """Return the spread of (N,) values."""
        if not len(values):
            return cls(*(float("nan"),) * 5)
        p50, p99 = np.percentile(values, (50, 99))
        return cls(float(values.mean()), float(values.var()), float(p50), float(p99), float(values.max()))


@dataclass(frozen=True, slots=True)
class DriveErrors:
    """Errors of a drive.

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


def drive_errors(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> DriveErrors:
    """Compare a drive with the truth, (N, 4, 4) each."""
    metres, degrees = pose_errors(poses, truth)
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    rte: dict[float, float] = {}
    for stretch in _STRETCHES_M:
        ends = np.searchsorted(way, way + stretch)
        starts = np.flatnonzero(ends < len(way))
        if len(starts):
            ends = ends[starts]
            ours = np.linalg.inv(poses[starts]) @ poses[ends]
            theirs = np.linalg.inv(truth[starts]) @ truth[ends]
            off = np.linalg.inv(theirs) @ ours
            rte[stretch] = float(np.linalg.norm(off[:, :3, 3], axis=1).mean() * 100.0 / stretch)
    return DriveErrors(
        Spread.of(metres),
        Spread.of(degrees),
        float(np.sqrt((metres**2).mean())) if len(metres) else float("nan"),
        rte,
    )
