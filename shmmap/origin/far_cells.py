# SPDX-License-Identifier: Apache-2.0
"""Cells far from all others: as a rule a stray point, which makes a map of 60 m one of 9 km."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["far_cells_notes"]

_APART_M: Final = 200.0  # cells this far apart, and ten times their size, are not one map's
_APART_CELLS: Final = 10
_FEW: Final = 3  # cells, or one in a hundred of all: more are another part of the map
_NAMED: Final = 3


def far_cells_notes(
    corners: NDArray[np.float64], size: float, names: Sequence[str], points: Sequence[int]
) -> list[str]:
    """Name the few cells that lie far from all others, one note for each group of them.

    Parameters
    ----------
    corners
        (N, 2) lower left corners, metres.
    size
        Side of a cell, metres.
    names, points
        Of each cell.
    """
    if len(corners) < 2 or not np.isfinite(corners).all():
        return []
    apart = max(_APART_M, _APART_CELLS * size)
    squares: dict[tuple[int, int], list[int]] = {}
    for index, (x, y) in enumerate(np.floor(corners / apart).astype(np.int64).tolist()):
        squares.setdefault((x, y), []).append(index)
    groups = sorted(_groups(squares), key=lambda group: (len(group), sum(points[i] for i in group)))
    main = corners[groups.pop()]
    notes = []
    for group in groups:
        if len(group) > max(_FEW, len(corners) // 100):
            continue
        own = corners[group]
        gaps = np.maximum(own.min(axis=0) - main.max(axis=0), main.min(axis=0) - own.max(axis=0))
        gap = float(np.hypot(*np.maximum(gaps - size, 0.0)))
        if gap >= apart:
            shown = ", ".join(names[i] for i in group[:_NAMED]) + (", ..." if len(group) > _NAMED else "")
            cells = "1 cell lies" if len(group) == 1 else f"{len(group)} cells lie"
            count = sum(points[i] for i in group)
            notes.append(
                f"{cells} {gap / 1000:.3g} km from all others, with {count} point{'' if count == 1 else 's'}"
                f" (stray ones?): {shown}"
            )
    return notes


def _groups(squares: dict[tuple[int, int], list[int]]) -> list[list[int]]:
    """Cells by whether their squares touch."""
    groups: list[list[int]] = []
    left = dict(squares)
    while left:
        group: list[int] = []
        waiting = [next(iter(left))]
        while waiting:
            x, y = waiting.pop()
            found = left.pop((x, y), None)
            if found is not None:
                group += found
                waiting += [(x + i, y + j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (x + i, y + j) in left]
        groups.append(group)
    return groups
