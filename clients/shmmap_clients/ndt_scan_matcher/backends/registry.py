# SPDX-License-Identifier: Apache-2.0
"""Backends by name, and the backend that continues after its device has failed.

The libraries of a backend are imported when the backend is chosen.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap.layers import needed_packages
from shmmap_clients.ndt_scan_matcher.backends.backend import (
    Backend,
    DeviceError,
    DeviceOptions,
    UploadStatistics,
)
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation, Scoring
from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

_T = TypeVar("_T")


def _numba(limits: Limits, threads: int, options: DeviceOptions) -> Backend:
    del options
    from shmmap_clients.ndt_scan_matcher.backends.numba_backend import NumbaBackend

    return NumbaBackend(limits, threads)


def _numpy(limits: Limits, threads: int, options: DeviceOptions) -> Backend:
    del options
    from shmmap_clients.ndt_scan_matcher.backends.numpy_backend import NumpyBackend

    return NumpyBackend(limits, threads)


def _opencl(limits: Limits, threads: int, options: DeviceOptions) -> Backend:
    from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend

    with needed_packages("the backend opencl"):
        return OpenclBackend(limits, threads, options)


BACKENDS: Final[dict[str, Callable[[Limits, int, DeviceOptions], Backend]]] = {
    "numba": _numba,
    "numpy": _numpy,
    "opencl": _opencl,
}


class FallbackBackend:
    """A backend on a device, with a second backend that takes over at the device's first fault.

    Parameters
    ----------
    first
        Backend on a device.
    second
        Backend that takes over; its buffers are allocated in advance.

    Attributes
    ----------
    fault
        Why the second backend computes; None while the first one does.
    """

    def __init__(self, first: Backend, second: Backend) -> None:
        self._first, self._second = first, second
        self._active = first
        self._map: VoxelMap | None = None
        self._points: NDArray[np.floating] | None = None
        self._lock = threading.Lock()
        self.max_map_bytes = min(first.max_map_bytes, second.max_map_bytes)
        self.fault: DeviceError | None = None

    @property
    def name(self) -> str:
        """Name of the backend that computes at present."""
        return self._active.name

    @property
    def on_device(self) -> bool:
        """Whether the backend that computes at present uses a device."""
        return self._active.on_device

    @property
    def uploads(self) -> UploadStatistics:
        """Uploads of the backend on a device."""
        return self._first.uploads

    def close(self) -> None:
        """Release threads and memory."""
        self._first.close()
        self._second.close()

    def prepare(self, voxel_map: VoxelMap, scoring: Scoring) -> None:
        """Prepare both backends for this map, so that evaluations need not wait for it."""
        self._second.prepare(voxel_map, scoring)
        if self._active is self._first:
            try:
                self._first.prepare(voxel_map, scoring)
            except DeviceError as error:
                self._give_up(error)

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on."""
        self._map = voxel_map
        self._trying(lambda backend: backend.set_map(voxel_map))

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Store a scan; return the number of points above the limit."""
        self._points = points
        return self._trying(lambda backend: backend.set_source(points))

    def evaluate(self, poses: NDArray[np.float64], scoring: Scoring) -> list[Evaluation]:
        """Return the evaluations of (k, 6) poses."""
        return self._trying(lambda backend: backend.evaluate(poses, scoring))

    def step(self, at: Evaluation, steady: bool, /) -> NDArray[np.float64]:
        """Return the next step from an evaluation."""
        return self._active.step(at, steady)

    def _trying(self, work: Callable[[Backend], _T]) -> _T:
        if self.fault is None:
            try:
                return work(self._first)
            except DeviceError as error:
                self._give_up(error)
        if self._active is self._first:
            # first call after the fault: pass the first backend's map and scan to the second
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


def backend_named(
    name: str,
    limits: Limits,
    threads: int = 1,
    options: DeviceOptions | None = None,
    *,
    fallback: str | None = None,
) -> Backend:
    """Return a new backend.

    Parameters
    ----------
    name
        A key of `BACKENDS`; another program may add its own.
    limits
        Limits that set the size of its buffers.
    threads
        Number of threads it may use; results do not depend on it.
    options
        Options of a backend that computes on a device.
    fallback
        Name of the backend that takes over if a device fails later.

    Raises
    ------
    BadRequest
        There is no such backend.
    DeviceError
        There is no such device, or it lacks a required feature; also raised if there is a fallback.
    """
    for one in (name, fallback):
        if one is not None and one not in BACKENDS:
            raise BadRequest(f"unknown backend {one!r}", hint=f"backends are: {', '.join(BACKENDS)}")
    if threads < 1:
        raise BadRequest(f"the number of threads must be positive, it is {threads}")
    made = BACKENDS[name](limits, threads, options if options is not None else DeviceOptions())
    if fallback is None or not made.on_device:
        return made
    return FallbackBackend(made, backend_named(fallback, limits, threads, options))
