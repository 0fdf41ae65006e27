# SPDX-License-Identifier: Apache-2.0
"""Areas that a client requests, and tests which cell boxes they touch.

All coordinates are metres in the map frame.  Borders are closed: a box that only touches an area belongs to
it.  A *box* is ``(min_x, min_y, max_x, max_y)``.  ``z`` of an area is its range of heights, (lowest,
highest); None: all.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import msgspec
import numpy as np

from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Mask: TypeAlias = NDArray[np.bool_]

_R = TypeVar("_R", bound="_Round")


def _finite(kind: str, **values: float) -> None:
    for name, value in values.items():
        if not _is_finite(value):
            raise BadRequest(f"{kind}: {name} must be a finite number of metres, not {value!r}")


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value) and getattr(value, "shape", ()) == ()
    except (TypeError, ValueError, OverflowError):
        return False  # not a number


def checked_heights(z: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return a checked range of heights, (lowest, highest), metres, map frame; None: all.

    Raises
    ------
    BadRequest
        The range is not two numbers, the lower one first.
    """
    if z is None:
        return None
    try:
        lowest, highest = map(float, z)
    except (TypeError, ValueError, OverflowError):
        raise BadRequest(f"z must be (lowest, highest) in metres, not {z!r}") from None
    if not lowest <= highest:
        raise BadRequest(f"z must be (lowest, highest) in metres, not {z!r}")
    return lowest, highest


def heights_overlap(z: tuple[float, float], z_min: float, z_max: float) -> bool:
    """Return whether heights ``[z_min, z_max]`` touch the closed range ``z``; unknown (NaN) ones do."""
    return not (z_max < z[0] or z_min > z[1])


def _check_round(kind: str, area: _Round) -> None:
    _finite(kind, x=area.x, y=area.y, radius=area.radius)
    if area.radius < 0:
        raise BadRequest(f"{kind}: radius must not be negative, it is {area.radius!r}")
    _check_z(area)


def _check_z(area: _Round | Box) -> None:
    if area.z is not None:
        msgspec.structs.force_setattr(area, "z", checked_heights(area.z))


def _inside(bounds: tuple[float, float, float, float], x: float, y: float, radius: float) -> bool:
    min_x, min_y, max_x, max_y = bounds
    return min_x <= x - radius and x + radius <= max_x and min_y <= y - radius and y + radius <= max_y


class _Round(msgspec.Struct, frozen=True):
    """A place, and a distance from it."""

    x: float
    y: float
    radius: float
    z: tuple[float, float] | None = None

    @property
    def center(self) -> tuple[float, float]:
        """Point from which distance is measured."""
        return self.x, self.y

    def around(self: _R, x: float, y: float, wider_m: float = 0.0) -> _R:
        """Return the same area around another place, wider by ``wider_m`` on each side."""
        return type(self)(x, y, self.radius + wider_m, self.z)


class Circle(_Round, frozen=True):
    """True circle: a box belongs to it when its nearest point is within ``radius``."""

    def __post_init__(self) -> None:
        _check_round("circle", self)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest box around the area."""
        return self.x - self.radius, self.y - self.radius, self.x + self.radius, self.y + self.radius

    @property
    def reach(self) -> float:
        """Distance of the area's farthest point from its centre, metres."""
        return self.radius

    def contains_circle(self, x: float, y: float, radius: float) -> bool:
        """Return whether a circle lies wholly in this one, border included."""
        return math.hypot(x - self.x, y - self.y) + radius <= self.radius

    def overlaps(self, boxes: Floats) -> Mask:
        """Return which of ``boxes`` ((N, 4) float64) the circle touches, (N,) bool."""
        dx = np.maximum(np.maximum(boxes[:, 0] - self.x, self.x - boxes[:, 2]), 0.0)
        dy = np.maximum(np.maximum(boxes[:, 1] - self.y, self.y - boxes[:, 3]), 0.0)
        inside: Mask = dx * dx + dy * dy <= self.radius * self.radius
        return inside


