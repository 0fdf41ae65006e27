# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-elevation``: ``build`` the elevation of the whole map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from shmmap_clients.command_line import run_program
from shmmap_clients.elevation_map.cli import build

__all__ = ["main"]

_VERBS: Final = (build,)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        "shmmap-elevation", "Make the elevation map of a point-cloud map of any size.", _VERBS, argv
    )
