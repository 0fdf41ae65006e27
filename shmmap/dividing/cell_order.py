# SPDX-License-Identifier: Apache-2.0
"""The order of the points in a cell.

The default keeps the order of the input.  Measured on eight cells of a street map (2.1 million points from
a drive at 5 cm): the LZF of binary_compressed leaves 0.90 of the bytes in the input's order, 0.89 along
the Z-order curve, 0.92 at random; zlib 0.71, 0.73, 0.78.  Building `voxel` and `ndt` layers takes the same
time in all three, within 10 %: they sort by voxel themselves.  So sorting would win nothing here, and cost
the order of time, a second copy of the map on the disk and 70 ns a point.  Encoders of small differences
gain more from it (a tenth to nearly a half), and whoever packs a map for transport may ask for it.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["ORDERS", "morton_order"]

ORDERS: Final = ("input", "morton")

_BITS: Final = 16  # per axis: 0.3 mm in a cell of 20 m


def morton_order(rows: NDArray[np.void], size: float) -> NDArray[np.intp]:
    """Order of the rows along a Z-order curve through a cube of ``size`` metres, or as high as they are."""
    if not len(rows):
        return np.empty(0, np.intp)
    low = [float(rows[axis].min()) for axis in "xyz"]
    span = max(size, *(float(rows[axis].max()) - low[i] for i, axis in enumerate("xyz")))
    key = np.zeros(len(rows), np.uint64)
    for i, axis in enumerate("xyz"):
        scaled = (rows[axis].astype(np.float64) - low[i]) * (((1 << _BITS) - 1) / span)
        key |= _spread(scaled.astype(np.uint64)) << np.uint64(i)
    return np.argsort(key, kind="stable")


def _spread(values: NDArray[Any]) -> NDArray[np.uint64]:
    """Bits of each value three places apart (Hacker's Delight, the 3-D case of section 7-2)."""
    spread: NDArray[np.uint64] = values.astype(np.uint64)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
    return spread
