# SPDX-License-Identifier: Apache-2.0
"""Which cells a browser sees in which detail, within which number of points, and what a move changes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.layers.spec import canonical_layer
from shmmap.viewing.browser.cell_points import POINT_BYTES
from shmmap.viewing.browser.detail import (
    LEAVES,
    MAX_CELLS,
    NOT_SHOWN,
    Choice,
    Eye,
    Sizes,
    changes,
    choose,
    layer_of,
    pixel_angle,
)

CELL = 20.0
SIDE = 60
MOST = 2e6


class Town:
    """A square of 1 200 m of cells of 20 m, with 30 000 points each."""

    def __init__(self) -> None:
        x, y = (part.ravel() * CELL for part in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
        self.boxes: NDArray[np.float64] = np.stack([x, y, x + CELL, y + CELL], axis=1).astype(np.float64)
        self.z = np.tile([0.0, 15.0], (len(x), 1))
        self.versions = np.arange(1, len(x) + 1, dtype=np.uint64)
        self.sizes = Sizes(self.boxes, np.full(len(x), 30_000 * 16.0))

    def points(self, cell: int, level: int) -> int:
        """Points that a cell really has: some cells are denser than others."""
        return min(30_000, int((0.5 + cell % 7 / 2) * CELL**2 / LEAVES[level] ** 2))

    def look(self, eye: Eye, before: Choice | None = None) -> Choice:
        return choose(eye, self.boxes, self.z, self.sizes, MOST, before)

    def fetch(self, choice: Choice) -> dict[int, tuple[int, int]]:
        """Show all of a choice; its sizes are known from now on."""
        shown = {}
        for cell in choice.order.tolist():
            level = int(choice.levels[cell])
            self.sizes.note(cell, level, self.points(cell, level))
            shown[cell] = level, int(self.versions[cell])
        return shown

    def total(self, shown: dict[int, tuple[int, int]]) -> int:
        return sum(self.points(cell, level) for cell, (level, _) in shown.items())


def test_levels_are_layers_as_the_daemon_names_them() -> None:
    for level in range(len(LEAVES)):
        assert canonical_layer(layer_of(level)) == layer_of(level)


def test_what_is_near_is_finer() -> None:
    town = Town()
    choice = town.look(Eye(610.0, 610.0, 20.0))
    levels = choice.levels[choice.order]
    assert levels[0] == 0
    assert (np.diff(levels) >= 0).all(), "the nearest first"
    assert len(set(levels.tolist())) > 2
    for cell in choice.order.tolist():
        distance = math.hypot(*(max(low - 610.0, 610.0 - low - CELL, 0.0) for low in town.boxes[cell, :2]))
        leaf = LEAVES[choice.levels[cell]]
        assert leaf <= max(LEAVES[0], choice.coarseness * 2 * 1.6e-3 * math.hypot(distance, 5.0)) * 1.001


def test_from_high_above_everything_is_coarse() -> None:
    town = Town()
    choice = town.look(Eye(600.0, 600.0, 1500.0))
    assert len(choice.order) == min(len(town.boxes), MAX_CELLS)
    assert set(choice.levels[choice.order].tolist()) <= {4, 5}


@pytest.mark.parametrize(
    "where", [(x, y, z) for x in (30.0, 610.0, 1900.0) for y in (5.0, 700.0) for z in (5.0, 60.0)]
)
def test_points_stay_within_their_number_once_sizes_are_known(where: tuple[float, float, float]) -> None:
    town = Town()
    choice: Choice | None = None
    for _ in range(8):
        choice = town.look(Eye(*where), choice)
        shown = town.fetch(choice)
    assert town.total(shown) <= MOST
    assert town.total(shown) * POINT_BYTES < 30e6


def test_a_first_look_does_not_need_much_more_than_it_may() -> None:
    for cell in range(0, SIDE * SIDE, 397):
        town = Town()
        x, y = town.boxes[cell, :2].tolist()
        assert town.total(town.fetch(town.look(Eye(x, y, 15.0)))) * POINT_BYTES < 30e6


def test_the_same_look_changes_nothing() -> None:
    town = Town()
    eye = Eye(300.0, 300.0, 10.0)
    choice = town.look(eye)
    for _ in range(6):
        shown = town.fetch(choice)
        choice = town.look(eye, choice)
    assert changes(shown, choice, town.versions) == changes(shown, town.look(eye, choice), town.versions)
    assert not changes(town.fetch(choice), town.look(eye, choice), town.versions).wanted


def test_a_move_changes_little_and_a_step_back_less() -> None:
    town = Town()
    choice = town.look(Eye(300.0, 300.0, 10.0))
    for _ in range(6):
        shown = town.fetch(choice)
        choice = town.look(Eye(300.0, 300.0, 10.0), choice)
    moved = town.look(Eye(310.0, 300.0, 10.0), choice)
    differ = changes(shown, moved, town.versions)
    sent = sum(town.points(cell, level) for cell, level in differ.wanted)
    assert 0 < sent < 0.25 * town.total(shown)
    assert all(shown.get(cell, (NOT_SHOWN,))[0] != level for cell, level in differ.wanted)
    now = {**shown, **{cell: (level, int(town.versions[cell])) for cell, level in differ.wanted}}
    for cell in differ.gone:
        del now[cell]
    still = changes(now, moved, town.versions)
    assert (still.gone, still.wanted) == ([], [])
    back = changes(now, town.look(Eye(309.0, 300.0, 10.0), moved), town.versions)
    assert len(back.wanted) <= len(differ.wanted) / 2


def test_a_changed_cell_is_wanted_again() -> None:
    town = Town()
    choice = town.look(Eye(300.0, 300.0, 10.0))
    shown = town.fetch(choice)
    cell = int(choice.order[3])
    town.versions[cell] += 1
    assert changes(shown, choice, town.versions).wanted == [(cell, int(choice.levels[cell]))]


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-500, 2000),
    st.floats(-500, 2000),
    st.floats(-50, 3000),
    st.floats(1e-4, 1e-2),
    st.floats(1e4, 1e7),
)
def test_any_eye(x: float, y: float, z: float, pixel: float, most: float) -> None:
    town = Town()
    choice = choose(Eye(x, y, z, pixel), town.boxes, town.z, town.sizes, most)
    assert 1 <= len(choice.order) <= MAX_CELLS
    assert set(np.flatnonzero(choice.levels != NOT_SHOWN).tolist()) == set(choice.order.tolist())
    estimated = town.sizes.points(choice.order, choice.levels[choice.order].astype(np.intp))
    assert len(choice.order) == 1 or estimated.sum() <= most


def test_unknown_heights_and_a_map_of_one_cell() -> None:
    boxes = np.array([[0.0, 0.0, 500.0, 400.0]])
    sizes = Sizes(boxes, np.array([3e8]))
    choice = choose(Eye(250.0, 200.0, 100.0), boxes, np.full((1, 2), math.nan), sizes, MOST)
    assert choice.order.tolist() == [0]
    assert sizes.points(choice.order, choice.levels[choice.order].astype(np.intp))[0] <= MOST


def test_the_angle_of_a_pixel() -> None:
    assert pixel_angle(math.radians(75), 800) == pytest.approx(2 * math.tan(math.radians(37.5)) / 800)
    assert pixel_angle(0.0, 0) > 0, "a browser that has not said yet how large it is"
