# SPDX-License-Identifier: Apache-2.0
"""Light from the north-west on a grid of heights, as maps are shaded."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["hillshade"]

_AZIMUTH: Final = math.radians(315.0)
_ALTITUDE: Final = math.radians(45.0)
_EXAGGERATION: Final = 2.0


def hillshade(heights: NDArray[np.float32], resolution: float) -> NDArray[np.uint8]:
    """Shade rows; the first and the last row, which only serve as neighbours, are left out.

    Slopes after Horn (1981); a missing neighbour counts as level.

    Parameters
    ----------
    heights
        (n + 2, columns) float32, metres, row 0 the southernmost; NaN where there is none.
    resolution
        Metres.

    Returns
    -------
    (n, columns, 2) uint8: grey, and 255 where there is a height, 0 where not.
    """
    middle = heights[1:-1].astype(np.float64)
    known = ~np.isnan(middle)
    wide = np.pad(heights, ((0, 0), (1, 1)), constant_values=np.nan).astype(np.float64)
    rows, columns = middle.shape

    def at(dy: int, dx: int) -> NDArray[np.float64]:
        near = wide[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
        return np.where(np.isnan(near), middle, near)

    span = 8 * resolution / _EXAGGERATION
    east = (at(-1, 1) + 2 * at(0, 1) + at(1, 1) - at(-1, -1) - 2 * at(0, -1) - at(1, -1)) / span
    north = (at(1, -1) + 2 * at(1, 0) + at(1, 1) - at(-1, -1) - 2 * at(-1, 0) - at(-1, 1)) / span
    light = np.array(
        [
            math.cos(_ALTITUDE) * math.sin(_AZIMUTH),
            math.cos(_ALTITUDE) * math.cos(_AZIMUTH),
            math.sin(_ALTITUDE),
        ]
    )
    shade = (light[2] - east * light[0] - north * light[1]) / np.sqrt(1 + east * east + north * north)
    grey = np.where(known, np.clip(shade, 0.0, 1.0) * 254 + 1, 0)
    return np.stack([grey.astype(np.uint8), np.where(known, 255, 0).astype(np.uint8)], axis=2)
