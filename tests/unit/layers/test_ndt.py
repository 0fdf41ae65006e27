# SPDX-License-Identifier: Apache-2.0
"""The ndt layer: equal to what the C++ programs compute, and to brute force everywhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError
from shmmap.layers.build import build_layer
from shmmap.layers.contract import LayerTable
from shmmap.layers.voxels import CONVENTIONS, Convention, voxel_covariances
from shmmap.testing.layer_conformance import CORNERS, corner, surface
from tests.support.layer_oracles import covariance_of, voxels_of

MOVED = np.array([89570.0, 42300.0, 0.0])


def unpacked(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """(V, 3, 3) symmetric matrices from (V, 6) xx, xy, xz, yy, yz, zz."""
    return packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def rows_of(layer: LayerTable) -> NDArray[np.int64]:
    """Lattice index (V, 3) of each row, read from the lookup table alone."""
    table: NDArray[Any] = layer["table"]
    lattice = layer.lattice
    assert lattice is not None
    assert table.shape == lattice.shape[::-1]
    k, j, i = np.nonzero(table >= 0)
    rows = np.empty((layer.rows, 3), np.int64)
    rows[table[k, j, i]] = np.column_stack([i, j, k]) + lattice.first
    return rows


def relative(found: NDArray[Any], true: NDArray[Any]) -> float:
    """Largest difference of matrices relative to the largest entry of each."""
    return float((np.abs(found - true).max((1, 2)) / np.abs(true).max((1, 2))).max())


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("leaf", [1.0, 2.0])
def test_equals_the_originals(data_dir: Path, leaf: float, convention: Convention, moved: bool) -> None:
    xyz = np.load(data_dir / "ndt/target_ds0.1_points.npz")["xyz"]
    true = np.load(data_dir / f"ndt/target_ds0.1_leaf{leaf}_{convention}.npz")
    kept = true["count"] >= 6
    order = np.lexsort(true["ijk"][kept].T)
    shift = MOVED if moved else np.zeros(3)
    layer = build_layer(f"ndt(leaf={leaf})", xyz.astype(np.float64) + MOVED if moved else xyz)
    assert np.array_equal(rows_of(layer) - (shift / leaf).astype(int), true["ijk"][kept][order])
    assert np.array_equal(layer["count"], true["count"][kept][order])
    mean: NDArray[Any] = layer["mean"]
    assert np.abs(mean - shift - true["mean"][kept][order]).max() < 1e-9
    covariance, inverse = voxel_covariances(layer["count"], layer["scatter"], convention)
    assert relative(unpacked(covariance), true["cov"][kept][order]) < 1e-9
    assert relative(unpacked(inverse), true["icov"][kept][order]) < 1e-8
    if convention == "autoware":
        assert np.array_equal(inverse, layer["inverse_covariance"])


@pytest.mark.parametrize("least", [2, 6])
@pytest.mark.parametrize("leaf", [0.5, 2.0])
@pytest.mark.parametrize("name", [name for name in CORNERS if name != "far_apart"])
def test_equals_brute_force(name: str, leaf: float, least: int) -> None:
    xyz = corner(name)
    layer = build_layer(f"ndt(leaf={leaf},min_points={least})", xyz)
    voxels = {key: some for key, some in voxels_of(xyz, (leaf,) * 3).items() if len(some) >= least}
    assert layer.rows == len(voxels)
    if not voxels:
        assert layer["table"].size == 0
        assert layer.lattice is not None
        assert layer.lattice.shape == (0, 0, 0)
        return
    indices = rows_of(layer)
    assert sorted(map(tuple, indices.tolist()), key=lambda index: index[::-1]) == list(
        map(tuple, indices.tolist())
    )
    for convention in CONVENTIONS:
        covariances, inverses = voxel_covariances(layer["count"], layer["scatter"], convention)
        for row, index in enumerate(map(tuple, indices.tolist())):
            points = xyz[voxels[index]].astype(np.float64)
            assert layer["count"][row] == len(points)
            about = points[0]
            error = layer["mean"][row] - about - (points - about).mean(axis=0)
            assert (np.abs(error) <= np.spacing(np.abs(about)) + 1e-15).all()
            true = covariance_of(points, convention)
            if true is None:
                assert not covariances[row].any()
                assert not inverses[row].any()
                continue
            for found, expected in zip((covariances, inverses), true, strict=True):
                scale = np.abs(expected).max()
                assert np.abs(unpacked(found)[row] - expected).max() < 1e-8 * scale
    assert np.array_equal(layer["inverse_covariance"], voxel_covariances(layer["count"], layer["scatter"])[1])


def test_points_are_found_by_the_table() -> None:
    xyz = corner("negative", 3000)
    layer = build_layer("ndt(leaf=2.0)", xyz)
    assert layer.lattice is not None
    index = np.floor(xyz * np.float32(0.5)).astype(int) - layer.lattice.first
    inside = ((index >= 0) & (index < layer.lattice.shape)).all(axis=1)
    rows = np.full(len(xyz), -1)
    rows[inside] = layer["table"][tuple(index[inside][:, ::-1].T)]
    found = np.bincount(rows[rows >= 0], minlength=layer.rows)
    assert np.array_equal(found, layer["count"])


def test_voxels_far_apart_are_no_table() -> None:
    cloud = corner("far_apart")
    layer = build_layer("ndt(leaf=2.0)", cloud)  # the stray point has no row, so none is needed
    assert layer.rows == build_layer("ndt(leaf=2.0)", cloud[1:]).rows
    strays = np.concatenate([cloud, np.repeat(cloud[:1], 6, axis=0)])
    with pytest.raises(MapDataError) as caught:
        build_layer("ndt(leaf=2.0)", strays)
    assert caught.value.cause == "coordinate_range"
    with pytest.raises(MapDataError):
        build_layer("ndt(leaf=0.001)", np.full((9, 3), 3e38, np.float32))


def test_the_same_points_in_any_order_give_the_same_layer() -> None:
    rng = np.random.default_rng(5)
    xyz = surface(rng, 5000) + MOVED
    one, other = build_layer("ndt(leaf=1.0)", xyz), build_layer("ndt(leaf=1.0)", rng.permutation(xyz))
    assert np.array_equal(one["count"], other["count"])
    assert np.array_equal(one["table"], other["table"])
    assert np.allclose(one["scatter"], other["scatter"], rtol=1e-9, atol=1e-12)


def test_a_cell_s_ndt_of_its_voxels() -> None:
    xyz = corner("large_f4", 4000)
    below = build_layer("voxel(leaf=0.25)", xyz)
    chained = build_layer("ndt(leaf=2.0,min_points=3,of=voxel(leaf=0.25))", xyz)
    direct = build_layer("ndt(leaf=2.0,min_points=3)", below["xyz"])
    assert np.array_equal(chained["scatter"], direct["scatter"])
    assert chained.rows > 0


def test_unknown_convention() -> None:
    with pytest.raises(BadRequest):
        voxel_covariances(np.array([6]), np.ones((1, 6)), "other")  # type: ignore[arg-type]
