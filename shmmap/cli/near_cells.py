# SPDX-License-Identifier: Apache-2.0
"""What is said to whoever names a cell that the map does not have: what was probably meant."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import print_line

if TYPE_CHECKING:
    from shmmap.client.client import Client

__all__ = ["near_cells_hint", "print_near_cells"]

_MOST_CELLS: Final = 20_000  # to look at each takes a second at most


def near_cells_hint(client: Client, unknown: Sequence[str]) -> str:
    """Return a hint for ids that the map does not have: those that look alike, or where ids are found."""
    import difflib

    if not unknown:
        return ""
    few = client.welcome.cells <= _MOST_CELLS
    names = [cell.id.rpartition("/")[2] for cell in client.metadata()] if few else []
    near: dict[str, None] = {}
    for one in unknown[:3]:
        near.update(dict.fromkeys(difflib.get_close_matches(one.rpartition("/")[2], names, n=1, cutoff=0.8)))
    if near:
        return f"did you mean {', '.join(near)}?"
    return "`shmmap query --circle X,Y,R` prints the ids of the cells around a place"


def print_near_cells(hint: str) -> None:
    """Print what `near_cells_hint` returned, on stderr."""
    if hint:
        print_line(f"hint: {hint}", file=sys.stderr)
