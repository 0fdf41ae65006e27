# SPDX-License-Identifier: Apache-2.0
"""The inner loops of dividing, compiled: find each point's cell, and sort points by cell.

The loops release the interpreter's lock, so that blocks are processed in parallel.  Compiled code is stored
in the cache directory if that is writable; else compiling takes a second or two at each start.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.compiling import compiled

NOWHERE: Final = -(1 << 31)
"""Index of a point that is not finite."""

_LIMIT: Final = float((1 << 31) - 2)
_EXACT: Final = float(1 << 52)  # up to this many units of the lattice, and one cell more, float64 is exact
# In cells: nearer to a border the exact corners decide. Rounding errs by 2**31 * 2**-52 = 5e-7 at most.
_NEAR: Final = 1e-5


@compiled()
def _index(value: float, per_metre: float, origin: float, step: int, first: int, scale: int) -> float:
    """Return the index of the cell that contains ``value`` on one axis, as an integral float64."""
    quotient = (value - origin) * per_metre  # a division would take twice as long
    index: float = np.floor(quotient)
    part = quotient - index
    if (part < _NEAR or part > 1.0 - _NEAR) and abs(index) < _LIMIT:
        whole = np.int64(index)
        if value < (first + whole * step) / scale:
            index -= 1.0
        elif value >= (first + (whole + 1) * step) / scale:
            index += 1.0
    return index


@compiled()
def assign_cells(
    x: NDArray[Any],
    y: NDArray[Any],
    z: NDArray[Any],
    lattice: tuple[float, float, float, int, int, int, int],
    ix: NDArray[np.int32],
    iy: NDArray[np.int32],
    extremes: NDArray[np.float64],
) -> tuple[int, int, int, int, int]:
    """Write each point's cell to ``ix`` and ``iy``; widen ``extremes`` (2, 3) by the finite points.

    Parameters
    ----------
    x, y, z
        (N,) float32 or float64, any stride, metres.
    lattice
        (size, origin_x, origin_y) in metres; (step, origin_x, origin_y, scale) as integers.

    Returns
    -------
    Number of finite points, then their least and greatest ix, and their least and greatest iy.  The number is
    -1 if some point is more than 2**31 cells or 2**52 units of the lattice away.
    """
    size, origin_x, origin_y, step, first_x, first_y, scale = lattice
    per_metre = 1.0 / size
    reach = _EXACT / scale
    kept = 0
    low_x = low_y = np.int64(1 << 31)
    high_x = high_y = np.int64(-(1 << 31))
    a0 = a1 = a2 = np.inf
    b0 = b1 = b2 = -np.inf
    for row in range(len(x)):
        u, v, w = np.float64(x[row]), np.float64(y[row]), np.float64(z[row])
        if not (np.isfinite(u) and np.isfinite(v) and np.isfinite(w)):
            ix[row] = NOWHERE
            iy[row] = NOWHERE
            continue
        if not (abs(u) < reach and abs(v) < reach):
            return -1, 0, 0, 0, 0
        i = _index(u, per_metre, origin_x, step, first_x, scale)
        j = _index(v, per_metre, origin_y, step, first_y, scale)
        if not (abs(i) < _LIMIT and abs(j) < _LIMIT):
            return -1, 0, 0, 0, 0
        m, n = np.int64(i), np.int64(j)
        ix[row] = m
        iy[row] = n
        kept += 1
        low_x, high_x = min(low_x, m), max(high_x, m)
        low_y, high_y = min(low_y, n), max(high_y, n)
        a0, b0 = min(a0, u), max(b0, u)
        a1, b1 = min(a1, v), max(b1, v)
        a2, b2 = min(a2, w), max(b2, w)
    extremes[0, 0], extremes[0, 1], extremes[0, 2] = (
        min(extremes[0, 0], a0),
        min(extremes[0, 1], a1),
        min(extremes[0, 2], a2),
    )
    extremes[1, 0], extremes[1, 1], extremes[1, 2] = (
        max(extremes[1, 0], b0),
        max(extremes[1, 1], b1),
        max(extremes[1, 2], b2),
    )
    return kept, low_x, high_x, low_y, high_y


@compiled()
def count_cells(
    ix: NDArray[np.int32],
    iy: NDArray[np.int32],
    low_x: int,
    low_y: int,
    width: int,
    counts: NDArray[np.int64],
) -> None:
    """Count the points in each cell of a window, at index ``(iy - low_y) * width + (ix - low_x)``."""
    for row in range(len(ix)):
        if ix[row] != NOWHERE:
            counts[(np.int64(iy[row]) - low_y) * width + (np.int64(ix[row]) - low_x)] += 1


@compiled()
def scatter_rows(
    rows: NDArray[Any],
    ix: NDArray[np.int32],
    iy: NDArray[np.int32],
    low_x: int,
    low_y: int,
    width: int,
    places: NDArray[np.int64],
    out: NDArray[Any],
) -> None:
    """Copy rows (N, words) to ``out``, grouped by cell; within a cell they keep their order.

    ``places`` contains the index in ``out`` of each cell's next row, and is advanced.
    """
    words = rows.shape[1]
    for row in range(len(ix)):
        if ix[row] == NOWHERE:
            continue
        cell = (np.int64(iy[row]) - low_y) * width + (np.int64(ix[row]) - low_x)
        place = places[cell]
        places[cell] = place + 1
        for word in range(words):
            out[place, word] = rows[row, word]
