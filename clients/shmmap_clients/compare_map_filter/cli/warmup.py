# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare warmup``: compile the kernel now, so that the first scan does not wait for it."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernel and cache it",
        description="Compile the kernel and keep it (~/.cache/shmmap/kernels, or NUMBA_CACHE_DIR), so"
        " that no filter has to wait for the compiler.",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Import the kernel: it is compiled for its types by that."""
    import time

    del args
    begin = time.perf_counter()
    from shmmap_clients.compare_map_filter import kernel

    variants = len(kernel.explain.signatures)  # type: ignore[attr-defined]
    print(f"{variants} variants ready after {time.perf_counter() - begin:.1f} s")
    return 0
