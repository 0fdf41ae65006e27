# SPDX-License-Identifier: Apache-2.0
"""Boxes as lines for RViz and Foxglove: one marker for all boxes of a state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

_WIDTH_M: Final = 0.15
_FLOOR: Final = ((0, 1), (1, 3), (3, 2), (2, 0))
_EDGES: Final = (*_FLOOR, (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def add_box(lines: list[Point], low: Sequence[float], high: Sequence[float]) -> None:
    """Append a box's edges, two points each; four of a box without height.

    Parameters
    ----------
    low, high
        x, y, z of two corners, metres.
    """
    x, y, z = zip(low, high, strict=True)
    corners = [Point(x=a, y=b, z=c) for c in z for b in y for a in x]
    for first, last in _EDGES if z[0] < z[1] else _FLOOR:
        lines += (corners[first], corners[last])


def line_markers(
    lines: Mapping[str, list[Point]], colours: Mapping[str, tuple[float, float, float, float]]
) -> MarkerArray:
    """Return a marker for each state, with the state as its namespace; one without lines removes the last.

    Parameters
    ----------
    lines
        Ends of lines by state, metres.
    colours
        Red, green, blue and opacity of each state, 0 to 1.
    """
    message = MarkerArray()
    for state, (red, green, blue, alpha) in colours.items():
        points = lines.get(state, [])
        marker = Marker(ns=state, type=Marker.LINE_LIST, points=points)
        marker.action = Marker.ADD if points else Marker.DELETE
        marker.scale.x, marker.pose.orientation.w = _WIDTH_M, 1.0
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
        message.markers.append(marker)
    return message
