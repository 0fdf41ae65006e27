# SPDX-License-Identifier: Apache-2.0
"""Backend for machines without numba: the same sums by whole-array operations.

It copies the map's Gaussians to private arrays of 80 bytes a voxel.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import ScanBuffer, UploadStatistics, check_batch
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    AX,
    BJ,
    JBJ,
    NEGLIGIBLE_EXPONENT,
    SUMS,
    A,
    B,
    Evaluation,
    Neighbors,
    Scoring,
    gauss_for,
    search_columns,
)
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import (
    derivatives_of_poses,
    evaluations_of,
    matrices_from_poses,
    numpy_step,
)
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

_BLOCK_POINTS: Final = 4096  # keeps intermediate arrays within the caches


class _Gaussians:
    """All Gaussians of a map, each with its lattice key, in key order."""

    def __init__(self, voxel_map: VoxelMap) -> None:
        self.map = voxel_map
        cells = list(voxel_map.cells.values())
        places = [np.argwhere(cell.lattice >= 0) for cell in cells]
        rows = [cell.lattice[tuple(place.T)] for cell, place in zip(cells, places, strict=True)]
        ijk = [place + cell.lattice_origin for cell, place in zip(cells, places, strict=True)]
        lattice = np.concatenate([np.empty((0, 3), np.int64), *ijk])
        # a margin of one step, so that every neighbour of a clipped index has a key
        self.low = (lattice.min(axis=0) if len(lattice) else np.zeros(3, np.int64)) - 2
        self.shape = (lattice.max(axis=0) if len(lattice) else np.zeros(3, np.int64)) - self.low + 3
        keys = np.ravel_multi_index((lattice - self.low).T, tuple(self.shape))
        order = np.argsort(keys, kind="stable")
        self.keys = keys[order]
        mean = [cell.mean[row] + cell.origin for cell, row in zip(cells, rows, strict=True)]
        self.mean = np.concatenate([np.empty((0, 3)), *mean])[order]
        self._rows, self._order = rows, order
        self._inverse: dict[Covariance, NDArray[np.float64]] = {}

    def inverse(self, covariance: Covariance) -> NDArray[np.float64]:
        if covariance not in self._inverse:
            parts = [
                self.map.inverses(key, covariance)[row]
                for key, row in zip(self.map.cells, self._rows, strict=True)
            ]
            self._inverse[covariance] = np.concatenate([np.empty((0, 6)), *parts])[self._order]
        return self._inverse[covariance]


def _unpacked(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return symmetric matrices (V, 3, 3) from their xx, xy, xz, yy, yz, zz."""
    return packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


