# SPDX-License-Identifier: Apache-2.0
"""Area queries against straightforward arithmetic, one cell at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.geometry import Area, AutowareSquare, Box, Circle
from shmmap.origin.spatial_index import SpatialIndex
from tests.support.divided_map import Rectangle, cylinder_and_box_overlap_exists


def circle_touches(x: float, y: float, radius: float, box: Rectangle) -> bool:
    nearest_x, nearest_y = min(max(x, box[0]), box[2]), min(max(y, box[1]), box[3])
    return (nearest_x - x) ** 2 + (nearest_y - y) ** 2 <= radius**2


def rectangle_touches(area: Rectangle, box: Rectangle) -> bool:
    return area[0] <= box[2] and box[0] <= area[2] and area[1] <= box[3] and box[1] <= area[3]


def brute_force(area: Area, boxes: NDArray[np.float64]) -> list[int]:
    def touches(box: Rectangle) -> bool:
        if isinstance(area, Circle):
            return circle_touches(area.x, area.y, area.radius, box)
        if isinstance(area, AutowareSquare):
            return cylinder_and_box_overlap_exists(area.x, area.y, area.radius, box)
        return rectangle_touches((area.min_x, area.min_y, area.max_x, area.max_y), box)

    return [i for i, (a, b, c, d) in enumerate(boxes.tolist()) if touches((a, b, c, d))]


@pytest.fixture(autouse=True)
def always_indexed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small catalogues skip the index; here it is what is tested."""
    monkeypatch.setattr("shmmap.origin.spatial_index._LINEAR_CELLS", 0)


def lattice(corner: float, side: int, size: float, seed: int = 0) -> NDArray[np.float64]:
    ix, iy = np.meshgrid(np.arange(side), np.arange(side))
    lower = np.column_stack((ix.ravel(), iy.ravel())) * size + corner
    np.random.default_rng(seed).shuffle(lower)
    return np.hstack((lower, lower + size))


@pytest.mark.parametrize("corner", [0.0, -400.0, -10.0, 89_000.0, 1e6, -1e6, 12.25])
@pytest.mark.parametrize("size", [20.0, 12.5, 100.0])
def test_lattice_queries_equal_brute_force(corner: float, size: float) -> None:
    boxes = lattice(corner, 21, size)
    index = SpatialIndex(boxes)
    rng = np.random.default_rng(int(abs(corner) + size))
    for _ in range(60):
        x, y = (corner + rng.uniform(-3 * size, 24 * size, 2)).tolist()
        # half of them exactly on borders and lattice points
        if rng.random() < 0.5:
            x, y = corner + size * round((x - corner) / size), corner + size * round((y - corner) / size)
        radius = float(rng.choice([0.0, size / 2, size, 2 * size, 55.0, 150.0, 1e5]))
        for area in (
            Circle(x, y, radius),
            AutowareSquare(x, y, radius),
            Box(x - radius, y - radius / 2, x + radius, y + radius),
        ):
            assert index.query(area).tolist() == brute_force(area, boxes), area


def test_borders_are_closed() -> None:
    boxes = np.array([[0.0, 0.0, 20.0, 20.0], [20.0, 0.0, 40.0, 20.0], [60.0, 60.0, 80.0, 80.0]])
    index = SpatialIndex(boxes)
    assert index.query(Circle(20.0, 10.0, 0.0)).tolist() == [0, 1]
    assert index.query(Circle(20.0, 20.0, 0.0)).tolist() == [0, 1]
    assert index.query(Circle(50.0, 10.0, 10.0)).tolist() == [1]
    assert index.query(Circle(50.0, 10.0, np.nextafter(10.0, 0.0))).tolist() == []
    assert index.query(Box(40.0, 20.0, 60.0, 60.0)).tolist() == [1, 2]
    assert index.query(AutowareSquare(100.0, 100.0, 20.0)).tolist() == [2]


@pytest.mark.parametrize("base", [100.0, 89_000.0, 1e6, 16_777_216.0, -1e6])
def test_autoware_square_where_float32_rounding_decides(base: float) -> None:
    """Boxes and centres a fraction of a float32 step apart, on both sides of the border."""
    step = float(np.spacing(np.float32(abs(base))))
    offsets = np.array([-1.5, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.5]) * step
    lower = np.column_stack((base + offsets, np.full(len(offsets), base)))
    boxes = np.vstack((np.hstack((lower, lower + 20.0)), lattice(base - 200.0, 20, 20.0)))
    index = SpatialIndex(boxes)
    decided_by_rounding = 0
    for radius in (0.0, 10.0, 20.0, 100.0):
        for offset in offsets.tolist():
            for side in (-radius, 20.0 + radius):
                area = AutowareSquare(base + side + offset, base + 10.0, radius)
                expected = brute_force(area, boxes)
                assert index.query(area).tolist() == expected
                exact = Box(area.x - radius, area.y - radius, area.x + radius, area.y + radius)
                decided_by_rounding += expected != brute_force(exact, boxes)
    assert decided_by_rounding > 0


