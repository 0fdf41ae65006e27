# SPDX-License-Identifier: Apache-2.0
"""Verbs about this machine: ``warmup`` of kernels and devices, ``devices`` for ``--backend opencl``."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_json_option,
    add_verb,
    complain,
    nothing_found,
    print_json,
)
from shmmap_clients.shared_options import add_device_options, device_options_from

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceOptions
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
    from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors
    from shmmap_clients.ndt_scan_matcher.matching.result import Result
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

_DEVICES_JSON = """\
JSON (fields may be added, none is removed):
  [{"index", "name", "platform", "driver", "kind": GPU, accelerator, CPU or
    other, "fp64": double precision, "memory_bytes", "max_bytes": of one
    buffer, "unified": the processor's memory, "svm_system": reads shared
    memory in place, "unusable": why it cannot be used, else empty}]
Exit code: 0; 1 when there is no device that can be used."""
_UNEQUAL: Final = 1
_BOUNDS: Final = {True: 1e-12, False: 2e-4}
"""Largest difference from numpy, relative to the largest element, in double precision and in floats."""


def add_parser(subparsers: Any) -> None:
    """Add the verbs."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernels and cache them",
        description="Compile the kernels and keep them (~/.cache/shmmap/kernels, or NUMBA_CACHE_DIR), so"
        " that no program that aligns has to wait for the compiler.  With --backend opencl, build the"
        " device's programs, which its driver keeps (PoCL in POCL_CACHE_DIR), and compare what they"
        " compute with numpy: exit code 1 where that is something else.",
    )
    parser.add_argument(
        "--backend", choices=("numba", "opencl"), default="numba", help="whose kernels (default: numba)"
    )
    add_device_options(parser)
    parser.set_defaults(run=_warm_up)
    parser = add_verb(
        subparsers,
        "devices",
        _list_devices,
        help="list the devices for --backend opencl",
        description="List the OpenCL devices of this machine: what they can do, whether they can be used.",
        epilog=_DEVICES_JSON,
    )
    add_allow_empty(parser)
    add_json_option(parser)


def _room() -> tuple[VoxelMap, NDArray[np.float64]]:
    """Return the walls of a room of 8 m, as a map and as points (N, 3), metres."""
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap, voxel_cell

    line = np.arange(0.1, 8.0, 0.25)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    flat = np.full_like(u, 0.1)
    points = np.concatenate([np.stack(wall, axis=1) for wall in ((u, v, flat), (u, flat, v), (flat, u, v))])
    return VoxelMap({"room": voxel_cell(points, 2.0)}), points


def warmup_alignment(settings: Settings | None = None) -> Result:
    """Align the walls of a room of 8 m with themselves from a guess 0.2 m away.

    This runs all code of a real alignment within milliseconds.
    """
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

    voxel_map, points = _room()
    guess = np.eye(4)
    guess[:3, 3] = 0.2, -0.1, 0.1
    with NdtMatcher(settings) as matcher:
        matcher.set_map(matcher.prepare(voxel_map))
        return matcher.align(points, guess)


def _apart(neighbors: Neighbors, device: DeviceOptions) -> float:
    """Return how far a device's sums are from numpy's, relative to the largest element of each."""
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
    from shmmap_clients.ndt_scan_matcher.matching.evaluation import Scoring
    from shmmap_clients.ndt_scan_matcher.matching.settings import Limits

    voxel_map, points = _room()
    found = []
    for name in ("opencl", "numpy"):
        backend = backend_named(name, Limits(source_points=len(points)), options=device)
        backend.set_map(voxel_map)
        backend.set_source(points)
        pose = np.array([[0.2, -0.1, 0.1, 0.02, -0.03, 0.04]])
        (at,) = backend.evaluate(pose, Scoring(neighbors, "autoware"))
        found.append((np.array([at.score, at.nearest]), at.gradient, at.hessian))
        backend.close()
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(*found, strict=True))


def _warm_up(args: argparse.Namespace) -> int:
    """Compile the kernels, or load them from the cache, and print the time taken."""
    begin = time.monotonic()
    if args.backend == "opencl":
        return _warm_up_device(device_options_from(args), begin)
    from shmmap_clients.ndt_scan_matcher.backends import kernels

    loaded = kernels.loaded_from_cache()
    warmup_alignment()
    print(f"kernels {'loaded from the cache' if loaded else 'compiled'} in {time.monotonic() - begin:.1f} s")
    return 0


def _warm_up_device(device: DeviceOptions, begin: float) -> int:
    """Build a device's programs, and compare what they compute with numpy."""
    from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import choose_device
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

    searches: tuple[Neighbors, ...] = ("radius", "direct7", "direct1")
    for search in searches:
        warmup_alignment(Settings(neighbors=search, backend="opencl", device=device))
    print(f"programs built, or loaded from the driver's cache, in {time.monotonic() - begin:.1f} s")
    chosen = choose_device(device)
    wrong = {
        search: off for search in searches if not (off := _apart(search, device)) <= _BOUNDS[chosen.double]
    }
    if not wrong:
        print(f"{chosen.info.name} computes what numpy does")
        return 0
    said = ", ".join(f"{search}: {off:.1e} off" for search, off in wrong.items())
    complain(
        "shmmap-ndt",
        f"{chosen.info.name} computes something else than numpy ({said})",
        "do not use it: another driver may be right; report it with what `shmmap-ndt devices --json` says",
    )
    return _UNEQUAL


def _list_devices(args: argparse.Namespace) -> int:
    """List the devices; exit code 1 if none can be used."""
    from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import NO_DRIVER_HINT, list_devices

    found = list_devices()
    if args.json:
        print_json([asdict(info) for info in found])
    else:
        for info in found:
            print(info.describe())
    if any(not info.unusable for info in found):
        return 0
    return nothing_found(args, f"no OpenCL device can be used: {NO_DRIVER_HINT}", name="shmmap-ndt")
