# SPDX-License-Identifier: Apache-2.0
"""Bounds of coordinates, and which points are finite, in one pass over a block.

The minimum and maximum of a block are needed anyway, and they show whether every coordinate is
finite: both propagate NaN, and an infinity is one of them.  Only a block in which they are not
finite pays for a mask.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bounds", "row_extremes"]

_GROUP: Final = 256  # rows folded into one long row, so that numpy reduces with vector instructions


def row_extremes(rows: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return minimum and maximum of each column of a C-contiguous (N, k) array, N > 0; NaN wins."""
    count, width = rows.shape
    whole = count - count % _GROUP
    parts = []
    if whole:
        parts.append(rows[:whole].reshape(-1, _GROUP * width))
    with np.errstate(invalid="ignore"):  # signalling NaNs
        low = [part.min(axis=0).reshape(-1, width).T.min(axis=1) for part in parts]
        high = [part.max(axis=0).reshape(-1, width).T.max(axis=1) for part in parts]
        if whole < count:
            rest = np.ascontiguousarray(rows[whole:].T)
            low.append(rest.min(axis=1))
            high.append(rest.max(axis=1))
        if len(low) == 1:
            return low[0], high[0]
        return np.minimum(low[0], low[1]), np.maximum(high[0], high[1])


class Bounds:
    """Bounds of all finite points seen so far, float64, metres."""

    def __init__(self) -> None:
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)

    def add(self, xyz: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Take a block of (N, 3) points in.

        Returns
        -------
        None if all are finite; else the mask of those that are, the only ones taken in.
        """
        if not len(xyz):
            return None
        low, high = row_extremes(xyz)
        if np.isfinite(low).all() and np.isfinite(high).all():
            self._take(low, high)
            return None
        mask: NDArray[np.bool_] = np.isfinite(xyz).all(axis=1)
        if mask.any():
            self._take(*row_extremes(np.ascontiguousarray(xyz[mask])))
        return mask

    def _take(self, low: NDArray[Any], high: NDArray[Any]) -> None:
        np.minimum(self._low, low, out=self._low)
        np.maximum(self._high, high, out=self._high)

    def result(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (min_xyz, max_xyz); NaN when no finite point was seen."""
        if (self._low > self._high).any():
            return np.full(3, np.nan), np.full(3, np.nan)
        return self._low.copy(), self._high.copy()
