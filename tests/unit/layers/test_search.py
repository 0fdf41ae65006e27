# SPDX-License-Identifier: Apache-2.0
"""The ``search`` layer: every point once, in its column, by height; the table finds each column."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap import BadRequest, MapDataError
from shmmap.layers import LayerTable, build_layer


def rows_of_column(table: LayerTable, column: tuple[int, int]) -> NDArray[Any]:
    """Points of one column, found as the module's documentation says."""
    assert table.lattice is not None
    x, y = column[0] - table.lattice.first[0], column[1] - table.lattice.first[1]
    if not (0 <= x < table.lattice.shape[0] and 0 <= y < table.lattice.shape[1]):
        return np.empty((0, 3))
    tile = int(table["tile"][y // 8, x // 8])
    if tile < 0:
        return np.empty((0, 3))
    n = tile * 64 + (y % 8) * 8 + x % 8
    return table["xyz"][int(table["start"][n]) : int(table["start"][n + 1])]


@pytest.mark.parametrize("origin", [(0, 0, 0), (-33.3, -12.1, 5.0), (89_560.0, 42_340.0, 3.0)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_column_is_found(origin: tuple[float, float, float], dtype: type[np.floating[Any]]) -> None:
    rng = np.random.default_rng(2)
    xyz = (rng.uniform((0, 0, -2), (20, 11, 9), (3000, 3)) + origin).astype(dtype)
    xyz = np.concatenate([xyz, xyz[:100], np.array([[40.0, 3.0, 1.0]], dtype) + np.array(origin, dtype)])
    table = build_layer("search(leaf=0.5)", xyz)
    assert table.rows == len(xyz)
    assert table["xyz"].dtype == dtype
    column = np.floor(xyz[:, :2].astype(np.float64) * 2.0).astype(int)
    found = 0
    for key in np.unique(column, axis=0):
        mine = xyz[(column == key).all(axis=1)]
        got = rows_of_column(table, (int(key[0]), int(key[1])))
        assert np.array_equal(got, mine[np.argsort(mine[:, 2], kind="stable")])
        found += len(got)
    assert found == len(xyz)
    assert len(rows_of_column(table, (int(column[0, 0]), int(column[:, 1].max()) + 9))) == 0


def test_points_that_are_not_finite_are_left_out() -> None:
    xyz = np.array([[1, 1, 1], [np.nan, 0, 0], [2, 2, np.inf]], np.float32)
    assert build_layer("search(leaf=1)", xyz).rows == 1


@pytest.mark.parametrize("xyz", [np.empty((0, 3), np.float32), np.full((2, 3), np.nan)])
def test_nothing_to_sort(xyz: NDArray[Any]) -> None:
    table = build_layer("search(leaf=0.5)", xyz)
    assert table.rows == 0
    assert table["tile"].size == 0
    assert table["start"].tolist() == [0]


def test_one_point() -> None:
    table = build_layer("search(leaf=0.5)", np.array([[-0.1, 7.9, 3.0]]))
    assert len(rows_of_column(table, (-1, 15))) == 1
    assert table["tile"].shape == (1, 1)


def test_of_voxels() -> None:
    rng = np.random.default_rng(4)
    xyz = rng.uniform(0, 10, (5000, 3)).astype(np.float32)
    voxels = build_layer("voxel(leaf=0.5)", xyz)
    table = build_layer("search(leaf=0.5,of=voxel(leaf=0.5))", xyz)
    assert np.array_equal(np.unique(table["xyz"], axis=0), np.unique(voxels["xyz"], axis=0))


def test_too_far_apart_is_refused() -> None:
    with pytest.raises(MapDataError):
        build_layer("search(leaf=0.001)", np.array([[0.0, 0.0, 0.0], [9e4, 9e4, 0.0]]))
    with pytest.raises(MapDataError):
        build_layer("search(leaf=0.5)", np.array([[0.0, 0.0, 0.0], [1e300, 0.0, 0.0]]))
    with pytest.raises(BadRequest):
        build_layer("search", np.zeros((1, 3)))
