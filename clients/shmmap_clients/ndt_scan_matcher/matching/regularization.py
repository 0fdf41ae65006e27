# SPDX-License-Identifier: Apache-2.0
"""Autoware's regularisation: a weak pull towards another estimate of where the vehicle is along its way."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation

__all__ = ["Regularization"]


@dataclass(frozen=True, slots=True)
class Regularization:
    """Adds -scale * neighbours * (longitudinal distance)^2 to the score.

    Attributes
    ----------
    x, y
        The other estimate (of GNSS, say), metres, map frame.
    scale
        ``regularization_scale_factor`` in Autoware, 0.01 by default there.
    """

    x: float
    y: float
    scale: float = 0.01

    def applied(self, evaluation: Evaluation, pose: NDArray[np.float64]) -> Evaluation:
        """Return the evaluation with the term added (multigrid_ndt_omp, computeDerivatives)."""
        dx, dy = self.x - float(pose[0]), self.y - float(pose[1])
        along = np.array([math.cos(pose[5]), math.sin(pose[5])])
        distance = along[0] * dx + along[1] * dy
        weight = self.scale * evaluation.neighbours
        gradient, hessian = evaluation.gradient.copy(), evaluation.hessian.copy()
        gradient[:2] += weight * 2.0 * distance * along
        hessian[:2, :2] -= weight * 2.0 * np.outer(along, along)
        return replace(
            evaluation,
            score=evaluation.score - weight * distance**2,
            gradient=gradient,
            hessian=hessian,
        )