class AutowareSquare(_Round, frozen=True):
    """Autoware's area test, to the letter: a square of half-side ``radius``.

    Autoware calls it a cylinder, but its first clause (box grown by the radius, closed borders)
    already contains the second (`cylinder_and_box_overlap_exists`, autoware_map_loader
    utils.cpp).  Centre, radius and boxes are rounded to float32 as in its messages; the
    arithmetic is double.
    """

    def __post_init__(self) -> None:
        _check_round("square", self)
        if max(abs(self.x), abs(self.y), self.radius) > float(np.finfo(np.float32).max):
            raise BadRequest("square: a coordinate does not fit Autoware's float32")

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Box that contains every box the square touches, float32 rounding included."""
        x, y, radius = (float(np.float32(v)) for v in (self.x, self.y, self.radius))
        return x - radius, y - radius, x + radius, y + radius

    @property
    def reach(self) -> float:
        """Distance of the area's farthest point from its centre, metres."""
        return math.sqrt(2.0) * self.radius

    def contains_circle(self, x: float, y: float, radius: float) -> bool:
        """Return whether a circle surely lies wholly in the square, allowing for float32 rounding."""
        bounds = self.bounds
        margin = float(np.spacing(np.float32(max(map(abs, bounds)))))  # possible rounding error of a box
        return _inside(bounds, x, y, radius + margin)

    def overlaps(self, boxes: Floats) -> Mask:
        """Return which of ``boxes`` ((N, 4) float64) the square touches, (N,) bool."""
        x, y, radius = (float(np.float32(v)) for v in (self.x, self.y, self.radius))
        rounded = boxes.astype(np.float32).astype(np.float64)
        inside: Mask = (
            (rounded[:, 0] - radius <= x)
            & (x <= rounded[:, 2] + radius)
            & (rounded[:, 1] - radius <= y)
            & (y <= rounded[:, 3] + radius)
        )
        return inside


class Box(msgspec.Struct, frozen=True):
    """Axis-aligned rectangle."""

    min_x: float
    min_y: float
    max_x: float
    max_y: float
    z: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        _finite("box", min_x=self.min_x, min_y=self.min_y, max_x=self.max_x, max_y=self.max_y)
        if self.min_x > self.max_x or self.min_y > self.max_y:
            raise BadRequest(
                f"box: need min <= max, not x {self.min_x!r}..{self.max_x!r},"
                f" y {self.min_y!r}..{self.max_y!r}",
                hint="the order is min_x, min_y, max_x, max_y",
            )
        _check_z(self)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The box itself."""
        return self.min_x, self.min_y, self.max_x, self.max_y

    @property
    def center(self) -> tuple[float, float]:
        """Point from which distance is measured."""
        return (self.min_x + self.max_x) / 2, (self.min_y + self.max_y) / 2

    def around(self, x: float, y: float, wider_m: float = 0.0) -> Box:
        """Return the same area around another place, wider by ``wider_m`` on each side."""
        dx = 0.5 * (self.max_x - self.min_x) + wider_m
        dy = 0.5 * (self.max_y - self.min_y) + wider_m
        return Box(x - dx, y - dy, x + dx, y + dy, self.z)

    @property
    def reach(self) -> float:
        """Distance of the area's farthest point from its centre, metres."""
        return 0.5 * math.hypot(self.max_x - self.min_x, self.max_y - self.min_y)

    def contains_circle(self, x: float, y: float, radius: float) -> bool:
        """Return whether a circle lies wholly in the rectangle, border included."""
        return _inside(self.bounds, x, y, radius)

    def overlaps(self, boxes: Floats) -> Mask:
        """Return which of ``boxes`` ((N, 4) float64) the rectangle touches, (N,) bool."""
        inside: Mask = (
            (boxes[:, 0] <= self.max_x)
            & (boxes[:, 2] >= self.min_x)
            & (boxes[:, 1] <= self.max_y)
            & (boxes[:, 3] >= self.min_y)
        )
        return inside


Area: TypeAlias = Circle | AutowareSquare | Box


def distance_to_boxes(x: float, y: float, boxes: Floats) -> Floats:
    """Return the distance from a point to the nearest point of each box ((N, 4) float64), (N,) metres."""
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    with np.errstate(over="ignore"):  # infinitely far
        distance: Floats = np.hypot(dx, dy)
    return distance
