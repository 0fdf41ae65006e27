# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt warmup``: compile the kernels and keep them in numba's cache."""

from __future__ import annotations

import argparse
import time
from typing import Any

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernels and cache them",
        description="Compile the kernels and keep them in numba's cache (NUMBA_CACHE_DIR where it is set), so"
        " that no program that aligns has to wait for the compiler.",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compile, or load what was compiled, and say how long it took."""
    del args
    begin = time.monotonic()
    from shmmap_clients.ndt_scan_matcher.backends import kernels
    from shmmap_clients.ndt_scan_matcher.cli.warmup_alignment import warmup_alignment

    loaded = kernels.loaded_from_cache()
    warmup_alignment()
    what = "loaded from the cache" if loaded else "compiled"
    print(f"kernels {what} in {time.monotonic() - begin:.1f} s")
    return 0
