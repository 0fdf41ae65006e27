# SPDX-License-Identifier: Apache-2.0
"""Points outside their cell's box: the cell was moved, and the map's metadata was not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["OutsideBox"]


class OutsideBox:
    """Counts points farther outside a box than float32 steps there; next to nothing where there are none.

    Attributes
    ----------
    count
        Points outside so far.
    """

    def __init__(self, box: tuple[float, float, float, float]) -> None:
        self._box = box
        # what wrote the file may have rounded to float32 on either side of the border
        step = float(np.spacing(np.float32(max(map(abs, box)))))
        self._low = box[0] - step, box[1] - step
        self._high = box[2] + step, box[3] + step
        self.count = 0

    def add(self, xyz: NDArray[Any], low: Sequence[float], high: Sequence[float]) -> None:
        """Count those of a block (N, 3); the bounds are of all points up to now, this block's included."""
        inside_x = low[0] >= self._low[0] and high[0] <= self._high[0]
        if inside_x and low[1] >= self._low[1] and high[1] <= self._high[1]:
            return
        outside = np.zeros(len(xyz), np.bool_)
        for axis in (0, 1):
            column = np.ascontiguousarray(xyz[:, axis])
            if column.dtype.kind != "f":
                column = column.astype(np.float64)
            # limits in the points' own type, rounded outwards: a comparison of two types is much slower
            least = np.nextafter(column.dtype.type(self._low[axis]), column.dtype.type(-np.inf))
            most = np.nextafter(column.dtype.type(self._high[axis]), column.dtype.type(np.inf))
            outside |= column < least
            outside |= column > most
        self.count += int(np.count_nonzero(outside))
