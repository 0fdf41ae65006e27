# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of one map cell, as the matcher sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.covariances import inverse_covariances

__all__ = ["VoxelCell", "voxel_cell"]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelCell:
    """Voxel statistics of one cell; the arrays may be views of shared memory.

    Attributes
    ----------
    leaf
        Edge of a voxel, metres.
    origin : (3,) float64
        What ``mean`` is relative to, metres, map frame.
    lattice : (ni, nj, nk) int32
        Row of the voxel at each place of the cell's lattice box, -1 where there is none.
    lattice_origin : (3,) int64
        Lattice index of ``lattice[0, 0, 0]``; the lattice itself starts at the map frame's origin.
    count : (V,) int32
        Points in each voxel.
    mean : (V, 3) float64
        Relative to ``origin``, metres.
    scatter : (V, 6) float64
        xx xy xz yy yz zz of the sum of (x - mean)(x - mean)^T, square metres.
    inverse : (V, 6) float64
        Inverse covariance in Autoware's convention, xx xy xz yy yz zz, 1/m^2; zero where refused.
    """

    leaf: float
    origin: NDArray[np.float64]
    lattice: NDArray[np.int32]
    lattice_origin: NDArray[np.int64]
    count: NDArray[np.int32]
    mean: NDArray[np.float64]
    scatter: NDArray[np.float64]
    inverse: NDArray[np.float64]


def voxel_cell(points: NDArray[np.floating], leaf: float, *, min_points: int = 6) -> VoxelCell:
    """Compute the Gaussians of a cloud.

    Parameters
    ----------
    points : (N, 3) float32 or float64
        Map frame, metres; rows that are not finite are left out.
    leaf
        Edge of a voxel, metres.
    min_points
        Voxels with fewer points are left out.
    """
    xyz = np.asarray(points)
    xyz = xyz[np.isfinite(xyz).all(axis=1)]
    # floor(x * (1 / leaf)) in the points' own precision, as the originals
    scalar = xyz.dtype.type
    ijk = np.floor(xyz * scalar(scalar(1.0) / scalar(leaf))).astype(np.int64)
    if not len(xyz):
        return VoxelCell(
            leaf,
            np.zeros(3),
            np.full((1, 1, 1), -1, np.int32),
            np.zeros(3, np.int64),
            np.empty(0, np.int32),
            np.empty((0, 3)),
            np.empty((0, 6)),
            np.empty((0, 6)),
        )
    low = ijk.min(axis=0)
    shape = ijk.max(axis=0) - low + 1
    origin = low * leaf
    local = xyz.astype(np.float64) - origin
    key = np.ravel_multi_index((ijk - low).T, tuple(shape))
    keys, group, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, local[:, axis], len(keys)) for axis in range(3)], axis=1)
    mean = sums / count[:, None]
    off = local - mean[group]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    scatter = np.asarray(
        np.stack([np.bincount(group, off[:, a] * off[:, b], len(keys)) for a, b in pairs], axis=1), np.float64
    )
    kept = count >= min_points
    lattice = np.full(int(np.prod(shape)), -1, np.int32)
    lattice[keys[kept]] = np.arange(int(kept.sum()), dtype=np.int32)
    counts = count[kept].astype(np.int32)
    mean, scatter = mean[kept], scatter[kept]
    return VoxelCell(
        leaf,
        origin,
        lattice.reshape(shape),
        low,
        counts,
        np.ascontiguousarray(mean),
        np.ascontiguousarray(scatter),
        inverse_covariances(counts, scatter, "autoware"),
    )
