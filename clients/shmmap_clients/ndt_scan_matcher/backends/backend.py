# SPDX-License-Identifier: Apache-2.0
"""`Backend`: what computes score and derivatives, one small contract for several kinds of hardware."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation

__all__ = ["Backend", "Neighbors"]

Neighbors = Literal["direct1", "direct7", "radius"]


class Backend(Protocol):
    """Evaluates poses of one scan against one map.

    An implementation allocates what the limits allow when it is made, and nothing that grows later.
    One object serves one thread at a time.
    """

    name: str

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; it is kept alive until the next."""

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Take a scan, (N, 3), metres, sensor or base frame; returns how many points the limit left out."""

    def evaluate(
        self,
        pose: NDArray[np.float64],
        *,
        neighbors: Neighbors,
        covariance: Covariance,
        pitch_sign: float = -1.0,
        T: NDArray[np.float64] | None = None,
    ) -> Evaluation:
        """Return score, gradient and Hessian at a pose vector; ``T`` is its matrix, where known better."""

    def close(self) -> None:
        """Give back threads and memory."""
