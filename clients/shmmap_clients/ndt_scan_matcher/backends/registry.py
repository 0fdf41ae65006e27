# SPDX-License-Identifier: Apache-2.0
"""Backends by name; what one of them needs is imported when it is chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap import BadRequest
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits

__all__ = ["BACKENDS", "backend_named"]


def _numba(limits: Limits, threads: int) -> Backend:
    from shmmap_clients.ndt_scan_matcher.backends.numba_backend import NumbaBackend

    return NumbaBackend(limits, threads)


def _numpy(limits: Limits, threads: int) -> Backend:
    from shmmap_clients.ndt_scan_matcher.backends.numpy_backend import NumpyBackend

    return NumpyBackend(limits, threads)


BACKENDS: Final[dict[str, Callable[[Limits, int], Backend]]] = {"numba": _numba, "numpy": _numpy}


def backend_named(name: str, limits: Limits, threads: int = 1) -> Backend:
    """Return a new backend.

    Parameters
    ----------
    name
        A key of `BACKENDS`; another program may add its own.
    limits
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
    return BACKENDS[name](limits, threads)
