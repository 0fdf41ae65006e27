# SPDX-License-Identifier: Apache-2.0
"""The compiled backend: runs without the GIL; any number of threads gives the same result."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import ScanBuffer, UploadStatistics, check_batch
from shmmap_clients.ndt_scan_matcher.backends.kernels import (
    CONTRACTED,
    accumulate,
    contract,
    derive,
    step_into,
)
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    CHUNK_POINTS,
    SUMS,
    Evaluation,
    Scoring,
    gauss_for,
    search_columns,
)
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

_BATCH_ROWS: Final = 4096  # rows in one batch of poses: 256 poses of 2048 points


class NumbaBackend:
    """`Backend` over the compiled kernel.

    The scan is cut into chunks of a fixed size, each with its own row of sums.  Threads take runs of
    chunks, and rows are added in order, so that results do not depend on the number of threads.
    """

    name = "numba"
    on_device = False
    fault = None

    def __init__(self, limits: Limits, threads: int = 1) -> None:
        self._source = ScanBuffer(limits.source_points)
        self._max_poses = limits.poses
        self.max_map_bytes = limits.max_map_bytes
        self.uploads = UploadStatistics()  # stays zero: nothing is uploaded
        self._map = VoxelMap({})
        self._max_rows = max(-(-limits.source_points // CHUNK_POINTS), _BATCH_ROWS)
        self._rows = np.zeros((self._max_rows, SUMS))
        self._T = np.zeros((limits.poses, 4, 4))
        self._M = np.zeros((limits.poses, 9, 3, 3))
        self._scratch = [
            (np.empty((limits.neighbors, 4)), np.empty(limits.neighbors, np.int64), np.empty(11))
            for _ in range(threads)
        ]
        self._columns = {name: search_columns(name) for name in ("direct1", "direct7", "radius")}
        self._pool = ThreadPoolExecutor(threads - 1, "ndt") if threads > 1 else None

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Compute covariances and the table of addresses; copy nothing else."""
        voxel_map.table(scoring.covariance)

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on."""
        self._map = voxel_map

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Store a scan; return the number of points above the limit."""
        return self._source.take(points)

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return the evaluations of (k, 6) poses; threads share the chunks of all poses."""
        check_batch(poses, self._max_poses)
        chunks = -(-len(self._source.points) // CHUNK_POINTS)
        each = max(self._max_rows // max(chunks, 1), 1)
        found: list[Evaluation] = []
        for first in range(0, len(poses), each):
            part = np.ascontiguousarray(poses[first : first + each], np.float64)
            found += self._evaluated(part, chunks, scoring)
        return found

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the next step from an evaluation."""
        step = np.empty(6)
        step_into(np.ascontiguousarray(at.hessian), np.ascontiguousarray(at.gradient), steady, step)
        return step

    def _evaluated(self, poses: NDArray[np.float64], chunks: int, scoring: Scoring) -> list[Evaluation]:
        derive(poses, scoring.pitch_sign, self._T, self._M)
        source = self._source.points
        units = len(poses) * chunks
        threads = min(len(self._scratch), max(units, 1))
        voxel_map = self._map
        gauss = gauss_for(voxel_map.leaf)
        # radius of one leaf: every neighbour within it lies in the 27 voxels around the point
        radius2 = voxel_map.leaf**2 if scoring.neighbors == "radius" else math.inf
        table = voxel_map.table(scoring.covariance)
        columns = self._columns[scoring.neighbors]

        def run(part: int) -> None:
            accumulate(
                source,
                chunks,
                CHUNK_POINTS,
                units * part // threads,
                units * (part + 1) // threads,
                self._T,
                self._M,
                1.0 / voxel_map.leaf,
                table,
                voxel_map.origins,
                voxel_map.box,
                voxel_map.column_start,
                voxel_map.column_cell,
                columns,
                radius2,
                gauss.d1,
                gauss.d2,
                *self._scratch[part],
                self._rows,
            )

        if self._pool is None or threads == 1:
            run(0)
        else:
            others = [self._pool.submit(run, part) for part in range(1, threads)]
            run(0)
            for other in others:
                other.result()
        found = np.empty((len(poses), CONTRACTED))
        contract(self._rows, chunks, self._M, found)
        return [_evaluation(row) for row in found]


def _evaluation(row: NDArray[np.float64]) -> Evaluation:
    score, nearest, reached, neighbours, cut_points, cut_neighbours = row[:6].tolist()
    return Evaluation(
        score=score,
        gradient=row[6:12],
        hessian=row[12:].reshape(6, 6),
        nearest=nearest,
        found=int(reached),
        neighbours=int(neighbours),
        cut_points=int(cut_points),
        cut_neighbours=int(cut_neighbours),
    )
