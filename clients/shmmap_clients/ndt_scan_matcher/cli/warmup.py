# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt warmup``: compile the kernels and keep them on disk, or in the device driver's cache."""

from __future__ import annotations

import argparse
import time
from typing import Any

from shmmap_clients.backend_options import add_device_options, device_options_from

__all__ = ["add_parser", "run"]


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
    from shmmap_clients.ndt_scan_matcher.cli.warmup_alignment import warmup_alignment

    loaded = kernels.loaded_from_cache()
    warmup_alignment()
    what = "loaded from the cache" if loaded else "compiled"
    print(f"kernels {what} in {time.monotonic() - begin:.1f} s")
    return 0


def _build_programs(args: argparse.Namespace, begin: float) -> int:
    from shmmap_clients.ndt_scan_matcher.cli.warmup_alignment import warmup_alignment
    from shmmap_clients.ndt_scan_matcher.matching.settings import Settings

    device = device_options_from(args)
    for search in ("radius", "direct7", "direct1"):
        warmup_alignment(Settings(neighbors=search, backend="opencl", device=device))
    print(f"programs built, or loaded from the driver's cache, in {time.monotonic() - begin:.1f} s")
    return 0
