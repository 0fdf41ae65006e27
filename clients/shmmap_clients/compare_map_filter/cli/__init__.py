# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-compare``: ``follow`` a drive on the daemon's map, ``apply`` to files, ``warmup``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shmmap_clients.command_line import run_program
from shmmap_clients.compare_map_filter.cli import apply, follow, warmup

__all__ = ["main"]

_VERBS: Final = (follow, apply, warmup)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        "shmmap-compare",
        "Remove from LiDAR scans what a point-cloud map explains; what moved is left.",
        _VERBS,
        argv,
    )
