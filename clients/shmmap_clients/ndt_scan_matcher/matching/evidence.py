# SPDX-License-Identifier: Apache-2.0
"""What an alignment rests on: points, where they lie, and what they hold the scan by.

A score says how well points fit where they lie.  A single point, a stretch of road, or what lies within a
few metres fits in many places; these numbers say so.

The Hessian of the score is the information about the pose, up to a factor.  ``sharpness`` is the least
curvature of the score when the scan is moved in any direction without being turned.  ``spread`` compares
directions, with turns left free: the covariance of the position is the translational block of the inverse
Hessian (the Schur complement of the rotations); how round it is depends neither on the number of points nor
on units.  Degeneracy by the smallest eigenvalue: Zhang, Kaess and Singh, "On degeneracy of
optimization-based state estimation problems", ICRA 2016; translations and rotations by themselves, for
metres and radians do not compare: Tuna et al., "X-ICP", IEEE T-RO 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["FAR_POINTS", "Evidence", "Extent", "evidence_of", "extent_of"]

FAR_POINTS: Final = 20
_ANGLE_POINTS: Final = 512  # of a scan, evenly over it: enough for its angle


@dataclass(frozen=True, slots=True)
class Extent:
    """Where the points of a scan lie: ``distance`` and ``angle`` as in `Evidence`."""

    distance: float
    angle: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a pose rests on.

    Attributes
    ----------
    points
        Points of the scan that have a voxel of the map near.
    distance
        How far from the frame's origin at least `FAR_POINTS` points of the scan are, metres.
    angle
        How widely their headings are spread, degrees: the width of a sector, up to 281 for all around.
    sharpness
        Least curvature of the score per matched point, over all directions: the smallest eigenvalue of the
        negated Hessian's translational block, divided by ``points`` and by the highest score of a point,
        times leaf^1.5: with that power right poses have about the same at leaves of 1 m to 3 m.
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
    """Return where points lie, (N, 3), metres; what is not finite counts as lying at the origin.

    The angle follows from R, the mean resultant length of the headings (Mardia and Jupp, "Directional
    Statistics", 2.3.1): a sector of width w, evenly filled, has R = sin(w/2) / (w/2), about 1 - w^2/24.
    Of fewer than `FAR_POINTS` points the distance is that of the nearest.
    """
    if not len(points):
        return Extent(0.0, 0.0)
    x, y = points[:: -(-len(points) // _ANGLE_POINTS), :2].T
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        squared = np.einsum("ij,ij->i", points, points)
        level = np.sqrt(x * x + y * y)
        cosine, sine = x / level, y / level
        known = np.isfinite(cosine + sine)
    squared[~np.isfinite(squared)] = 0.0
    place = max(len(squared) - FAR_POINTS, 0)
    squared.partition(place)
    count = max(int(np.count_nonzero(known)), 1)
    resultant = math.hypot(float(cosine[known].sum()), float(sine[known].sum())) / count
    angle = math.degrees(math.sqrt(24.0 * max(1.0 - resultant, 0.0))) if known.any() else 0.0
    return Extent(math.sqrt(float(squared[place])), angle)


def evidence_of(
    hessian: NDArray[np.float64],
    covariance: NDArray[np.float64] | None,
    extent: Extent,
    *,
    points: int,
    leaf: float,
    highest: float,
) -> Evidence:
    """Return what a pose rests on.

    Parameters
    ----------
    hessian, covariance : (6, 6) float64
        Of the score at the pose, and the inverse of the negated; None where there is none.
    extent
        Of the scan.
    points
        As in `Evidence`.
    leaf
        Edge of a voxel, metres.
    highest
        Score of a point in the middle of a voxel.
    """
    if covariance is None or not np.isfinite(covariance).all():
        return Evidence(points, extent.distance, extent.angle, 0.0, 0.0)
    curvature, variance = np.linalg.eigvalsh(np.stack([-hessian[:3, :3], covariance[:3, :3]]))
    sharpness = float(curvature[0]) * leaf**1.5 / (points * highest)
    spread = max(float(variance[0] / variance[2]), 0.0)
    return Evidence(points, extent.distance, extent.angle, sharpness, spread)
