# SPDX-License-Identifier: Apache-2.0
"""The compiled backend: no lock of the interpreter held, any number of threads, the same result."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import Neighbors
from shmmap_clients.ndt_scan_matcher.backends.kernels import accumulate
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import euler_derivatives, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.matching.evaluation import (
    CHUNK_POINTS,
    SUMS,
    Evaluation,
    gauss_for,
    search_columns,
    total,
)
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits, check_batch
from shmmap_clients.ndt_scan_matcher.matching.scan_buffer import ScanBuffer
from shmmap_clients.ndt_scan_matcher.matching.steps import numpy_step

__all__ = ["NumbaBackend"]


class NumbaBackend:
    """`Backend` over the compiled kernel.

    The scan is cut into chunks of a fixed size, each with a row of sums of its own; threads take
    runs of chunks, and rows are added in order: no result depends on the number of threads.
    """

    name = "numba"
    on_device = False

    def __init__(self, limits: Limits, threads: int = 1) -> None:
        self._source = ScanBuffer(limits.source_points)
        self._most_poses = limits.poses
        self.most_map_bytes = limits.most_map_bytes
        self._map = VoxelMap({})
        self._rows = np.zeros((-(-limits.source_points // CHUNK_POINTS), SUMS))
        self._scratch = [
            (np.empty((limits.neighbors, 4)), np.empty(limits.neighbors, np.int64)) for _ in range(threads)
        ]
        self._columns = {name: search_columns(name) for name in ("direct1", "direct7", "radius")}
        self._pool = ThreadPoolExecutor(threads - 1, "ndt") if threads > 1 else None

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def prepare(self, voxel_map: VoxelMap, *, neighbors: Neighbors, covariance: Covariance) -> None:
        """Derive covariances and the table of addresses; nothing else is copied."""
        del neighbors
        voxel_map.table(covariance)

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on."""
        self._map = voxel_map

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Take a scan; returns how many points the limit left out."""
        return self._source.take(points)

    def evaluate(
        self,
        pose: NDArray[np.float64],
        *,
        neighbors: Neighbors,
        covariance: Covariance,
        pitch_sign: float = -1.0,
        T: NDArray[np.float64] | None = None,
        deadline_s: float | None = None,
    ) -> Evaluation:
        """Return score, gradient and Hessian at a pose vector."""
        del deadline_s
        source = self._source.points
        chunks = -(-len(source) // CHUNK_POINTS)
        threads = min(len(self._scratch), max(chunks, 1))
        voxel_map = self._map
        gauss = gauss_for(voxel_map.leaf)
        # one leaf: every neighbour in reach of the radius lies in the 27 cells around the point
        radius2 = voxel_map.leaf**2 if neighbors == "radius" else math.inf
        table = voxel_map.table(covariance)
        matrix = matrix_from_pose(pose) if T is None else T
        derivatives = euler_derivatives(pose, pitch_sign)

        def run(part: int) -> None:
            near, near_inverse = self._scratch[part]
            accumulate(
                source,
                chunks * part // threads,
                chunks * (part + 1) // threads,
                CHUNK_POINTS,
                matrix,
                derivatives,
                table,
                voxel_map.origins,
                voxel_map.box,
                voxel_map.column_start,
                voxel_map.column_cell,
                self._columns[neighbors],
                1.0 / voxel_map.leaf,
                radius2,
                gauss.d1,
                gauss.d2,
                near,
                near_inverse,
                self._rows,
            )

        if self._pool is None or threads == 1:
            run(0)
        else:
            others = [self._pool.submit(run, part) for part in range(1, threads)]
            run(0)
            for other in others:
                other.result()
        return total(self._rows[:chunks], pose, pitch_sign)

    def evaluate_many(
        self,
        poses: NDArray[np.float64],
        *,
        neighbors: Neighbors,
        covariance: Covariance,
        pitch_sign: float = -1.0,
        deadline_s: float | None = None,
    ) -> list[Evaluation]:
        """Return the same as `evaluate` for each of (k, 6) poses."""
        del deadline_s
        check_batch(poses, self._most_poses)
        return [
            self.evaluate(pose, neighbors=neighbors, covariance=covariance, pitch_sign=pitch_sign)
            for pose in poses
        ]

    def step(self, at: Evaluation, *, steady: bool) -> NDArray[np.float64]:
        """Return the step that an evaluation asks for."""
        return numpy_step(at, steady)
