# SPDX-License-Identifier: Apache-2.0
"""Inverse covariances from a voxel's moments, as each of the three NDT programs has them.

With n points, mean m and scatter S = sum (x - m)(x - m)^T:

==========  =====================================================================
autoware    (S + I) / (n - 1)            autoware_core, multi_voxel_grid_covariance
pclomp      (S + I) / n * (n - 1) / n    koide3/ndt_omp, voxel_grid_covariance_omp
pcl         S / (n - 1)                  PCL >= 1.12, the sample covariance itself
==========  =====================================================================

The identity is an accident of the first two (a leaf's covariance starts as one), and acts as a
regularisation: a wide basin and a bias of 2 to 4 cm.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["COVARIANCES", "Covariance", "inverse_covariances"]

Covariance = Literal["autoware", "pclomp", "pcl"]
COVARIANCES: Final[tuple[Covariance, ...]] = ("autoware", "pclomp", "pcl")

_INFLATION: Final = 0.01  # smallest eigenvalue over largest, eq. 6.11 of Magnusson 2009
_PCL_TOLERANCE: Final = -1e-12  # PCL forgives eigenvalues that rounding made negative


def inverse_covariances(
    count: NDArray[np.integer],
    scatter: NDArray[np.float64],
    covariance: Covariance,
) -> NDArray[np.float64]:
    """Return the inverse covariance of each voxel.

    Parameters
    ----------
    count : (V,) integers
        Points in the voxel.
    scatter : (V, 6) float64
        xx xy xz yy yz zz of the sum of (x - mean)(x - mean)^T, square metres.
    covariance
        Whose convention.

    Returns
    -------
    (V, 6) float64
        xx xy xz yy yz zz, 1/m^2; a row of zeros where that program refuses the voxel.
    """
    if not len(count):
        return np.empty((0, 6))
    n = count.astype(np.float64)[:, None, None]
    matrix = scatter[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    if covariance == "pcl":
        matrix = matrix / (n - 1.0)
        tolerance = _PCL_TOLERANCE
    else:
        matrix = matrix + np.eye(3)
        matrix = matrix / (n - 1.0) if covariance == "autoware" else matrix / n * ((n - 1.0) / n)
        tolerance = 0.0
    values, vectors = np.linalg.eigh(matrix)
    refused = (values[:, 0] < tolerance) | (values[:, 1] < tolerance) | (values[:, 2] <= 0)
    floor = _INFLATION * values[:, 2]
    low = values[:, 0] < floor
    values[low, 0] = floor[low]
    middle = low & (values[:, 1] < floor)  # looked at only where the smallest was raised, as upstream
    values[middle, 1] = floor[middle]
    values[refused] = 1.0
    inverse = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    inverse[refused] = 0.0
    return np.ascontiguousarray(inverse.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])
