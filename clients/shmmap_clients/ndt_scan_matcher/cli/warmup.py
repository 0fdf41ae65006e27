# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt warmup``: compile the kernels and keep them on disk, or in the device driver's cache."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

from shmmap_clients.shared_options import add_device_options, device_options_from

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.matching.result import Result
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

__all__ = ["add_parser", "run", "warmup_alignment"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernels and cache them",
        description="Compile the kernels and keep them (~/.cache/shmmap/kernels, or NUMBA_CACHE_DIR), so"
        " that no program that aligns has to wait for the compiler.  With --backend opencl, build the"
        " device's programs, which its driver keeps (PoCL in POCL_CACHE_DIR).",
    )
    parser.add_argument(
        "--backend", choices=("numba", "opencl"), default="numba", help="whose kernels (default: numba)"
    )
    add_device_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compile, or load what was compiled, and say how long it took."""
    begin = time.monotonic()
    if args.backend == "opencl":
        return _build_programs(args, begin)
    from shmmap_clients.ndt_scan_matcher.backends import kernels

    loaded = kernels.loaded_from_cache()
    warmup_alignment()
    what = "loaded from the cache" if loaded else "compiled"
    print(f"kernels {what} in {time.monotonic() - begin:.1f} s")
    return 0


def _build_programs(args: argparse.Namespace, begin: float) -> int:
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

    device = device_options_from(args)
    for search in ("radius", "direct7", "direct1"):
        warmup_alignment(Settings(neighbors=search, backend="opencl", device=device))
    print(f"programs built, or loaded from the driver's cache, in {time.monotonic() - begin:.1f} s")
    return 0


def warmup_alignment(settings: Settings | None = None) -> Result:
    """Align the walls of a room of 8 m with themselves from a guess 0.2 m away.

    That takes milliseconds, and uses all that a real alignment needs.
    """
    import numpy as np

    from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

    line = np.arange(0.1, 8.0, 0.25)
    u, v = (grid.ravel() for grid in np.meshgrid(line, line))
    flat = np.full_like(u, 0.1)
    points = np.concatenate([np.stack(wall, axis=1) for wall in ((u, v, flat), (u, flat, v), (flat, u, v))])
    guess = np.eye(4)
    guess[:3, 3] = 0.2, -0.1, 0.1
    with NdtMatcher(settings) as matcher:
        matcher.set_map(matcher.prepare(VoxelMap({"room": voxel_cell(points, 2.0)})))
        return matcher.align(points, guess)
