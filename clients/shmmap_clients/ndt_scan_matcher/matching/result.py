# SPDX-License-Identifier: Apache-2.0
"""Results of alignments, their evidence, and the limits of trusted results.

NVTL is at most -d1, which grows with the leaf: 2.22 at 1 m, 4.20 at 2 m, 5.40 at 3 m.  Autoware's threshold
of 2.3 is for its leaf of 2 m, a share of 0.548 of the maximum.  The same share separates right poses from
wrong ones at other leaf sizes.  True covariances (``coarse_fine``) fit more closely and score lower below
2 m: the share falls to 0.41 at 1 m.

A score measures how well points fit at a pose.  A single point, a stretch of road, or points within a few
metres fit at many poses; limits on `Evidence` exclude such results.  The Hessian of the score is
the information about the pose, up to a factor.  ``sharpness`` is the least curvature of the score when the
scan is translated in any direction.  ``spread`` compares directions, with rotations left free.  The
covariance of the position is the translational block of the inverse Hessian (the Schur complement of the
rotations); the ratio of its eigenvalues depends neither on the number of points nor on units.  Degeneracy by
the smallest eigenvalue: Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation
problems", ICRA 2016; translations and rotations separately, since metres and radians are not comparable:
Tuna et al., "X-ICP", IEEE T-RO 2024.

The limits were chosen on parts of recorded and simulated scans; ``python -m tests.benchmarks.ndt_trust``
measures how well they separate right poses from wrong ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.matching.evaluation import gauss_for
from shmmap_clients.ndt_scan_matcher.matching.settings import Cut

FAR_POINTS: Final = 20
_ANGLE_POINTS: Final = 512  # points evenly over a scan, enough for its angle
# ndt_scan_matcher.param.yaml of autoware_core: converged_param_nearest_voxel_transformation_likelihood,
# and the oscillations of count_oscillation
_AUTOWARE_NVTL: Final = 2.3
_AUTOWARE_LEAF: Final = 2.0
_MAX_OSCILLATIONS: Final = 10
_INVERSION: Final = -0.9  # cosine between two steps, below which the second is a reversal
_SHARE: Final = _AUTOWARE_NVTL / -gauss_for(_AUTOWARE_LEAF).d1
_FINE_SHARE: Final = 0.41  # at a leaf of 1 m and below
_SHARPNESS: Final = 2.7
_FINE_SHARPNESS: Final = 3.4  # true covariances are narrower


@dataclass(frozen=True, slots=True)
class Extent:
    """Extent of a scan's points: ``distance`` and ``angle`` as in `Evidence`."""

    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence for a pose.

    Attributes
    ----------
    points
        Number of points of the scan with a neighbouring voxel in the map.
    distance
        Distance from the frame's origin that at least `FAR_POINTS` points of the scan reach, metres.
    angle
        Spread of the points' headings, degrees: the width of a sector, up to 281 for all around.
    sharpness
        Least curvature of the score per matched point, over all directions: the smallest eigenvalue of the
        negated Hessian's translational block, divided by ``points`` and by the highest score of a point,
        times leaf^1.5.  With this power, right poses have about the same sharpness at leaves of 1 m to 3 m.
    spread
        Smallest eigenvalue of the position's covariance divided by its largest, 0 to 1; 0 where the Hessian
        is not definite.  0.04: the position is five times as uncertain in one direction as in another.
    """

    points: int
    distance: float
    angle: float
    sharpness: float
    spread: float


def extent_of(points: NDArray[np.floating]) -> Extent:
    """Return the extent of points, (N, 3), metres; points that are not finite count as at the origin.

    The angle follows from R, the mean resultant length of the headings (Mardia and Jupp, "Directional
    Statistics", 2.3.1): a sector of width w, evenly filled, has R = sin(w/2) / (w/2), about 1 - w^2/24.
    With fewer than `FAR_POINTS` points, the distance is that of the nearest.
    """
    if not len(points):
        return Extent(0.0, 0.0)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        x, y, z = points.T
        squared = x * x + y * y + z * z
        stride = -(-len(points) // _ANGLE_POINTS)
        x, y = x[::stride], y[::stride]
        level = np.sqrt(x * x + y * y)
        cosine, sine = x / level, y / level
        known = np.isfinite(cosine + sine)
    squared[~np.isfinite(squared)] = 0.0
    some = squared[::8]  # if enough of these are far, nearer points need not be sorted
    if len(some) >= FAR_POINTS:
        squared = squared[squared >= np.partition(some, -FAR_POINTS)[-FAR_POINTS]]
    place = max(len(squared) - FAR_POINTS, 0)
    squared.partition(place)
    count = max(int(np.count_nonzero(known)), 1)
    resultant = math.hypot(float(cosine[known].sum()), float(sine[known].sum())) / count
    angle = math.degrees(math.sqrt(24.0 * max(1.0 - resultant, 0.0))) if known.any() else 0.0
    return Extent(math.sqrt(float(squared[place])), angle)


def covariance_of(hessian: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the inverse of the negated Hessian, or None if the latter is not positive definite."""
    try:
        np.linalg.cholesky(-hessian)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(np.linalg.inv(-hessian), np.float64)


def oscillations(transforms: NDArray[np.float64]) -> int:
    """Return the longest run of reversed steps, as Autoware's count_oscillation."""
    steps = np.diff(transforms[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1, keepdims=True)
    units = steps / np.where(lengths > 0, lengths, 1.0)
    run = longest = 0
    for cosine in (units[1:] * units[:-1]).sum(axis=1):
        run = run + 1 if cosine < _INVERSION else 0
        longest = max(longest, run)
    return longest


def evidence_of(
    hessian: NDArray[np.float64],
    covariance: NDArray[np.float64] | None,
    extent: Extent,
    *,
    points: int,
    leaf: float,
    highest: float,
) -> Evidence:
    """Return the evidence for a pose.

    Parameters
    ----------
    hessian, covariance : (6, 6) float64
        Hessian of the score at the pose, and the inverse of the negated Hessian; None if there is none.
    extent
        Extent of the scan.
    points
        As in `Evidence`.
    leaf
        Edge of a voxel, metres.
    highest
        Highest score of a point, in the middle of a voxel.
    """
    if covariance is None or not np.isfinite(covariance).all():
        return Evidence(points, extent.distance, extent.angle, 0.0, 0.0)
    curvature, variance = np.linalg.eigvalsh(np.stack([-hessian[:3, :3], covariance[:3, :3]]))
    sharpness = float(curvature[0]) * leaf**1.5 / (points * highest)
    spread = max(float(variance[0] / variance[2]), 0.0)
    return Evidence(points, extent.distance, extent.angle, sharpness, spread)


def default_nvtl(leaf: float, *, fine: bool = False) -> float:
    """Return the lowest NVTL of a trusted result.

    Parameters
    ----------
    leaf
        Edge of a voxel, metres.
    fine
        Whether the result uses true covariances (``coarse_fine``).
    """
    share = _SHARE
    if fine and leaf < _AUTOWARE_LEAF:
        share = _FINE_SHARE + (_SHARE - _FINE_SHARE) * max(leaf - 1.0, 0.0)
    return share * -gauss_for(leaf).d1


@dataclass(frozen=True, slots=True)
class TrustLimits:
    """Limits that a trusted result must meet.

    No score detects every divergence: a pose metres off may meet all limits.

    Attributes
    ----------
    nvtl
        Lowest nearest-voxel transformation likelihood; None: `default_nvtl` of the map's leaf.
    transform_probability
        Lowest transform probability; None: no limit.
    oscillations
        Most reversals of the step.
    points, distance, angle, sharpness, spread
        Least `Evidence`; None for ``sharpness``: 2.7, or 3.4 for true covariances.
    """

    nvtl: float | None = None
    transform_probability: float | None = None
    oscillations: int = _MAX_OSCILLATIONS
    points: int = 80
    distance: float = 10.0  # required_distance of ndt_scan_matcher.param.yaml
    angle: float = 35.0
    sharpness: float | None = None
    spread: float = 0.03

    def __post_init__(self) -> None:
        for limit in fields(self):
            value = getattr(self, limit.name)
            if value is not None and not value >= 0:
                raise BadRequest(f"a limit of trust must not be negative, {limit.name} is {value}")

    def for_leaf(self, leaf: float, *, fine: bool = False) -> TrustLimits:
        """Return the limits with their defaults filled in; parameters as in `default_nvtl`."""
        return replace(
            self,
            nvtl=default_nvtl(leaf, fine=fine) if self.nvtl is None else self.nvtl,
            sharpness=(_FINE_SHARPNESS if fine else _SHARPNESS) if self.sharpness is None else self.sharpness,
        )

    def failed(
        self,
        *,
        no_map: bool,
        converged: bool,
        nvtl: float,
        transform_probability: float,
        oscillations: int,
        evidence: Evidence,
    ) -> tuple[str, ...]:
        """Return the names of the limits that a result fails, none if it is trusted.

        Returns
        -------
        tuple of str
            ``no_map`` alone if there was no map to match, else any of ``converged``, ``nvtl``,
            ``transform_probability``, ``oscillations``, ``points``, ``distance``, ``angle``, ``sharpness``,
            ``spread``.
        """
        if no_map:
            return ("no_map",)
        failed = {
            "converged": not converged,
            "nvtl": nvtl < (self.nvtl or 0.0),
            "transform_probability": transform_probability < (self.transform_probability or 0.0),
            "oscillations": oscillations > self.oscillations,
            "points": evidence.points < self.points,
            "distance": evidence.distance < self.distance,
            "angle": evidence.angle < self.angle,
            "sharpness": not evidence.sharpness >= (self.sharpness or 0.0),
            "spread": not evidence.spread >= self.spread,
        }
        return tuple(name for name, fails in failed.items() if fails)

    def describe(self, name: str) -> str:
        """Return a description of a failed limit, by its name in `failed`."""
        return {
            "no_map": "no map",
            "converged": "not converged",
            "nvtl": f"NVTL below {self.nvtl or 0.0:.2f}",
            "transform_probability": f"transform probability below {self.transform_probability or 0.0:.2f}",
            "oscillations": f"more than {self.oscillations} oscillations",
            "points": f"fewer than {self.points} points matched",
            "distance": f"fewer than {FAR_POINTS} points beyond {self.distance:g} m",
            "angle": f"all points in a sector of less than {self.angle:g} degrees",
            "sharpness": f"a direction is hardly held (sharpness below {self.sharpness or 0.0:.2f})",
            "spread": f"a direction is held much less than others (spread below {self.spread:.3g})",
        }[name]


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Result of an alignment: a scan's pose in the map.

    Attributes
    ----------
    T_map_base : (4, 4) float64
        Metres, map frame.
    iterations
        Newton steps, counted as the variant's program counts them.
    converged
        Whether the last step was below epsilon, not merely the last one allowed; in the fine stage if
        there is one.
    transform_probability
        Score per point of the scan.
    nvtl
        Nearest-voxel transformation likelihood.
    transforms : (k, 4, 4) float64
        The guess, then the pose after each step.
    transform_probabilities, nvtls : (m,) float64
        Values at every evaluation, in order; k of them without a line search.
    hessian : (6, 6) float64
        Hessian of the score at the last evaluation, by (x, y, z, roll, pitch, yaw).
    covariance : (6, 6) float64 or None
        Laplace's approximation, the inverse of the negated Hessian; None if the score has no peak at the
        pose.
    oscillations
        Longest run of steps that each reverse the one before.
    evaluations
        Number of passes over the scan.
    evidence
        Evidence for the pose.
    cut
        Items that the limits left out.
    no_map
        Whether no point of the scan had a neighbouring Gaussian in the map; the pose is then the guess.
    failed_limits
        Names of the failed limits, see `TrustLimits.failed`; empty if the result is trusted.
    """

    T_map_base: NDArray[np.float64]
    iterations: int
    converged: bool
    transform_probability: float
    nvtl: float
    transforms: NDArray[np.float64]
    transform_probabilities: NDArray[np.float64]
    nvtls: NDArray[np.float64]
    hessian: NDArray[np.float64]
    covariance: NDArray[np.float64] | None
    oscillations: int
    evaluations: int
    evidence: Evidence
    cut: Cut
    no_map: bool
    failed_limits: tuple[str, ...]

    def __repr__(self) -> str:
        T = self.T_map_base
        place = ", ".join(f"{axis} {value:.3f}" for axis, value in zip("xyz", T[:3, 3], strict=True))
        yaw = math.degrees(math.atan2(T[1, 0], T[0, 0]))
        trust = "trusted" if self.trustworthy else f"not trusted ({', '.join(self.failed_limits)})"
        found = f"NVTL {self.nvtl:.2f}, {self.iterations} steps, {trust}"
        return f"<Result at {place} m, yaw {yaw:.2f} deg: {found}>"

    @property
    def trustworthy(self) -> bool:
        """Whether the result meets all limits of trust."""
        return not self.failed_limits
