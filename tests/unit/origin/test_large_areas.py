# SPDX-License-Identifier: Apache-2.0
"""Areas with very many cells in or around them: the same answers, and no more work than the answer needs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.geometry import Area, AutowareSquare, Box, Circle
from shmmap.origin import spatial_index
from shmmap.origin.spatial_index import SpatialIndex

AT_ONCE = 16
SIDE = 60


@pytest.fixture(autouse=True)
def small_parts() -> Iterator[None]:
    """Few cells are very many here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(spatial_index, "_LINEAR_CELLS", 0)
        patch.setattr(spatial_index, "_CELLS_PER_BATCH", AT_ONCE)
        patch.setattr(spatial_index, "_FEW_ROWS", 2)
        yield


@pytest.fixture
def tested(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many cells were tested, each time."""
    counts: list[int] = []
    real = spatial_index.touches

    def counted(area: Area, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        counts.append(len(boxes))
        return real(area, boxes)

    monkeypatch.setattr(spatial_index, "touches", counted)
    return counts


@cache
def town(corner: float = 0.0) -> NDArray[np.float64]:
    """Boxes of a square town of cells of 20 m, shuffled."""
    lower = np.array([(x, y) for x in range(SIDE) for y in range(SIDE)]) * 20.0 + corner
    np.random.default_rng(3).shuffle(lower)
    return np.hstack((lower, lower + 20.0))


@cache
def indexed(corner: float = 0.0) -> SpatialIndex:
    """Index of that town, made in small parts, too; a query does not change it."""
    return SpatialIndex(town(corner))


number = st.floats(-2000.0, 3000.0) | st.integers(-100, 150).map(lambda i: 20.0 * i)
reach = st.floats(0.0, 3000.0) | st.integers(0, 150).map(lambda i: 20.0 * i)
circles = st.builds(Circle, number, number, reach)
squares = st.builds(AutowareSquare, number, number, reach)
boxes = st.builds(lambda x, y, width, height: Box(x, y, x + width, y + height), number, number, reach, reach)


@example(Circle(0.0, -1.1125369292536007e-308, 0.0), 0.0)  # the square of the distance is 0
@given(circles | squares | boxes, st.sampled_from([0.0, -600.0, 89_000.0, 1e7, -1e9]))
@settings(max_examples=150, deadline=None)
def test_the_same_cells_as_one_by_one(area: Area, corner: float) -> None:
    cells = town(corner)
    moved: Area
    if isinstance(area, Box):
        moved = Box(area.min_x + corner, area.min_y + corner, area.max_x + corner, area.max_y + corner)
    else:
        moved = type(area)(area.x + corner, area.y + corner, area.radius)
    assert indexed(corner).query(moved).tolist() == np.flatnonzero(moved.overlaps(cells)).tolist()


@given(circles, st.integers(0, 40))
@settings(max_examples=60, deadline=None)
def test_more_than_enough_are_some_of_them(area: Circle, most: int) -> None:
    cells = town()
    right = set(np.flatnonzero(area.overlaps(cells)).tolist())
    found = indexed().query(area, most).tolist()
    assert len(found) == len(set(found))
    if len(right) > most:
        assert most < len(found) <= most + AT_ONCE
        assert right.issuperset(found)
    else:
        assert found == sorted(right)


@given(st.floats(0.0, 2 * np.pi), st.integers(1, 9).map(lambda power: 10.0**power))
@settings(max_examples=60, deadline=None)
def test_a_circle_that_only_just_reaches_a_corner(direction: float, distance: float) -> None:
    """From far away its border is as good as straight, and float64 has few digits left for the town."""
    cells = town()
    x, y = distance * np.cos(direction), distance * np.sin(direction)
    nearest = float(np.sqrt(np.min(_nearest(cells, x, y))))
    for radius in (nearest * (1 - 1e-12), nearest, nearest * (1 + 1e-12), nearest + 30.0):
        area = Circle(x, y, radius)
        assert indexed().query(area).tolist() == np.flatnonzero(area.overlaps(cells)).tolist()


def _nearest(cells: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """Squared distances of boxes from a point."""
    dx = np.maximum(np.maximum(cells[:, 0] - x, x - cells[:, 2]), 0.0)
    dy = np.maximum(np.maximum(cells[:, 1] - y, y - cells[:, 3]), 0.0)
    squared: NDArray[np.float64] = dx * dx + dy * dy
    return squared


@pytest.mark.parametrize("centre", [(-3600.0, -3600.0), (4800.0, 4800.0), (-3600.0, 4800.0)])
def test_cells_beside_a_circle_are_not_looked_at(centre: tuple[float, float], tested: list[int]) -> None:
    """The box around it has the whole town, the circle a corner of it."""
    cells = town()
    area = Circle(*centre, 3600.0 * np.sqrt(2) + 5.0)
    found = indexed().query(area, 10_000)
    assert 0 < len(found) < 10
    min_x, min_y, max_x, max_y = area.bounds
    around = Box(min_x, min_y, max_x, max_y).overlaps(cells)
    assert around.sum() > SIDE * SIDE / 2
    assert sum(tested) < 5 * SIDE


def test_a_query_with_a_limit_ends_soon_after_it(tested: list[int]) -> None:
    index = indexed()
    for area in (Circle(600.0, 600.0, 1e4), Box(0.0, 0.0, 1200.0, 1200.0), AutowareSquare(0.0, 0.0, 1e6)):
        tested.clear()
        assert len(index.query(area, 40)) > 40
        assert max(tested) <= AT_ONCE
        assert sum(tested) <= 40 + 2 * AT_ONCE
