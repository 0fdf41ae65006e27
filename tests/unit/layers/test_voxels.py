# SPDX-License-Identifier: Apache-2.0
"""Points sorted into voxels, ``voxel`` and ``ndt``, against brute force and what the C++ programs compute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError
from shmmap.layers import voxels
from shmmap.layers.build import build_layer
from shmmap.layers.contract import LayerTable
from shmmap.layers.voxels import CONVENTIONS, Convention, group_points, voxel_covariances
from shmmap.testing.layer_conformance import CORNERS, corner, surface
from tests.support.layer_oracles import covariance_of, voxels_of

ORIGINS = st.sampled_from([0.0, 89_570.0, -42_300.5, 1e6, -3e5])
MOVED = np.array([89570.0, 42300.0, 0.0])


@st.composite
def clouds(draw: st.DrawFn) -> tuple[NDArray[Any], float]:
    """A few points, many of them on faces of voxels or a hair beside, doubled, or not finite; and a leaf."""
    leaf = draw(st.sampled_from([0.1, 0.3, 0.5, 2.0, 7.77]))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    origin = [draw(ORIGINS) for _ in range(3)]
    steps = st.integers(-30, 30).map(lambda step: step * leaf)
    place = steps | st.floats(-20, 20, width=32) | st.sampled_from([np.nan, np.inf, -np.inf])
    cloud = np.array(draw(st.lists(st.tuples(place, place, place), max_size=30)), np.float64).reshape(-1, 3)
    cloud = (cloud + origin).astype(dtype)
    finite = cloud[np.isfinite(cloud).all(axis=1)]
    hairs = [np.nextafter(finite, dtype(side)) for side in (np.inf, -np.inf)]
    return np.concatenate([cloud, finite[:5], finite[:5], *hairs]), leaf


@given(clouds())
@settings(max_examples=150, deadline=None)
def test_every_point_is_in_its_voxel(given_cloud: tuple[NDArray[Any], float]) -> None:
    cloud, leaf = given_cloud
    members = voxels_of(cloud, (leaf, leaf, leaf))
    order = sorted(members, key=lambda index: index[::-1])  # x fastest
    by_table = group_points(cloud, (leaf, leaf, leaf))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(voxels, "_SMALL_TABLE", -1)  # no table is small enough
        patch.setattr(voxels, "_DENSE_POINTS", -1)
        by_sorting = group_points(cloud, (leaf, leaf, leaf))
    for grouping in (by_table, by_sorting):
        assert [tuple(index) for index in grouping.indices.tolist()] == order
        assert grouping.counts.tolist() == [len(members[index]) for index in order]
        found = {index: np.flatnonzero(grouping.rows == row).tolist() for row, index in enumerate(order)}
        assert found == members


# --- voxel ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spec", "leaf"), [("voxel(0.5)", (0.5, 0.5, 0.5)), ("voxel(leaf_x=1,leaf_y=2,leaf_z=.25)", (1, 2, 0.25))]
)
@pytest.mark.parametrize("name", CORNERS)
def test_voxel_equals_brute_force(name: str, spec: str, leaf: tuple[float, float, float]) -> None:
    xyz = corner(name)
    rng = np.random.default_rng(3)
    columns = {
        "xyz": xyz,
        "intensity": rng.uniform(0, 255, len(xyz)).astype(np.float32),
        "ring": rng.integers(0, 64, len(xyz), np.uint8),
        "stamp_ns": rng.integers(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, len(xyz)),
        "normal": rng.normal(size=(len(xyz), 3)),
    }
    layer = build_layer(spec, columns, units={"intensity": "cd"})
    members = voxels_of(xyz, leaf)
    assert layer.rows == len(members)
    assert {name: str(column.dtype) for name, column in layer.columns.items()} == {
        "xyz": str(xyz.dtype), "intensity": "float32", "ring": "float32", "stamp_ns": "float64",
        "normal": "float64", "count": "uint32",
    }  # fmt: skip
    for row, index in enumerate(sorted(members, key=lambda index: index[::-1])):
        some = members[index]
        assert layer["count"][row] == len(some)
        for column, values in columns.items():
            mean = values[some].astype(np.float64).mean(axis=0)
            found = layer[column][row]
            rounding = np.spacing(np.abs(mean).astype(found.dtype)) + 1e-15 * np.abs(values[some]).max()
            assert (np.abs(found - mean) <= 2 * rounding).all()
    assert layer.lattice is not None
    assert layer.lattice.leaf == leaf


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((4, 2)),
        np.zeros(3),
        np.zeros((2, 3), complex),
        {"x": np.zeros(3)},
        {"xyz": np.zeros((2, 3)), "ring": np.zeros(3)},
        {"xyz": np.zeros((2, 3)), "name": np.array(["a", "b"])},
    ],
)
def test_what_is_no_cloud_is_refused(points: object) -> None:
    with pytest.raises(BadRequest):
        build_layer("voxel(1)", points)  # type: ignore[arg-type]


def test_whole_numbers_become_float64() -> None:
    assert build_layer("voxel(1)", np.array([[1, 2, 3], [1, 2, 4]]))["xyz"].dtype == np.float64


# --- ndt --------------------------------------------------------------------------------------


def unpacked(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """(V, 3, 3) symmetric matrices from (V, 6) xx, xy, xz, yy, yz, zz."""
    return packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def rows_of(layer: LayerTable) -> NDArray[np.int64]:
    """Lattice index (V, 3) of each row, read from the lookup table alone."""
    table: NDArray[Any] = layer["table"]
    assert layer.lattice is not None
    assert table.shape == layer.lattice.shape[::-1]
    k, j, i = np.nonzero(table >= 0)
    rows = np.empty((layer.rows, 3), np.int64)
    rows[table[k, j, i]] = np.column_stack([i, j, k]) + layer.lattice.first
    return rows


def relative(found: NDArray[Any], true: NDArray[Any]) -> float:
    """Largest difference of matrices relative to the largest entry of each."""
    return float((np.abs(found - true).max((1, 2)) / np.abs(true).max((1, 2))).max())


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("leaf", [1.0, 2.0])
def test_ndt_equals_the_originals(data_dir: Path, leaf: float, convention: Convention, moved: bool) -> None:
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


def check_ndt(xyz: NDArray[Any], leaf: float, least: int) -> None:
    """Compare rows, moments and covariances of all conventions with brute force."""
    layer = build_layer(f"ndt(leaf={leaf},min_points={least})", xyz)
    members = {index: rows for index, rows in voxels_of(xyz, (leaf,) * 3).items() if len(rows) >= least}
    assert list(map(tuple, rows_of(layer).tolist())) == sorted(members, key=lambda index: index[::-1])
    assert layer["count"].tolist() == [
        len(members[index]) for index in sorted(members, key=lambda i: i[::-1])
    ]
    for convention in CONVENTIONS:
        covariances, inverses = voxel_covariances(layer["count"], layer["scatter"], convention)
        for row, index in enumerate(map(tuple, rows_of(layer).tolist())):
            points = xyz[members[index]].astype(np.float64)
            about = points[0]
            error = layer["mean"][row] - about - (points - about).mean(axis=0)
            assert (np.abs(error) <= np.spacing(np.abs(about)) + 1e-15).all()
            true = covariance_of(points, convention)
            if true is None:
                assert not covariances[row].any()
                assert not inverses[row].any()
                continue
            for found, expected in zip((covariances, inverses), true, strict=True):
                assert np.abs(unpacked(found)[row] - expected).max() <= 1e-6 * np.abs(expected).max()
        if convention == "autoware":
            assert np.array_equal(layer["inverse_covariance"], inverses)


@pytest.mark.parametrize("least", [2, 6])
@pytest.mark.parametrize("name", [name for name in CORNERS if name != "far_apart"])
def test_ndt_of_corner_cases(name: str, least: int) -> None:
    check_ndt(corner(name), 2.0, least)


@given(clouds())
@settings(max_examples=60, deadline=None)
def test_ndt_of_any_cloud(given_cloud: tuple[NDArray[Any], float]) -> None:
    cloud, leaf = given_cloud
    finite = cloud[np.isfinite(cloud).all(axis=1)]
    check_ndt(finite[(np.abs(finite - finite[:1]) < 40 * leaf).all(axis=1)], leaf, 2)  # so that a table fits


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


def test_ndt_of_voxels() -> None:
    xyz = corner("large_f4", 4000)
    chained = build_layer("ndt(leaf=2.0,min_points=3,of=voxel(leaf=0.25))", xyz)
    direct = build_layer("ndt(leaf=2.0,min_points=3)", build_layer("voxel(leaf=0.25)", xyz)["xyz"])
    assert np.array_equal(chained["scatter"], direct["scatter"])
    assert chained.rows > 0


def test_unknown_convention() -> None:
    with pytest.raises(BadRequest):
        voxel_covariances(np.array([6]), np.ones((1, 6)), "other")  # type: ignore[arg-type]
