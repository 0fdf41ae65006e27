# SPDX-License-Identifier: Apache-2.0
"""Covariances as PCL, ndt_omp and Autoware compute them, exactly, from one set of moments.

With n points and their scatter S (sum of outer products of differences to the mean):

========== ============================== ==========================================================
convention covariance before regularising whose
========== ============================== ==========================================================
autoware   (S + I) / (n - 1)              autoware_core, ndt_scan_matcher's multi-grid NDT since 2025
pclomp     (S + I) / n * (n - 1) / n      koide3/ndt_omp; Autoware before
pcl        S / (n - 1)                    PCL 1.12 and later
========== ============================== ==========================================================

The identity comes from a leaf whose covariance starts as one and is summed into; it widens small
voxels, and with it the basin of convergence.  Then all three raise a least eigenvalue below 0.01
times the greatest to that, and only if they did so the middle one too (Magnusson 2009, 6.2).
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.optional_packages import needed_packages

__all__ = ["CONVENTIONS", "Convention", "voxel_covariances"]

Convention: TypeAlias = Literal["autoware", "pclomp", "pcl"]
CONVENTIONS: Final[tuple[Convention, ...]] = ("autoware", "pclomp", "pcl")
LEAST_EIGENVALUE_RATIO: Final = 0.01
"""``min_covar_eigvalue_mult_`` of PCL's VoxelGridCovariance and of its descendants."""


def voxel_covariances(
    counts: NDArray[np.generic],
    scatter: NDArray[np.generic],
    convention: Convention = "autoware",
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariance and inverse covariance of each voxel in one convention.

    Parameters
    ----------
    counts
        (V,) points of each voxel.
    scatter
        (V, 6) sums xx, xy, xz, yy, yz, zz of products of differences to the mean, m^2.

    Returns
    -------
    covariance : (V, 6) float64, m^2
        After regularising; xx, xy, xz, yy, yz, zz.
    inverse : (V, 6) float64, 1/m^2
        Both are 0 where the originals refuse a voxel: it has one point, or (``pcl``) all of its
        points are the same.
    """
    with needed_packages("voxel_covariances()"):
        from shmmap.layers.ndt_kernels import inverse_covariances

    if convention not in CONVENTIONS:
        raise BadRequest(f"no convention {convention!r}", hint=f"conventions are: {', '.join(CONVENTIONS)}")
    covariance, inverse = np.empty((len(counts), 6)), np.empty((len(counts), 6))
    inverse_covariances(
        np.ascontiguousarray(counts, np.int32),
        np.ascontiguousarray(scatter, np.float64),
        CONVENTIONS.index(convention),
        LEAST_EIGENVALUE_RATIO,
        covariance,
        inverse,
    )
    return covariance, inverse
