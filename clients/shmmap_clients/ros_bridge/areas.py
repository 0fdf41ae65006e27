# SPDX-License-Identifier: Apache-2.0
"""Which cells an ``AreaInfo`` means, to the letter, the senseless ones included.

Autoware's test (``cylinder_and_box_overlap_exists``) is a square of half-side ``radius`` with closed borders,
on float32 numbers in double arithmetic. `shmmap.AutowareSquare` is that square for every area that makes
sense. Autoware also answers the others: a negative radius shrinks each box, infinity takes everything, and
what is no number touches nothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap import AutowareSquare

__all__ = ["sensible", "touches"]


def sensible(area: Any) -> AutowareSquare | None:
    """Return the square that an ``AreaInfo`` means; None where only `touches` knows."""
    x, y, radius = area.center_x, area.center_y, area.radius
    if not all(map(math.isfinite, (x, y, radius))) or radius < 0:
        return None
    return AutowareSquare(x, y, radius)


def touches(area: Any, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of ``boxes``, (N, 4) min_x min_y max_x max_y in metres, any ``AreaInfo`` touches; (N,)."""
    place = np.array([area.center_x, area.center_y], np.float64)
    radius = float(area.radius)
    low, high = (boxes[:, part].astype(np.float32).astype(np.float64) for part in ([0, 1], [2, 3]))
    with np.errstate(invalid="ignore"):
        inside: NDArray[np.bool_] = np.all((low - radius <= place) & (place <= high + radius), axis=1)
        # where x and radius are infinite and y is no number a corner is within the radius
        for corner in (low, high, np.stack([low[:, 0], high[:, 1]], 1), np.stack([high[:, 0], low[:, 1]], 1)):
            inside |= np.hypot(*(place - corner).T) <= radius
    return inside
