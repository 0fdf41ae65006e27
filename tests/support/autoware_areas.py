# SPDX-License-Identifier: Apache-2.0
"""Autoware's test of which cells an area touches, ported from autoware_map_loader's utils.cpp."""

from __future__ import annotations

import math
import struct

Rectangle = tuple[float, float, float, float]


def f32(value: float) -> float:
    """Round to float32 without numpy."""
    rounded: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return rounded


def cylinder_and_box_overlap_exists(x: float, y: float, radius: float, box: Rectangle) -> bool:
    """Both clauses; messages carry float32, the arithmetic is double."""
    x, y, radius = f32(x), f32(y), f32(radius)
    min_x, min_y, max_x, max_y = map(f32, box)
    if min_x - radius <= x <= max_x + radius and min_y - radius <= y <= max_y + radius:
        return True
    corners = ((min_x, min_y), (min_x, max_y), (max_x, min_y), (max_x, max_y))
    return any(math.hypot(x - cx, y - cy) <= radius for cx, cy in corners)
