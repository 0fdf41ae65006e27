# SPDX-License-Identifier: Apache-2.0
"""How long a device takes: the program, a map, one evaluation, a batch; beside the processor."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from shmmap_clients.ndt_scan_matcher.backends.backend import Backend
from shmmap_clients.ndt_scan_matcher.backends.device_options import DeviceOptions
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.device_check.scenes import Scene
from shmmap_clients.ndt_scan_matcher.matching.limits import Limits

__all__ = ["latencies"]

_REPEATS: Final = 200
_POSES: Final = 200
_BATCH_REPEATS: Final = 20


def latencies(scene: Scene, device: DeviceOptions) -> dict[str, Any]:
    """Return times of one scene on a device, milliseconds.

    Returns
    -------
    dict
        ``points``, ``voxels``; ``program_ms``: until the program is built; ``map_ms``: until the map can be
        used; ``set_map_ms``; ``evaluation_ms`` and, with the time until 200 poses are evaluated,
        ``batch_ms``: {"min", "p50", "p99", "max"}.
    """
    pose = np.array(scene.cases[0].guess)
    how: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    backend: Backend = backend_named("opencl", Limits(source_points=len(scene.scan)), options=device)
    backend.set_source(scene.scan)
    begin = time.perf_counter()
    backend.evaluate(pose, **how)
    program_ms = (time.perf_counter() - begin) * 1e3
    begin = time.perf_counter()
    backend.prepare(scene.voxel_map, **how)
    map_ms = (time.perf_counter() - begin) * 1e3
    begin = time.perf_counter()
    backend.set_map(scene.voxel_map)
    set_map_ms = (time.perf_counter() - begin) * 1e3
    poses = pose + np.linspace(-1.0, 1.0, _POSES)[:, None] * np.array([2.0, 2.0, 0.0, 0.0, 0.0, 0.2])
    found = {
        "points": len(scene.scan),
        "voxels": scene.voxel_map.voxels,
        "program_ms": program_ms,
        "map_ms": map_ms,
        "set_map_ms": set_map_ms,
        "evaluation_ms": _spread(lambda: backend.evaluate(pose, **how), _REPEATS),
        "batch_ms": _spread(lambda: backend.evaluate_many(poses, **how), _BATCH_REPEATS),
    }
    backend.close()
    return found


def _spread(work: Callable[[], object], repeats: int) -> dict[str, float]:
    work()
    took = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        took.append((time.perf_counter() - begin) * 1e3)
    p50, p99 = np.percentile(took, [50, 99]).tolist()
    return {"min": min(took), "p50": p50, "p99": p99, "max": max(took)}
