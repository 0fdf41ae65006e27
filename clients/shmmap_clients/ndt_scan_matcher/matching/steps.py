# SPDX-License-Identifier: Apache-2.0
"""Where the peak lies as seen from one place: the two steps that an alignment can take."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation

__all__ = ["FLAT", "SINGULAR", "newton_step", "numpy_step", "upward_step"]

# what JacobiSVD of Eigen takes for zero: as many roundings as the matrix has rows
SINGULAR: Final = 6 * float(np.finfo(np.float64).eps)

FLAT: Final = 1e-9  # least curvature over greatest that a step divides by


def newton_step(at: Evaluation) -> NDArray[np.float64]:
    """Solve H step = -gradient in the least-squares sense, as JacobiSVD does."""
    if not np.isfinite(at.hessian).all():
        return np.full(6, np.nan)
    u, s, vt = np.linalg.svd(at.hessian)
    if not s[0] > 0:
        return np.zeros(6)
    usable = s > max(s[0] * SINGULAR, np.finfo(np.float64).tiny)
    coefficients = np.zeros(6)
    coefficients[usable] = (u.T @ -at.gradient)[usable] / s[usable]
    return np.asarray(vt.T @ coefficients, np.float64)


def upward_step(at: Evaluation) -> NDArray[np.float64]:
    """Return the step to the peak of a paraboloid that curves down by the Hessian's magnitudes."""
    if not np.isfinite(at.hessian).all():
        return np.full(6, np.nan)
    values, vectors = np.linalg.eigh(at.hessian)
    curvature = np.abs(values)
    if not curvature.max() > 0:
        return np.zeros(6)
    curvature = np.maximum(curvature, curvature.max() * FLAT)
    return np.asarray(vectors @ ((vectors.T @ at.gradient) / curvature), np.float64)


def numpy_step(at: Evaluation, steady: bool) -> NDArray[np.float64]:
    """Return `upward_step` if steady, else `newton_step`."""
    return upward_step(at) if steady else newton_step(at)
