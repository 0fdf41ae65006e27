# SPDX-License-Identifier: Apache-2.0
"""What an alignment gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.limits import Cut
from shmmap_clients.ndt_scan_matcher.matching.trust import Evidence

__all__ = ["Result"]


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """A scan's pose in the map.

    Attributes
    ----------
    T_map_base : (4, 4) float64
        Metres, map frame.
    iterations
        Newton steps, counted as the variant's program counts them.
    converged
        The last step was below epsilon, not merely the last one allowed; of the fine part where there is
        one.
    transform_probability
        Score per point of the scan.
    nvtl
        Nearest-voxel transformation likelihood.
    transforms : (k, 4, 4) float64
        The guess, then the pose after each step.
    transform_probabilities, nvtls : (m,) float64
        Of every evaluation, in order: k of them without a line search.
    hessian : (6, 6) float64
        Of the score at the last evaluation, after (x, y, z, roll, pitch, yaw).
    covariance : (6, 6) float64 or None
        Laplace's approximation, the inverse of the negated Hessian; None where the score has no peak
        there.
    oscillations
        Longest run of steps each of which goes back on the one before.
    evaluations
        Passes over the scan.
    evidence
        What the pose rests on.
    cut
        What the limits left out.
    no_map
        No point of the scan had a Gaussian of the map near: there was nothing to match, and the pose is the
        guess.
    failed_limits
        Why the result is not trusted, as `TrustLimits.failed` names it; empty if it is.
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

    @property
    def trustworthy(self) -> bool:
        """Whether the result is within all limits of trust."""
        return not self.failed_limits
