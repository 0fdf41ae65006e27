# SPDX-License-Identifier: Apache-2.0
"""Backends by name; what one of them needs is imported when it is chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap import BadRequest, needed_packages
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend
from shmmap_clients.ndt_scan_matcher.backends.device_options import DeviceOptions
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits

__all__ = ["BACKENDS", "backend_named"]


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
        What its buffers are made for.
    threads
        How many it may use; results do not depend on it.
    options
        For one that computes on a device.
    fallback
        Name of the backend that goes on where a device fails later.

    Raises
    ------
    BadRequest
        There is no such backend.
    DeviceError
        There is no such device, or it cannot do what is asked: also with a fallback.
    """
    for one in (name, fallback):
        if one is not None and one not in BACKENDS:
            raise BadRequest(f"unknown backend {one!r}", hint=f"backends are: {', '.join(BACKENDS)}")
    if threads < 1:
        raise BadRequest(f"the number of threads must be positive, it is {threads}")
    made = BACKENDS[name](limits, threads, options if options is not None else DeviceOptions())
    if fallback is None or not made.on_device:
        return made
    from shmmap_clients.ndt_scan_matcher.backends.fallback_backend import FallbackBackend

    return FallbackBackend(made, backend_named(fallback, limits, threads, options))
