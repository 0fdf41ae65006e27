# SPDX-License-Identifier: Apache-2.0
"""What is known before the search: a place, a heading, and how far both may be off."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

__all__ = ["RoughPose"]

_UNKNOWN_YAW: Final = math.pi / math.sqrt(3.0)  # standard deviation of a uniform heading


@dataclass(frozen=True, slots=True)
class RoughPose:
    """A rough pose; metres and radians, map frame.

    Attributes
    ----------
    x, y
    z
        Taken where the map has no ground near the place; else the ground's height counts.
    roll, pitch, yaw
    sigma_m
        Standard deviation of x and of y.
    sigma_yaw
        Of the heading; pi / sqrt(3) and more: it is not known at all.
    covariance
        (3, 3) of x, y, yaw, in place of both; as nested tuples.
    """

    x: float
    y: float
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    sigma_m: float = 2.0
    sigma_yaw: float = math.radians(10.0)
    covariance: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        numbers = (self.x, self.y, self.z, self.roll, self.pitch, self.yaw)
        if not all(map(math.isfinite, numbers)):
            raise BadRequest(f"a rough pose has finite numbers, not {numbers}")
        if not (0 < self.sigma_m < math.inf and self.sigma_yaw > 0):
            raise BadRequest(
                "the standard deviations of a rough pose must be positive, that of its place finite"
            )
        if self.covariance is not None:
            matrix = np.array(self.covariance, np.float64)
            if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or (matrix != matrix.T).any():
                raise BadRequest("the covariance must be a symmetric 3 x 3 matrix of x, y, yaw")
            if (np.linalg.eigvalsh(matrix) <= 0).any():
                raise BadRequest("the covariance must be positive definite")

    @property
    def mean(self) -> NDArray[np.float64]:
        """(x, y, yaw)."""
        return np.array([self.x, self.y, self.yaw])

    @property
    def factor(self) -> NDArray[np.float64]:
        """Lower triangular (3, 3) L with L L^T the covariance of (x, y, yaw)."""
        if self.covariance is not None:
            return np.asarray(np.linalg.cholesky(np.array(self.covariance, np.float64)), np.float64)
        return np.diag([self.sigma_m, self.sigma_m, self.sigma_yaw])

    @property
    def heading_unknown(self) -> bool:
        """Whether the yaw says nothing."""
        return float(np.linalg.norm(self.factor[2])) >= _UNKNOWN_YAW * 0.999
