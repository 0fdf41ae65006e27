# SPDX-License-Identifier: Apache-2.0
"""Corners are exact decimal numbers, and every number is in exactly one half-open cell."""

from __future__ import annotations

import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shmmap.dividing.kernels import NOWHERE, assign_cells
from shmmap.dividing.lattice import CellLattice
from shmmap.errors import BadRequest

SIZES = st.sampled_from([20.0, 1.0, 12.5, 0.1, 0.3, 2.2, 33.33, 1e-3, 500.0, 7.0])
ORIGINS = st.sampled_from([0.0, 0.1, -3.7, 1000.0, 589500.25, 1e-6])


def assign(values: list[float], lattice: CellLattice, dtype: str = "<f8") -> list[int]:
    """Indices along x of points (value, value, 0)."""
    x = np.array(values, dtype)
    ix, iy = np.empty(len(x), np.int32), np.empty(len(x), np.int32)
    kept, *_ = assign_cells(x, x, np.zeros(len(x)), lattice.numbers, ix, iy, np.zeros((2, 3)))
    assert kept == len(x)
    found: list[int] = ix.tolist()
    return found


@given(SIZES, ORIGINS, st.lists(st.integers(-(10**6), 10**6), min_size=1, max_size=20), st.data())
@settings(max_examples=150, deadline=None)
def test_every_number_is_in_exactly_one_cell(
    size: float, origin: float, indices: list[int], data: st.DataObject
) -> None:
    lattice = CellLattice.of(size, (origin, origin))
    values: list[float] = []
    for index in indices:
        corner = lattice.corner(index, 0)[0]
        values += [corner, math.nextafter(corner, -math.inf), math.nextafter(corner, math.inf)]
    values += data.draw(st.lists(st.floats(-1e5, 1e5), max_size=5))
    for value, index in zip(values, assign(values, lattice), strict=True):
        assert lattice.corner(index, 0)[0] <= value < lattice.corner(index + 1, 0)[0]


@given(SIZES, ORIGINS, st.integers(-(10**6), 10**6))
def test_a_corner_is_what_its_text_says(size: float, origin: float, index: int) -> None:
    lattice = CellLattice.of(size, (origin, -origin))
    exact = Fraction(Decimal(repr(origin))) + index * Fraction(Decimal(repr(size)))
    text = lattice.corner_text(index, index)[0]
    assert Fraction(Decimal(text)) == exact
    assert float(text) == lattice.corner(index, index)[0] == float(exact)
    assert ("." not in text) == (exact.denominator == 1)
    assert "e" not in text.lower()


@given(SIZES, st.integers(-(10**5), 10**5), st.floats(-1e6, 1e6, width=32))
@example(0.1, 3, 0.3)
@settings(deadline=None)
def test_float32_points_too(size: float, index: int, value: float) -> None:
    lattice = CellLattice.of(size)
    corner = float(np.float32(lattice.corner(index, 0)[0]))
    values = [value / (1.0 if size > 0.5 else 1e3), corner]
    for one, found in zip(values, assign(values, lattice, "<f4"), strict=True):
        exact = float(np.float32(one))
        assert lattice.corner(found, 0)[0] <= exact < lattice.corner(found + 1, 0)[0]


def test_tenths_are_where_the_metadata_says() -> None:
    lattice = CellLattice.of(0.1)
    assert lattice.corner(3, -3) == (0.3, -0.3)
    assert lattice.corner_text(3, -30) == ("0.3", "-3")
    assert assign([0.3, math.nextafter(0.3, 0)], lattice) == [3, 2]
    assert lattice.size_text == "0.1"


@pytest.mark.parametrize(
    ("size", "origin", "whole"),
    [
        (20.0, (0.0, 0.0), True),
        (12.5, (0.0, 0.0), False),
        (20.0, (5.0, 0.0), True),
        (20.0, (0.0, 0.5), False),
    ],
)
def test_whole_corners(size: float, origin: tuple[float, float], whole: bool) -> None:
    assert CellLattice.of(size, origin).whole is whole


@given(SIZES, st.sampled_from([0.0, 20.0, -589500.0, 12.5, 0.001]), st.integers(-1000, 1000))
def test_a_moved_lattice_has_the_same_squares(size: float, move: float, index: int) -> None:
    lattice = CellLattice.of(size, (0.5, 1.0))
    moved = lattice.moved(move, -move)
    for corner, there, shift in zip(
        lattice.corner_text(index, index), moved.corner_text(index, index), (move, -move), strict=True
    ):
        assert Decimal(there) == Decimal(corner) - Decimal(repr(shift))


def test_the_common_step_is_whole_metres_and_whole_cells() -> None:
    assert [CellLattice.of(size).common_step() for size in (20.0, 12.5, 0.3, 33.33, 12.345678)] == [
        20, 25, 3, 3333, Fraction("12.345678"),
    ]  # fmt: skip


@pytest.mark.parametrize("size", [0.0, -1.0, math.nan, math.inf, 1 / 3, 1e-7, 1e17])
def test_impossible_sizes_are_refused(size: float) -> None:
    with pytest.raises(BadRequest):
        CellLattice.of(size)


def test_points_that_are_not_finite_are_nowhere() -> None:
    x = np.array([1.0, np.nan, 1.0, 1.0, -1.0])
    y = np.array([1.0, 1.0, np.inf, 1.0, -1.0])
    z = np.array([1.0, 1.0, 1.0, -np.inf, -1.0])
    ix, iy = np.empty(5, np.int32), np.empty(5, np.int32)
    extremes = np.array([[np.inf] * 3, [-np.inf] * 3])
    found = assign_cells(x, y, z, (20.0, 0.0, 0.0, 20, 0, 0, 1), ix, iy, extremes)
    assert found == (2, -1, 0, -1, 0)
    assert ix.tolist() == iy.tolist() == [0, NOWHERE, NOWHERE, NOWHERE, -1]
    assert extremes.tolist() == [[-1.0] * 3, [1.0] * 3]


def test_points_too_far_away_are_reported() -> None:
    x = np.array([1.0, 1e12])
    ix, iy = np.empty(2, np.int32), np.empty(2, np.int32)
    assert assign_cells(x, x, x, (1.0, 0.0, 0.0, 1, 0, 0, 1), ix, iy, np.zeros((2, 3)))[0] == -1


def test_corners_that_are_not_exact_are_out_of_reach() -> None:
    lattice = CellLattice.of(20.0, (1e-6, 0.0))
    ix, iy = np.empty(1, np.int32), np.empty(1, np.int32)
    for x, found in ((4.5e9, 1), (4.6e9, -1), (-4.6e9, -1)):
        there = np.array([x])
        assert (
            assign_cells(there, there * 0, there * 0, lattice.numbers, ix, iy, np.zeros((2, 3)))[0] == found
        )
