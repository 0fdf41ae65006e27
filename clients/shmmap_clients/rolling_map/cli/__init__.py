# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-rolling``: ``run`` a drive into a live map, ``config`` from a parameter file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shmmap_clients.command_line import run_program
from shmmap_clients.rolling_map.cli import config, run

__all__ = ["main"]

_VERBS: Final = (run, config)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        "shmmap-rolling",
        "Map LiDAR scans with poses into a live map: which voxels are occupied, and which are free.",
        _VERBS,
        argv,
    )
