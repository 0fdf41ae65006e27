# SPDX-License-Identifier: Apache-2.0
"""A device, and what goes on without it: from the first fault on another backend computes, and says why."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import Backend, Neighbors
from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceError
from shmmap_clients.ndt_scan_matcher.backends.uploads import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation

__all__ = ["FallbackBackend"]

_T = TypeVar("_T")


class FallbackBackend:
    """`Backend` that is one until that fails, then another for good.

    Parameters
    ----------
    first
        On a device.
    second
        Its buffers are allocated from the beginning, so that going on costs nothing but the work itself.

    Attributes
    ----------
    fault
        Why the second one computes, or None.
    """

    def __init__(self, first: Backend, second: Backend) -> None:
        self._first, self._second = first, second
        self._active = first
        self._map: VoxelMap | None = None
        self._points: NDArray[np.floating] | None = None
        self._lock = threading.Lock()
        self.most_map_bytes = min(first.most_map_bytes, second.most_map_bytes)
        self.fault: DeviceError | None = None

    @property
    def name(self) -> str:
        """Of the one that computes."""
        return self._active.name

    @property
    def on_device(self) -> bool:
        """Of the one that computes."""
        return self._active.on_device

    @property
    def uploads(self) -> UploadStatistics:
        """Of the one on a device."""
        return self._first.uploads

    def close(self) -> None:
        """Give back threads and memory."""
        self._first.close()
        self._second.close()

    def prepare(self, voxel_map: VoxelMap, *, neighbors: Neighbors, covariance: Covariance) -> None:
        """Do in advance what evaluations with this map would have to wait for; of both."""
        self._second.prepare(voxel_map, neighbors=neighbors, covariance=covariance)
        if self._active is self._first:
            try:
                self._first.prepare(voxel_map, neighbors=neighbors, covariance=covariance)
            except DeviceError as error:
                self._give_up(error)

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on."""
        self._map = voxel_map
        self._trying(lambda backend: backend.set_map(voxel_map))

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Take a scan."""
        self._points = points
        return self._trying(lambda backend: backend.set_source(points))

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
        return self._trying(
            lambda backend: backend.evaluate(
                pose,
                neighbors=neighbors,
                covariance=covariance,
                pitch_sign=pitch_sign,
                T=T,
                deadline_s=deadline_s,
            )
        )

    def evaluate_many(
        self,
        poses: NDArray[np.float64],
        *,
        neighbors: Neighbors,
        covariance: Covariance,
        pitch_sign: float = -1.0,
        deadline_s: float | None = None,
    ) -> list[Evaluation]:
        """Return the evaluations of many poses."""
        return self._trying(
            lambda backend: backend.evaluate_many(
                poses,
                neighbors=neighbors,
                covariance=covariance,
                pitch_sign=pitch_sign,
                deadline_s=deadline_s,
            )
        )

    def step(self, at: Evaluation, *, steady: bool) -> NDArray[np.float64]:
        """Return the step that an evaluation asks for."""
        return self._active.step(at, steady=steady)

    def _trying(self, work: Callable[[Backend], _T]) -> _T:
        if self.fault is None:
            try:
                return work(self._first)
            except DeviceError as error:
                self._give_up(error)
        if self._active is self._first:
            # the first call since the fault: the second backend learns what the first one had
            if self._map is not None:
                self._second.set_map(self._map)
            if self._points is not None:
                self._second.set_source(self._points)
            self._active = self._second
        return work(self._second)

    def _give_up(self, error: DeviceError) -> None:
        with self._lock:
            if self.fault is None:
                self.fault = error
