# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-ndt``: ``align`` files, ``follow`` a drive, and verbs about the machine."""

from __future__ import annotations

from collections.abc import Sequence

from shmmap_clients.command_line import run_program
from shmmap_clients.ndt_scan_matcher.cli import align, follow, machine


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        "shmmap-ndt",
        "Find where LiDAR scans were taken in a point-cloud map, by the normal distributions transform.",
        (align.add_parser, follow.add_parser, machine.add_parser),
        argv,
    )