coordinate = st.floats(-1000.0, 1000.0, width=32) | st.integers(-50, 50).map(lambda i: 20.0 * i)
extent = st.sampled_from([0.0, 0.5, 20.0, 20.0, 20.0, 33.0, 500.0]) | st.floats(0.0, 100.0, width=32)


@st.composite
def rectangles(draw: st.DrawFn) -> Rectangle:
    x, y, width, height = draw(coordinate), draw(coordinate), draw(extent), draw(extent)
    return x, y, x + width, y + height


@st.composite
def areas(draw: st.DrawFn) -> Area:
    x, y, reach = draw(coordinate), draw(coordinate), draw(extent)
    shape = draw(st.sampled_from(["circle", "square", "box"]))
    if shape == "circle":
        return Circle(x, y, reach)
    if shape == "square":
        return AutowareSquare(x, y, reach)
    return Box(x, y, x + reach, y + draw(extent))


@given(st.lists(rectangles(), min_size=1, max_size=40), st.lists(areas(), min_size=1, max_size=5))
@settings(max_examples=300, deadline=None)
def test_any_rectangles_equal_brute_force(cells: list[Rectangle], asked: list[Area]) -> None:
    boxes = np.array(cells)
    # every cell three times: buckets then hold several
    index = SpatialIndex(np.vstack((boxes, boxes, boxes)))
    for area in asked:
        once = brute_force(area, boxes)
        n = len(boxes)
        assert index.query(area).tolist() == [i + k * n for k in range(3) for i in once]


def test_one_huge_cell_among_many_small_ones() -> None:
    boxes = np.vstack((lattice(0.0, 40, 20.0), [[-1e5, -1e5, 1e5, 1e5]], [[400.0, 0.0, 400.5, 800.0]]))
    index = SpatialIndex(boxes)
    for area in (Circle(401.0, 401.0, 30.0), Circle(-5e4, 0.0, 1.0), Circle(2e5, 0.0, 5.0), Box(0, 0, 9, 9)):
        assert index.query(area).tolist() == brute_force(area, boxes)


@pytest.mark.parametrize("linear", [0, 1 << 30])
def test_areas_beyond_all_sense_warn_of_nothing(linear: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.origin.spatial_index._LINEAR_CELLS", linear)
    index = SpatialIndex(lattice(0.0, 10, 20.0))
    area: Area
    for area in (Circle(1e300, 0.0, 5.0), Box(1e30, 1e30, 1e30, 1e30)):
        assert len(index.query(area)) == 0
    everything: tuple[Area, ...] = (
        Circle(0.0, 0.0, 1e9),
        Circle(0.0, 0.0, 1e200),
        Circle(0.0, 1.7e308, 1.7e308),
        AutowareSquare(3e38, 0.0, 3e38),
        Box(-1e9, -1e9, 1e9, 1e9),
        Box(-1e308, -1e308, 1e308, 1e308),
    )
    for area in everything:
        assert len(index.query(area)) == 100


def test_cells_scattered_further_than_keys_can_count() -> None:
    boxes = np.array([[x, y, x + 1e-3, y + 1e-3] for x in (-1e12, 0.0, 1e12) for y in (-1e12, 0.0, 1e12)])
    index = SpatialIndex(boxes)
    for i, (x, y, _, _) in enumerate(boxes.tolist()):
        assert index.query(Circle(x, y, 0.5)).tolist() == [i]


def test_corners_further_apart_than_any_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two such cells cost the others their grid, and no query its answer."""
    monkeypatch.setattr("shmmap.origin.spatial_index._LINEAR_CELLS", 4)
    boxes = np.array([[20.0 * i, 0.0, 20.0 * i + 20.0, 20.0] for i in range(6)])
    boxes = np.concatenate([boxes, [[1.1e308, 0.0, 1.2e308, 1.0], [-1.2e308, 0.0, -1.1e308, 1.0]]])
    index = SpatialIndex(boxes)
    assert index.query(Circle(0.0, 0.0, 5.0)).tolist() == [0]
    assert index.query(Circle(1.15e308, 0.0, 5.0)).tolist() == [6]
    assert index.query(Box(-1.7e308, 0.0, 1.7e308, 0.5)).tolist() == list(range(8))
