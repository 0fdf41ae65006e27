# SPDX-License-Identifier: Apache-2.0
"""Points around a place, against a search through all points."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from shmmap.client.cell import Cell
from shmmap.client.points_around import PointsAround, points_around
from shmmap.errors import BadRequest, NoColumn, ShmmapError

if TYPE_CHECKING:
    from tests.unit.client.conftest import Segments

FAR = 90_000.0  # where float32 steps by 8 mm


@pytest.fixture
def grid(make_cell: Callable[..., Cell]) -> list[Cell]:
    return [
        make_cell(f"/{i}_{j}", (FAR + 20.0 * i, 20.0 * j, FAR + 20.0 * i + 20, 20.0 * j + 20))
        for i in range(6)
        for j in range(6)
    ]


def around(cells: list[Cell], x: float, y: float, radius: float) -> PointsAround:
    return points_around(cells, np.array([cell.box for cell in cells]), x, y, radius, covered=True)


@pytest.mark.parametrize(
    ("x", "y", "radius"),
    [
        (FAR + 61.3, 58.7, 45.0),
        (FAR + 3.0, 4.0, 33.3),
        (FAR + 60, 60, 0.0),
        (FAR + 60, 60, 500.0),
        (0.0, 0.0, 50.0),
    ],
)
def test_gather_copies_exactly_the_points_within_the_radius(
    grid: list[Cell], x: float, y: float, radius: float
) -> None:
    found = around(grid, x, y, radius)
    points = np.concatenate([cell.xyz for cell in grid]).astype(np.float64)
    values = np.concatenate([cell["intensity"] for cell in grid])
    inside = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2 <= radius**2
    np.testing.assert_array_equal(found.gather().astype(np.float64), points[inside])
    np.testing.assert_array_equal(found.gather("intensity"), values[inside])
    assert found.count() == inside.sum()
    assert found.gather().dtype == np.float32
    if len(found):
        assert not any(np.shares_memory(found.gather(), cell.xyz) for cell in grid)


def test_views_are_the_cells_own_memory(grid: list[Cell]) -> None:
    found = around(grid, FAR + 50, 50, 30.0)
    assert len(found) == len(found.cells) == len(found.whole) > 4
    for view, column, cell in zip(found, found.views("intensity"), found.cells, strict=True):
        assert view is cell.xyz
        assert column is cell["intensity"]


def test_cells_are_those_whose_box_the_circle_touches_border_included(grid: list[Cell]) -> None:
    found = around(grid, FAR + 30, 30, 10.0)
    assert {cell.id for cell in found.cells} == {"/1_1", "/0_1", "/2_1", "/1_0", "/1_2"}
    assert not any(found.whole)
    wide = around(grid, FAR + 30, 30, 14.2)
    assert [cell.id for cell, whole in zip(wide.cells, wide.whole, strict=True) if whole] == ["/1_1"]
    index = [cell.id for cell in wide.cells].index("/1_1")
    assert wide.mask(index).all()
    assert len(wide.mask(index)) == wide.cells[index].points


def test_layers_with_an_origin_of_their_own(segments: Segments) -> None:
    xyz = np.array([[0, 0, 0], [5, 0, 0], [9, 9, 0]], np.float32)
    cell = segments.cell("/a", {"xyz": xyz}, box=(1000.0, 0.0, 1010.0, 10.0), origin=(1000.0, 0.0, 0.0))
    found = around([cell], 1000.0, 0.0, 6.0)
    np.testing.assert_array_equal(found.gather(), xyz[:2])
    other = segments.cell(
        "/b", {"xyz": xyz}, version=2, box=(990.0, 0.0, 1000.0, 10.0), origin=(990.0, 0.0, 0.0)
    )
    with pytest.raises(BadRequest, match="different origins"):
        around([cell, other], 1000.0, 0.0, 6.0).gather()


def test_nothing_around(grid: list[Cell]) -> None:
    found = around(grid, -1e6, 0.0, 10.0)
    assert (len(found), found.count(), list(found)) == (0, 0, [])
    assert found.gather().shape == (0, 3)
    assert found.gather("intensity").shape == (0,)


@pytest.mark.parametrize(("x", "radius"), [(np.nan, 1.0), (0.0, -1.0), (0.0, np.inf)])
def test_impossible_circles_are_refused(grid: list[Cell], x: float, radius: float) -> None:
    with pytest.raises(BadRequest):
        around(grid, x, 0.0, radius)


def test_several_columns_at_once_have_their_rows_together(grid: list[Cell]) -> None:
    found = around(grid, FAR + 61.3, 58.7, 45.0)
    columns = found.gather("intensity", "xyz")
    assert list(columns) == ["intensity", "xyz"]
    np.testing.assert_array_equal(columns["xyz"], found.gather())
    np.testing.assert_array_equal(columns["intensity"], found.gather("intensity"))
    nothing = around(grid, -1e6, 0.0, 10.0).gather("xyz", "intensity")
    assert [nothing[name].shape for name in ("xyz", "intensity")] == [(0, 3), (0,)]


def test_a_column_that_is_not_there_is_said_with_those_that_are(grid: list[Cell]) -> None:
    found = around(grid, FAR + 50, 50, 30.0)
    for asked in (["colour"], ["xyz", "colour"]):
        with pytest.raises(NoColumn, match=r"layer points has no column 'colour' \(it has xyz, intensity\)"):
            found.gather(*asked)
    with pytest.raises(KeyError, match="no column 'colour'"):
        found.views("colour")


@pytest.mark.parametrize("radius", [8.0, 100.0], ids=["partly inside", "wholly inside"])
def test_rows_that_are_no_points_lie_nowhere(segments: Segments, radius: float) -> None:
    """Whether a cell lies wholly in the circle must not decide whether the question makes sense."""
    heights = {"height": np.zeros((10, 10), np.float32)}
    cell = segments.cell("/a", heights, layer="elevation(leaf=2.0)", box=(0.0, 0.0, 20.0, 20.0))
    found = around([cell], 10.0, 10.0, radius)
    for question in (found.count, found.gather, lambda: found.gather("height"), lambda: found.mask(0)):
        with pytest.raises(ShmmapError, match=r"layer elevation\(leaf=2.0\) has no column 'xyz'") as refusal:
            question()
        assert isinstance(refusal.value, KeyError)
        assert "views(column) with height" in refusal.value.hint
        assert "layer='points'" in refusal.value.hint
    (view,) = found.views("height")
    assert view is cell["height"]
