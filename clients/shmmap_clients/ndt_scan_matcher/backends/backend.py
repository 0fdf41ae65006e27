# SPDX-License-Identifier: Apache-2.0
"""What computes score and derivatives: one small contract, several kinds of hardware."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Evaluation
from shmmap_clients.ndt_scan_matcher.matching.limits import Caps

__all__ = ["BACKENDS", "Backend", "Neighbors", "backend_named"]

Neighbors = Literal["direct1", "direct7", "radius"]


class Backend(Protocol):
    """Evaluates poses of one scan against one map.

    An implementation allocates what the caps allow when it is made, and nothing that grows later.
    One object serves one thread at a time.
    """

    name: str

    def set_map(self, voxel_map: VoxelMap) -> None:
        """Match against this map from now on; it is kept alive until the next."""

    def set_source(self, points: NDArray[np.floating]) -> int:
        """Take a scan, (N, 3), metres, sensor or base frame; returns how many points the cap left out."""

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


def _numba(caps: Caps, threads: int) -> Backend:
    from shmmap_clients.ndt_scan_matcher.backends.numba_backend import NumbaBackend

    return NumbaBackend(caps, threads)


def _numpy(caps: Caps, threads: int) -> Backend:
    from shmmap_clients.ndt_scan_matcher.backends.numpy_backend import NumpyBackend

    return NumpyBackend(caps, threads)


BACKENDS: Final[dict[str, Callable[[Caps, int], Backend]]] = {"numba": _numba, "numpy": _numpy}


def backend_named(name: str, caps: Caps, threads: int = 1) -> Backend:
    """Return a new backend.

    Parameters
    ----------
    name
        A key of `BACKENDS`; another program may add its own.
    caps
        What its buffers are made for.
    threads
        How many it may use; results do not depend on it.

    Raises
    ------
    BadRequest
        There is no such backend.
    """
    if name not in BACKENDS:
        raise BadRequest(f"unknown backend {name!r}", hint=f"backends are: {', '.join(BACKENDS)}")
    if threads < 1:
        raise BadRequest(f"the number of threads must be positive, it is {threads}")
    return BACKENDS[name](caps, threads)