class NumpyBackend:
    """`Backend` by whole-array operations; ``threads`` are not used."""

    name = "numpy"
    on_device = False
    fault = None

    def __init__(self, limits: Limits, threads: int = 1) -> None:  # noqa: ARG002
        self._source = ScanBuffer(limits.source_points)
        self._most = limits.neighbors
        self._max_poses = limits.poses
        self.max_map_bytes = limits.max_map_bytes
        self.uploads = UploadStatistics()  # stays zero: nothing is uploaded
        self._gaussians = self._prepared = _Gaussians(VoxelMap({}))

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Gather the map's Gaussians."""
        prepared = self._prepared
        if prepared.map is not voxel_map:
            prepared = _Gaussians(voxel_map)
        prepared.inverse(scoring.covariance)
        self._prepared = prepared

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on."""
        prepared = self._prepared
        self._gaussians = prepared if prepared.map is voxel_map else _Gaussians(voxel_map)

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Store a scan; return the number of points above the limit."""
        return self._source.take(points)

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return the evaluations of (k, 6) poses, one after the other."""
        check_batch(poses, self._max_poses)
        source = self._source.points
        blocks = [source[at : at + _BLOCK_POINTS] for at in range(0, len(source), _BLOCK_POINTS)]
        derivatives = derivatives_of_poses(poses, scoring.pitch_sign)
        rows = [
            self._sums(block, T, M[:3], scoring)
            for T, M in zip(matrices_from_poses(poses), derivatives, strict=True)
            for block in blocks
        ]
        return evaluations_of(np.array(rows).reshape(len(poses), len(blocks), SUMS), derivatives)

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the next step from an evaluation."""
        return numpy_step(at, steady)

    def _pairs(
        self,
        moved: NDArray[np.float64],
        neighbors: Neighbors,
        inverse: NDArray[np.float64],
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], int, int]:
        """Return pairs of point and neighbour, ordered by point, and the counts that the limit cut off."""
        gaussians = self._gaussians
        leaf = gaussians.map.leaf
        lattice = np.floor(moved * (1.0 / leaf)) - gaussians.low
        inside = np.isfinite(lattice).all(axis=1)
        lattice = np.where(inside[:, None], lattice, 0.0).clip(0, gaussians.shape - 1)
        inside &= ((lattice >= 1) & (lattice <= gaussians.shape - 2)).all(axis=1)
        points = np.flatnonzero(inside)
        strides = np.array([gaussians.shape[1] * gaussians.shape[2], gaussians.shape[2], 1])
        steps = [
            (di, dj, dk)
            for di, dj, low, high in search_columns(neighbors).tolist()
            for dk in range(low, high + 1)
        ]
        keys = (lattice[points].astype(np.int64) @ strides)[:, None] + np.array(steps) @ strides
        first = np.searchsorted(gaussians.keys, keys)
        last = np.searchsorted(gaussians.keys, keys, side="right")
        number = (last - first).ravel()
        hits = np.flatnonzero(number)
        repeats = number[hits]
        # voxels first, first + 1, ... of each hit: several where cells share a lattice place
        begin = np.cumsum(repeats) - repeats
        voxel = np.repeat(first.ravel()[hits] - begin, repeats) + np.arange(int(repeats.sum()))
        point = points[np.repeat(hits // len(steps), repeats)]
        usable = inverse[voxel, 0] > 0.0  # else refused in this variant
        distance2 = ((moved[point] - gaussians.mean[voxel]) ** 2).sum(axis=1)
        if neighbors == "radius":
            usable &= distance2 <= leaf**2
        point, voxel, distance2 = point[usable], voxel[usable], distance2[usable]
        count = np.bincount(point, minlength=len(moved))
        if not len(count) or count.max() <= self._most:
            return point, voxel, 0, 0
        by_distance = np.lexsort((distance2, point))
        rank = np.arange(len(point)) - (np.cumsum(count) - count)[point]
        keep = np.sort(by_distance[rank < self._most])
        surplus = np.maximum(count - self._most, 0)
        return point[keep], voxel[keep], int((surplus > 0).sum()), int(surplus.sum())

    def _sums(
        self,
        source: NDArray[np.float64],
        matrix: NDArray[np.float64],
        J: NDArray[np.float64],
        scoring: Scoring,
    ) -> NDArray[np.float64]:
        sums = np.zeros(SUMS)
        gauss = gauss_for(self._gaussians.map.leaf)
        inverse = self._gaussians.inverse(scoring.covariance)
        with np.errstate(invalid="ignore"):
            moved = source @ matrix[:3, :3].T + matrix[:3, 3]
        point, voxel, cut_points, cut_neighbours = self._pairs(moved, scoring.neighbors, inverse)
        if not len(point):
            return sums
        near = inverse[voxel]
        d = moved[point] - self._gaussians.mean[voxel]
        C = _unpacked(near)
        q = np.matmul(C, d[:, :, None])[:, :, 0]
        exponent = 0.5 * gauss.d2 * (d * q).sum(axis=1)
        e = np.exp(-exponent)
        e[~((exponent >= 0.0) & (exponent < NEGLIGIBLE_EXPONENT))] = 0.0
        share = -gauss.d1 * e
        w = gauss.d1 * gauss.d2 * e
        starts = np.flatnonzero(np.r_[True, point[1:] != point[:-1]])
        owner = point[starts]
        x = source[owner]
        upper = q[:, [0, 0, 0, 1, 1, 2]] * q[:, [0, 1, 2, 1, 2, 2]]
        a = np.add.reduceat(w[:, None] * q, starts)
        b = np.add.reduceat(w[:, None] * (near - gauss.d2 * upper), starts)
        b_full = _unpacked(b)
        jacobian = np.matmul(x, J.transpose(2, 1, 0).reshape(3, 9)).reshape(-1, 3, 3)
        bj = np.matmul(b_full, jacobian)
        jbj = np.matmul(jacobian.transpose(0, 2, 1), bj).sum(axis=0)
        sums[0] = share.sum()
        sums[1] = np.maximum.reduceat(share, starts).sum()
        sums[2:6] = len(owner), len(point), cut_points, cut_neighbours
        sums[A] = a.sum(axis=0)
        sums[AX] = (a.T @ x).ravel()
        sums[B] = b.sum(axis=0)
        sums[BJ] = bj.sum(axis=0).ravel()
        sums[JBJ] = jbj[np.triu_indices(3)]
        return sums
