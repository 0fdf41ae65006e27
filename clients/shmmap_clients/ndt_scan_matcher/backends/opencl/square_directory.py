# SPDX-License-Identifier: Apache-2.0
"""Which cells a square of the lattice touches: the directory of a map on a device, a few kilobytes.

A place for each square of 8 x 8 columns instead of one for each column: what is written for every map is
small.  The kernel tests whether a cell really has the column.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["squares_of"]

_SHIFT: Final = 3  # as in the kernel


def squares_of(
    first: NDArray[np.int64], shape: NDArray[np.int64]
) -> tuple[NDArray[np.int64], int, NDArray[np.int32], NDArray[np.int32]]:
    """Return the directory of cells.

    Parameters
    ----------
    first : (C, 2) int64
        Lattice index of each cell's first column, i and j.
    shape : (C, 2) int64
        How many columns it has; none where it has no voxels.

    Returns
    -------
    low : (2,) int64
        The first square's first column.
    squares : int
        In a row of j.
    start, cell : int32
        Where each square's cells begin in ``cell``, and the cells, in their order.
    """
    has = np.flatnonzero((shape > 0).all(axis=1))
    if not len(has):
        return np.zeros(2, np.int64), 1, np.zeros(2, np.int32), np.zeros(1, np.int32)
    begin, end = first[has] >> _SHIFT, ((first[has] + shape[has] - 1) >> _SHIFT) + 1
    low, high = begin.min(axis=0), end.max(axis=0)
    rows, squares = (high - low).tolist()
    # every cell with every square from its first to its last
    across, along = (end - begin).T
    number = across * along
    cell = np.repeat(np.arange(len(has)), number)
    nth = np.arange(int(number.sum())) - np.repeat(np.cumsum(number) - number, number)
    place = (
        (begin[cell, 0] - low[0] + nth // along[cell]) * squares + begin[cell, 1] - low[1] + nth % along[cell]
    )
    start = np.zeros(rows * squares + 1, np.int32)
    np.cumsum(np.bincount(place, minlength=rows * squares), out=start[1:])
    return low << _SHIFT, squares, start, has[cell[np.argsort(place, kind="stable")]].astype(np.int32)
