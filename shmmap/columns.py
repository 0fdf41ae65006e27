# SPDX-License-Identifier: Apache-2.0
"""Columns of a table of points, each with name, dtype, width and unit; and the bounds of points."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ColumnSpec:
    """One column: ``components`` values of ``dtype`` per row, in ``unit`` (SI, empty if unknown).

    One component means an array of shape (N,), more of shape (N, components).
    """

    name: str
    dtype: np.dtype[np.generic]
    components: int = 1
    unit: str = ""


def column_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return unique, printable names for columns beside ``xyz``, without names that PCD reserves.

    White space and unprintable characters become underscores; a name that is in use gets a number.
    """
    taken = {"xyz", "x", "y", "z", "_"}  # a field called _ is padding
    found: list[str] = []
    for name in names:
        word = "".join(char if char.isprintable() and not char.isspace() else "_" for char in name)
        new, number = word or "_unnamed", 1
        while new in taken:
            number += 1
            new = f"{word}_{number}"
        taken.add(new)
        found.append(new)
    return tuple(found)


_GROUP: Final = 512  # rows folded into one long row, so that numpy reduces with vector instructions


def row_extremes(rows: NDArray[Any]) -> tuple[list[float], list[float]]:
    """Return minimum and maximum of each column of a C-contiguous (N, k) array, N > 0; NaN wins."""
    with np.errstate(invalid="ignore"):  # signalling NaNs
        return _reduce(np.minimum, rows), _reduce(np.maximum, rows)


def _axis_extremes(axes: tuple[NDArray[Any], ...]) -> tuple[list[float], list[float]]:
    """Return minimum and maximum of each contiguous (N,) array, N > 0; NaN wins."""
    with np.errstate(invalid="ignore"):
        return [float(axis.min()) for axis in axes], [float(axis.max()) for axis in axes]


def _reduce(extreme: np.ufunc, rows: NDArray[Any]) -> list[float]:
    count, width = rows.shape
    whole = count - count % _GROUP
    if whole:
        folded = extreme.reduce(rows[:whole].reshape(-1, _GROUP * width), axis=0).reshape(_GROUP, width)
        rest = count - whole
        if rest:
            extreme(folded[:rest], rows[whole:], out=folded[:rest])
        rows = folded
    # transposed first: numpy would reduce along the short rows one by one
    values: list[float] = extreme.reduce(np.ascontiguousarray(rows.T), axis=1).tolist()
    return values


class Bounds:
    """Bounds of all finite points seen so far, float64, metres.

    The minimum and maximum of a block are needed anyway, and they show whether every coordinate is finite:
    both propagate NaN, and an infinity is itself an extreme.  Only a block with non-finite extremes needs a
    mask.

    Attributes
    ----------
    low, high
        Minimum and maximum x, y, z; +infinity and -infinity before the first point.
    """

    def __init__(self) -> None:
        self.low = [math.inf] * 3
        self.high = [-math.inf] * 3

    def add(self, xyz: NDArray[Any], axes: tuple[NDArray[Any], ...] = ()) -> NDArray[np.bool_] | None:
        """Add a block of (N, 3) points; ``axes`` are the same as contiguous x, y and z, if available.

        Returns
        -------
        None if all points are finite; else the mask of the finite points, which alone are added.
        """
        if not len(xyz):
            return None
        low, high = _axis_extremes(axes) if axes else row_extremes(xyz)
        if all(map(math.isfinite, low + high)):
            self._take(low, high)
            return None
        mask: NDArray[np.bool_] = np.isfinite(xyz).all(axis=1)
        if mask.any():
            self._take(*row_extremes(np.ascontiguousarray(xyz[mask])))
        return mask

    def _take(self, low: list[float], high: list[float]) -> None:
        self.low = list(map(min, self.low, low))
        self.high = list(map(max, self.high, high))

    def result(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (min_xyz, max_xyz); NaN when no finite point was seen."""
        if self.low[0] > self.high[0]:
            return np.full(3, np.nan), np.full(3, np.nan)
        return np.array(self.low), np.array(self.high)
