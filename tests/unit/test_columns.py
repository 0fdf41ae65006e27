# SPDX-License-Identifier: Apache-2.0
"""Bounds and finite masks against plain numpy, around the sizes where blocks are folded."""

from __future__ import annotations

import numpy as np
import pytest

from shmmap.columns import Bounds, row_extremes

SIZES = [1, 2, 511, 512, 513, 1023, 1024, 1025, 5000]


@pytest.mark.parametrize("dtype", ["f4", "f8"])
@pytest.mark.parametrize("size", SIZES)
def test_extremes_of_every_row_position(size: int, dtype: str) -> None:
    plain = np.random.default_rng(size).normal(size=(size, 3)).astype(dtype)
    for row in {0, 1, 255, 510, 511, 512, 1022, 1023, 1024, size - 1}:
        if row < size:
            for axis in range(3):
                rows = plain.copy()
                rows[row, axis] = 100
                assert row_extremes(rows) == (rows.min(axis=0).tolist(), rows.max(axis=0).tolist())
                rows[row, axis] = np.nan
                low, high = row_extremes(rows)
                assert np.isnan(low[axis])
                assert np.isnan(high[axis])
                assert low[axis - 1] == plain[:, axis - 1].min()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("size", SIZES)
def test_masks(size: int, bad: float) -> None:
    rows = np.random.default_rng(size).normal(size=(size, 3)).astype("f4")
    bounds = Bounds()
    assert bounds.add(rows) is None
    assert bounds.add(rows[:0]) is None
    before = [values.tolist() for values in bounds.result()]
    rows[size // 2, size % 3] = bad
    mask = bounds.add(rows)
    assert mask is not None
    assert np.flatnonzero(~mask).tolist() == [size // 2]
    assert [values.tolist() for values in bounds.result()] == before


def test_no_finite_point() -> None:
    bounds = Bounds()
    assert np.isnan(bounds.result()).all()
    mask = bounds.add(np.full((3, 3), np.nan))
    assert mask is not None
    assert not mask.any()
    assert np.isnan(bounds.result()).all()


def test_bounds_of_float32_are_exact_in_float64() -> None:
    bounds = Bounds()
    bounds.add(np.array([[0.1, -0.1, 89000.1]], "f4"))
    assert bounds.result()[0].dtype == np.float64
    assert bounds.result()[0].tolist() == np.array([0.1, -0.1, 89000.1], "f4").astype("f8").tolist()


@pytest.mark.parametrize("bad", [None, np.nan, np.inf])
def test_contiguous_axes_give_the_same(bad: float | None) -> None:
    rows = np.random.default_rng(1).normal(size=(3000, 3)).astype("f4")
    if bad is not None:
        rows[77, 1] = bad
    axes = tuple(np.ascontiguousarray(rows[:, axis]) for axis in range(3))
    one, two = Bounds(), Bounds()
    masks = one.add(rows), two.add(rows, axes)
    assert (masks[0] is None) == (masks[1] is None) == (bad is None)
    assert np.array_equal(one.result(), two.result())
