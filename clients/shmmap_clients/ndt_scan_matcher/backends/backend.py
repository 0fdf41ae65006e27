# SPDX-License-Identifier: Apache-2.0
"""`Backend`: what computes score and derivatives, one small contract for several kinds of hardware."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.uploads import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation

__all__ = ["Backend", "Neighbors"]

Neighbors = Literal["direct1", "direct7", "radius"]


class Backend(Protocol):
    """Evaluates poses of one scan against one map.

    An implementation allocates what the limits allow when it is made, and nothing that grows later.
    One object serves one thread at a time.
    """

    @property
    def name(self) -> str:
        """As in `BACKENDS`."""

    @property
    def on_device(self) -> bool:
        """Whether the work is done elsewhere than in the threads of this process."""

    most_map_bytes: int
    """Of a map, see `Limits.map_bytes`: less than the limit where a device has not as much memory."""

    @property
    def uploads(self) -> UploadStatistics:
        """What `prepare` and evaluations wrote to a device for maps; one object, which goes on counting."""

    def prepare(self, voxel_map: VoxelMap, *, neighbors: Neighbors, covariance: Covariance) -> None:
        """Do in advance what evaluations with this map would have to wait for.

        It may be called in another thread, beside evaluations with the map in use.
        """

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
        deadline_s: float | None = None,
    ) -> Evaluation:
        """Return score, gradient and Hessian at a pose vector.

        Parameters
        ----------
        T
            The pose's matrix, where that is known better.
        deadline_s
            Of `time.monotonic`: how long a device is waited for at most; then it is an error.
        """

    def evaluate_many(
        self,
        poses: NDArray[np.float64],
        *,
        neighbors: Neighbors,
        covariance: Covariance,
        pitch_sign: float = -1.0,
        deadline_s: float | None = None,
    ) -> list[Evaluation]:
        """Return for each of (k, 6) poses what `evaluate` returns, to the last bit; k up to the limit."""

    def step(self, at: Evaluation, *, steady: bool) -> NDArray[np.float64]:
        """Return the step that an evaluation asks for: `upward_step` if steady, else `newton_step`."""

    def close(self) -> None:
        """Give back threads and memory; a hung device is not waited for."""
