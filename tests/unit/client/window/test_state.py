# SPDX-License-Identifier: Apache-2.0
"""States of a window, and what changed between two of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from shmmap.client.cell import Cell
from shmmap.client.cell_set import PendingLayer
from shmmap.client.window.state import EMPTY, WindowState, WindowUpdate, moved, update_between
from shmmap.errors import CellError, LoadFailed, OverBudget
from shmmap.geometry import Area, AutowareSquare, Box, Circle
from shmmap.protocol.messages import Intent

HERE = Intent(0.0, 0.0)
AREA = Circle(0.0, 0.0, 100.0)


def build(
    *cells: Cell, pending: tuple[PendingLayer, ...] = (), failed: tuple[CellError, ...] = ()
) -> WindowState:
    state = WindowState(pending=pending, failed=failed, asked=HERE, area=AREA, epoch=1, map_version=1)
    return state.with_cells({(cell.id, cell.layer): cell for cell in cells})


def test_cells_are_in_id_order_with_their_boxes(make_cell: Callable[..., Cell]) -> None:
    b = make_cell("/b", (20.0, 0.0, 40.0, 20.0))
    a = make_cell("/a", (0.0, 0.0, 20.0, 20.0))
    voxel = make_cell("/a", (0.0, 0.0, 20.0, 20.0), version=3, layer="voxel")
    state = build(b, voxel, a)
    assert list(state.cells) == [("/a", "points"), ("/a", "voxel"), ("/b", "points")]
    assert state.by_layer == {"points": (a, b), "voxel": (voxel,)}
    np.testing.assert_array_equal(state.boxes["points"], [a.box, b.box])


def test_the_difference_of_two_states(make_cell: Callable[..., Cell]) -> None:
    box = (0.0, 0.0, 20.0, 20.0)
    gone, stays, old = (make_cell(name, box) for name in ("/gone", "/stays", "/changes"))
    new, fresh = make_cell("/changes", box, version=99), make_cell("/new", box)
    pending = (PendingLayer("/later", "points"),)
    before = build(gone, stays, old)
    update = update_between(before.versions, build(stays, new, fresh, pending=pending), current=True)
    assert (update.added, update.kept, update.changed) == ((fresh,), (stays,), (new,))
    assert (update.removed, update.pending) == (("/gone",), pending)
    assert update.any
    assert not update.complete
    same = update_between(before.versions, before, current=True)
    assert not same.any
    assert same.complete
    assert not update_between(before.versions, before, current=False).complete, "of another pose"
    assert set(same.kept) == {gone, stays, old}
    assert set(update_between(EMPTY.versions, before, current=True).added) == {gone, stays, old}


def test_remembering_versions_keeps_nothing_mapped(make_cell: Callable[..., Cell]) -> None:
    import weakref

    cell = make_cell("/a", (0.0, 0.0, 20.0, 20.0))
    alive = weakref.ref(cell)
    versions = build(cell).versions
    del cell
    assert alive() is None
    assert list(versions) == [("/a", "points")]


@pytest.mark.parametrize(
    ("failed", "settled"),
    [((), True), ((LoadFailed("broken"),), True), ((LoadFailed("broken"), OverBudget("full")), False)],
)
def test_settled(failed: tuple[CellError, ...], settled: bool) -> None:
    assert build(failed=failed).settled is settled
    assert not build(pending=(PendingLayer("/a", "points"),)).settled
    assert not EMPTY.settled


def test_moved_by_the_update_distance() -> None:
    state = build()
    assert moved(EMPTY, HERE, 1e9)
    assert not moved(state, Intent(0.0, 0.0), 0.0)
    assert moved(state, Intent(1e-9, 0.0), 0.0)
    assert not moved(state, Intent(11.9, 15.9), 20.0)
    assert moved(state, Intent(12.0, 16.0), 20.0)


def test_moved_out_of_what_was_answered() -> None:
    """However far a pose may move before the daemon is asked again, the window must have answered it."""
    state = build()
    assert not moved(state, Intent(99.0, 0.0), 1e9)
    assert moved(state, Intent(101.0, 0.0), 1e9)


def test_a_state_covers_what_lies_in_the_area_that_was_answered(make_cell: Callable[..., Cell]) -> None:
    state = build(make_cell("/a", (0.0, 0.0, 20.0, 20.0)))
    assert state.covers(0.0, 0.0, 100.0)
    assert state.covers(70.0, 0.0, 30.0)
    assert not state.covers(70.1, 0.0, 30.0)
    assert not state.covers(1e6, 0.0, 0.0)
    assert not EMPTY.covers(0.0, 0.0, 0.0)


def test_a_missing_cell_may_lie_anywhere(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell("/a", (0.0, 0.0, 20.0, 20.0))
    for name, covers in (("/b", False), ("/a", True)):  # of /a an older version is here
        assert build(cell, pending=(PendingLayer(name, "points"),)).covers(0.0, 0.0, 9.0) is covers
        failure = LoadFailed("broken", cell_id=name, layer="points")
        state = build(cell, failed=(failure,))
        assert state.covers(0.0, 0.0, 9.0) is covers
        assert state.covers(0.0, 0.0, 9.0, "voxel(leaf=1.0)"), "another layer misses nothing"
        assert state.covers(0.0, 0.0, 9.0, "points") is covers


def test_a_failed_cell_is_missing_where_it_lies() -> None:
    failure = LoadFailed("broken", cell_id="/b", layer="points", box=(20.0, 0.0, 40.0, 20.0))
    state = build(failed=(failure,))
    assert state.covers(0.0, 0.0, 19.0)
    assert not state.covers(0.0, 0.0, 20.0)
    assert not state.covers(30.0, 10.0, 0.0)


@pytest.mark.parametrize(
    ("area", "inside", "outside"),
    [
        (Circle(10.0, 0.0, 5.0), (12.0, 0.0, 3.0), (12.0, 3.0, 3.0)),
        (AutowareSquare(10.0, 0.0, 5.0), (12.0, 2.0, 2.9), (12.0, 0.0, 3.1)),
        (Box(0.0, 0.0, 10.0, 20.0), (5.0, 5.0, 5.0), (5.0, 4.9, 5.0)),
    ],
)
def test_areas_that_contain_a_circle(
    area: Area, inside: tuple[float, float, float], outside: tuple[float, float, float]
) -> None:
    assert area.contains_circle(*inside)
    assert not area.contains_circle(*outside)


def test_an_update_prints_as_one_line() -> None:
    update = WindowUpdate(removed=("/map/a.pcd", "/map/b.pcd"))
    assert repr(update) == (
        "<WindowUpdate: 0 added, 0 kept, 0 changed, 2 removed, 0 pending, 0 failed, of an earlier pose>"
    )
