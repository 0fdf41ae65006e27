# SPDX-License-Identifier: Apache-2.0
"""Points outside their cell's box: the cell was moved, and the map's metadata was not."""

from __future__ import annotations

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

    def add(self, xyz: NDArray[Any], bounds: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """Count those of a block (N, 3); ``bounds`` are of all points up to now, this block's included."""
        (low_x, low_y), (high_x, high_y) = bounds[0][:2].tolist(), bounds[1][:2].tolist()
        inside_x = low_x >= self._low[0] and high_x <= self._high[0]
        if inside_x and low_y >= self._low[1] and high_y <= self._high[1]:
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
