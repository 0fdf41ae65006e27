# SPDX-License-Identifier: Apache-2.0
"""At which heights the vehicle may stand: Autoware's rule, and one that a stray low point cannot mislead."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import Cell, ground_height

__all__ = ["ground_heights"]

_AROUND_M: Final = 4.0
_SAME_M: Final = 0.3


def ground_heights(cells: Sequence[Cell], x: float, y: float) -> tuple[float | None, list[float]]:
    """Return the ground's height by Autoware's rule, and all heights worth a try.

    The rule takes the lowest point near the place.  Where a reflection lies metres below the street it
    answers with that; the median of the columns' lowest points within 4 m does not.

    Parameters
    ----------
    cells
        ``ground`` layers.
    x, y
        Metres, map frame.

    Returns
    -------
    ground_z : float or None
        Metres, map frame; None where there is no ground within 50 m.
    heights : list of float
        The rule's, then the median where it is another one; empty where there is no ground.
    """
    grids = [(cell["min"], cell.header.lattice) for cell in cells]
    known = [(low, lattice) for low, lattice in grids if lattice is not None]
    rule = ground_height(known, x, y)
    if rule is None:
        return None, []
    near: list[NDArray[np.float32]] = []
    for low, lattice in known:
        edge = lattice.leaf[0]
        i, j = int(np.floor(x / edge)) - lattice.first[0], int(np.floor(y / edge)) - lattice.first[1]
        reach = int(np.ceil(_AROUND_M / edge))
        part = low[max(j - reach, 0) : max(j + reach + 1, 0), max(i - reach, 0) : max(i + reach + 1, 0)]
        near.append(part[~np.isnan(part)])
    columns = np.concatenate([np.empty(0, np.float32), *near])
    if not len(columns):
        return rule, [rule]
    median = float(np.median(columns))
    return rule, [rule] if abs(median - rule) < _SAME_M else [rule, median]
