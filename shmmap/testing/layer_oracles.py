# SPDX-License-Identifier: Apache-2.0
"""Slow, independent answers to what layers hold: plain numpy and Python, one voxel after the other.

They share no code with the builders.  The formulas are those of the programs that the layers must
agree with, written down as they stand there.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["covariance_of", "voxels_of"]


def voxels_of(xyz: NDArray[Any], leaf: tuple[float, float, float]) -> dict[tuple[int, int, int], list[int]]:
    """Which points lie in which voxel of the global lattice, by index (x, y, z).

    The index is computed in the points' own precision, as PCL does: ``floor(x * (1 / leaf))``.
    Points that are not finite are in none.
    """
    real = xyz.dtype.type
    inverse = [real(1) / real(edge) for edge in leaf]
    found: defaultdict[tuple[int, int, int], list[int]] = defaultdict(list)
    for number, point in enumerate(xyz):
        if np.isfinite(point).all():
            i, j, k = (int(np.floor(real(value * by))) for value, by in zip(point, inverse, strict=True))
            found[i, j, k].append(number)
    return dict(found)


def covariance_of(
    points: NDArray[Any], convention: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Covariance after regularising, and its inverse, (3, 3) each, of one voxel's points.

    ``autoware``: the covariance starts as the identity, outer products are added, the product of sum
    and mean is subtracted, all divided by n - 1.  ``pclomp``: (identity and sums, divided by n, minus
    the mean's outer product as ndt_omp writes it) times (n - 1) / n.  ``pcl``: S / (n - 1).  None where
    there is nothing to invert.
    """
    n = len(points)
    if n < 2:
        return None
    shifted = np.asarray(points, np.float64)
    about = shifted[0]
    shifted = shifted - about
    mean = shifted.mean(axis=0)
    products = sum((np.outer(p, p) for p in shifted), np.zeros((3, 3)))
    start = np.zeros((3, 3)) if convention == "pcl" else np.eye(3)
    if convention == "pclomp":
        covariance = ((start + products) / n - np.outer(mean, mean)) * (n - 1) / n
    else:
        covariance = (start + products - n * np.outer(mean, mean)) / (n - 1)
    values, vectors = np.linalg.eigh(covariance)
    if values[2] <= 0 or values[0] < -1e-12 * values[2]:
        return None
    floor = 0.01 * values[2]
    if values[0] < floor:
        values[0] = floor
        if values[1] < floor:
            values[1] = floor
        covariance = vectors @ np.diag(values) @ np.linalg.inv(vectors)
    return covariance, np.linalg.inv(covariance).astype(np.float64)
