# SPDX-License-Identifier: Apache-2.0
"""Area tests against scalar arithmetic, and Autoware's against a port of its C++."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shmmap.errors import BadRequest
from shmmap.geometry import AutowareSquare, Box, Circle, distance_to_boxes, heights_overlap
from tests.support.divided_map import Rectangle, cylinder_and_box_overlap_exists, f32

whole = st.integers(-1_000_000, 1_000_000).map(float)
anywhere = st.floats(-1e6, 1e6)
coordinates = whole | anywhere
sizes = st.integers(0, 500).map(float) | st.floats(0, 1e4)
boxes = st.tuples(coordinates, coordinates, sizes, sizes).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


def near(point: tuple[float, float]) -> st.SearchStrategy[Rectangle]:
    """Boxes close to a point, borders that touch among them."""
    step = st.integers(-8, 8).map(lambda n: n * 2.5)
    return st.tuples(step, step, st.sampled_from([0.0, 2.5, 20.0]), st.sampled_from([0.0, 5.0, 20.0])).map(
        lambda b: (point[0] + b[0], point[1] + b[1], point[0] + b[0] + b[2], point[1] + b[1] + b[3])
    )


cases = st.tuples(whole, whole).flatmap(lambda p: st.tuples(st.just(p), boxes | near(p)))


@given(cases, sizes | st.sampled_from([0.0, 5.0, 12.5]))
@example(((16777217.0, 0.0), (0.0, 0.0, 16777216.0, 20.0)), 0.0)
def test_autoware_s_square(case: tuple[tuple[float, float], Rectangle], radius: float) -> None:
    (x, y), box = case
    expected = cylinder_and_box_overlap_exists(x, y, radius, box)
    square = AutowareSquare(x, y, radius)
    assert bool(square.overlaps(np.array([box]))[0]) == expected


@given(cases, sizes | st.sampled_from([0.0, 2.5, 5.0, 12.5]))
def test_circle(case: tuple[tuple[float, float], Rectangle], radius: float) -> None:
    """Exact arithmetic, but for what rounds to equal."""
    (x, y), box = case
    dx = max(Fraction(box[0]) - Fraction(x), Fraction(x) - Fraction(box[2]), Fraction(0))
    dy = max(Fraction(box[1]) - Fraction(y), Fraction(y) - Fraction(box[3]), Fraction(0))
    left, right = dx * dx + dy * dy, Fraction(radius) ** 2
    found = bool(Circle(x, y, radius).overlaps(np.array([box]))[0])
    if abs(left - right) > 4 * Fraction(2) ** -52 * max(left, right):
        assert found == (left <= right)
    elif all(float(v).is_integer() and abs(v) < 2**25 for v in (x, y, radius, *box)):
        assert found == (left <= right)  # nothing rounds: the border itself belongs to it


@given(boxes, boxes)
def test_box(area: Rectangle, box: Rectangle) -> None:
    expected = area[0] <= box[2] and box[0] <= area[2] and area[1] <= box[3] and box[1] <= area[3]
    assert bool(Box(*area).overlaps(np.array([box]))[0]) == expected


@given(cases)
def test_distance(case: tuple[tuple[float, float], Rectangle]) -> None:
    (x, y), box = case
    expected = math.hypot(max(box[0] - x, x - box[2], 0.0), max(box[1] - y, y - box[3], 0.0))
    assert distance_to_boxes(x, y, np.array([box]))[0] == pytest.approx(expected, rel=1e-12, abs=1e-12)


@given(coordinates, coordinates, sizes, boxes)
def test_bounds_contain_whatever_is_found(x: float, y: float, radius: float, box: Rectangle) -> None:
    """What an index looks up by the bounds alone misses nothing, rounding to float32 included."""
    square = AutowareSquare(x, y, radius)
    rounded = tuple(map(f32, box))
    low_x, low_y, high_x, high_y = square.bounds
    if square.overlaps(np.array([box]))[0]:
        assert low_x <= rounded[2]
        assert rounded[0] <= high_x
        assert low_y <= rounded[3]
        assert rounded[1] <= high_y


def test_touching_borders_belong() -> None:
    row = np.array([[20.0, 0.0, 40.0, 20.0]])
    for radius, expected in ((10.0, True), (np.nextafter(10.0, 0), False)):
        assert bool(Circle(10.0, 10.0, radius).overlaps(row)[0]) == expected
    assert AutowareSquare(10.0, 10.0, 10.0).overlaps(row)[0]
    assert Box(0.0, 0.0, 20.0, 20.0).overlaps(row)[0]
    corner = np.array([[13.0, 14.0, 20.0, 20.0]])
    assert Circle(10.0, 10.0, 5.0).overlaps(corner)[0]  # 3, 4, 5
    assert not Circle(10.0, 10.0, 4.999).overlaps(corner)[0]
    assert AutowareSquare(10.0, 10.0, 4.0).overlaps(corner)[0]  # a square reaches its corner


def test_many_boxes_at_once() -> None:
    rng = np.random.default_rng(2)
    corners = rng.uniform(-100, 100, (500, 2))
    table = np.column_stack([corners, corners + 20])
    for area in (Circle(3, 4, 50), AutowareSquare(3, 4, 50), Box(-40, -50, 60, 30)):
        each = [bool(area.overlaps(row[np.newaxis])[0]) for row in table]
        assert area.overlaps(table).tolist() == each
        assert area.overlaps(np.empty((0, 4))).tolist() == []


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_finite_is_refused(bad: float) -> None:
    for kind in (Circle, AutowareSquare):
        for place in range(3):
            x, y, radius = (bad if i == place else v for i, v in enumerate((1.0, 2.0, 3.0)))
            with pytest.raises(BadRequest):
                kind(x, y, radius)
    for place in range(4):
        x0, y0, x1, y1 = (bad if i == place else v for i, v in enumerate((0.0, 0.0, 1.0, 1.0)))
        with pytest.raises(BadRequest):
            Box(x0, y0, x1, y1)


def test_nonsense_is_refused() -> None:
    for make in (
        lambda: Circle(0, 0, -1e-300),
        lambda: AutowareSquare(0, 0, -1),
        lambda: AutowareSquare(1e39, 0, 1),
        lambda: Box(1, 0, 0, 1),
        lambda: Box(0, 1, 1, 0),
        lambda: Circle(0, 0, 1, (2, 1)),
        lambda: Box(0, 0, 1, 1, z=(math.nan, 1)),
        lambda: AutowareSquare(0, 0, 1, z=(1, 2, 3)),  # type: ignore[arg-type]
        lambda: Circle(0, 0, 1, z=5),  # type: ignore[arg-type]
    ):
        with pytest.raises(BadRequest):
            make()


def test_heights() -> None:
    z = Box(0, 0, 1, 1, z=(-1, 2)).z
    assert z == (-1.0, 2.0)
    assert heights_overlap(z, 2.0, 5.0)
    assert heights_overlap(z, -9.0, -1.0)
    assert heights_overlap(z, 0.0, 0.0)
    assert not heights_overlap(z, 2.1, 5.0)
    assert not heights_overlap(z, -9.0, -1.1)
    assert heights_overlap(z, math.nan, math.nan)  # not known yet
    assert heights_overlap((-math.inf, math.inf), 5.0, 6.0)
