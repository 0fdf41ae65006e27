# SPDX-License-Identifier: Apache-2.0
"""Candidates for a vehicle's pose, drawn first from a rough pose, then from the scores so far."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

_UNKNOWN_YAW: Final = math.pi / math.sqrt(3.0)  # standard deviation of a uniform heading
_DRAWS: Final = 100
_MAX_GOOD: Final = 10
_REST_WEIGHT: Final = 5.0
_KERNEL: Final = np.array([0.25, 0.25, math.radians(2.5)])


@dataclass(frozen=True, slots=True)
class RoughPose:
    """A rough pose; metres and radians, map frame.

    Attributes
    ----------
    x, y
    z
        Height of the scan's frame; None: unknown.  The pose's height is that of the map's ground, where there
        are several (bridges, tunnels, car parks) of the one that is clearly nearest to z.
    roll, pitch, yaw
    sigma_m
        Standard deviation of x and of y.
    sigma_yaw
        Standard deviation of the heading; pi / sqrt(3) or more: unknown.
    covariance
        (3, 3) covariance of x, y, yaw, instead of both, as nested tuples.
    """

    x: float
    y: float
    z: float | None = None
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    sigma_m: float = 2.0
    sigma_yaw: float = math.radians(10.0)
    covariance: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        numbers = (self.x, self.y, self.z or 0.0, self.roll, self.pitch, self.yaw)
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
        """The mean (x, y, yaw)."""
        return np.array([self.x, self.y, self.yaw])

    @property
    def factor(self) -> NDArray[np.float64]:
        """Lower triangular (3, 3) L with L L^T the covariance of (x, y, yaw)."""
        if self.covariance is not None:
            return np.asarray(np.linalg.cholesky(np.array(self.covariance, np.float64)), np.float64)
        return np.diag([self.sigma_m, self.sigma_m, self.sigma_yaw])

    @property
    def heading_unknown(self) -> bool:
        """Whether the heading is unknown."""
        return float(np.linalg.norm(self.factor[2])) >= _UNKNOWN_YAW * 0.999


class ParzenEstimator:
    """Generator of candidates in batches, which learns from their scores.

    A tree-structured Parzen estimator over (x, y, yaw), as in Autoware's initializer.  The first candidates
    are drawn from the distribution of the rough pose.  Later candidates are each the one of 100 draws that
    is most like the best tenth of the scored candidates and least like the rest (Bergstra et al. 2011; the
    weight 5 of the rest, the kernels' widths and the number of draws are Autoware's).

    Parameters
    ----------
    rough
        Distribution of the candidates.
    seed
        The same seed gives the same candidates.
    """

    def __init__(self, rough: RoughPose, seed: int = 0) -> None:
        self._rough = rough
        self._rng = np.random.default_rng(seed)
        self._tried = np.empty((0, 3))
        self._scores = np.empty(0)

    def first(self, count: int) -> NDArray[np.float64]:
        """Return (count, 3) candidates from the prior; the first is the rough pose itself."""
        drawn = self._draw(count)
        drawn[0] = self._rough.mean
        return drawn

    def next(self, count: int) -> NDArray[np.float64]:
        """Return (count, 3) candidates with high expected scores."""
        drawn = self._draw(count * _DRAWS)
        good = min(_MAX_GOOD, len(self._scores) // 10)
        if not good:
            return drawn[:count]
        order = np.argsort(-self._scores, kind="stable")
        ratio = self._density(drawn, order[:good]) - _REST_WEIGHT * self._density(drawn, order[good:])
        chosen = ratio.reshape(count, _DRAWS).argmax(axis=1) + np.arange(count) * _DRAWS
        return np.asarray(drawn[chosen], np.float64)

    def learn(self, candidates: NDArray[np.float64], scores: NDArray[np.float64]) -> None:
        """Add candidates and their scores; a higher score is better."""
        self._tried = np.concatenate([self._tried, candidates])
        self._scores = np.concatenate([self._scores, scores])

    def best(self, count: int, apart_m: float, apart_yaw: float) -> NDArray[np.float64]:
        """Return the best candidates, no two of them near each other in position and heading."""
        kept: list[NDArray[np.float64]] = []
        for index in np.argsort(-self._scores, kind="stable"):
            one = self._tried[index]
            if all(
                math.hypot(*(one[:2] - other[:2])) >= apart_m or abs(_wrapped(one[2] - other[2])) >= apart_yaw
                for other in kept
            ):
                kept.append(one)
                if len(kept) == count:
                    break
        return np.array(kept).reshape(-1, 3)

    def _draw(self, count: int) -> NDArray[np.float64]:
        drawn = self._rough.mean + self._rng.normal(size=(count, 3)) @ self._rough.factor.T
        if self._rough.heading_unknown:
            drawn[:, 2] = self._rng.uniform(-math.pi, math.pi, count)
        return np.asarray(drawn, np.float64)

    def _density(self, at: NDArray[np.float64], which: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the logarithm of the mean of the kernels at scored candidates, up to a constant."""
        exponent = np.zeros((len(at), len(which)))
        for axis, width in enumerate(_KERNEL.tolist()):
            # in place, one axis at a time: wrap angles, divide by the kernel's width, square
            off = at[:, axis, None] - self._tried[which, axis]
            if axis == 2:
                off -= 2 * math.pi * np.rint(off / (2 * math.pi))
            off /= width
            off *= off
            exponent += off
        exponent *= -0.5
        most = exponent.max(axis=1)
        exponent -= most[:, None]
        np.exp(exponent, out=exponent)
        return np.asarray(most + np.log(exponent.mean(axis=1)), np.float64)


def _wrapped(angle: NDArray[np.float64] | float) -> NDArray[np.float64]:
    return np.asarray((np.asarray(angle) + math.pi) % (2 * math.pi) - math.pi, np.float64)
