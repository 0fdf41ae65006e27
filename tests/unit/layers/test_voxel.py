# SPDX-License-Identifier: Apache-2.0
"""The voxel layer against brute force, column by column."""

from __future__ import annotations

import numpy as np
import pytest

from shmmap.errors import BadRequest
from shmmap.layers.build import build_layer
from shmmap.testing.layer_conformance import CORNERS, corner
from tests.support.layer_oracles import voxels_of


@pytest.mark.parametrize(
    ("spec", "leaf"), [("voxel(0.5)", (0.5, 0.5, 0.5)), ("voxel(leaf_x=1,leaf_y=2,leaf_z=.25)", (1, 2, 0.25))]
)
@pytest.mark.parametrize("name", CORNERS)
def test_equals_brute_force(name: str, spec: str, leaf: tuple[float, float, float]) -> None:
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
    voxels = voxels_of(xyz, leaf)
    assert layer.rows == len(voxels)
    assert {name: str(column.dtype) for name, column in layer.columns.items()} == {
        "xyz": str(xyz.dtype), "intensity": "float32", "ring": "float32", "stamp_ns": "float64",
        "normal": "float64", "count": "uint32",
    }  # fmt: skip
    for row, index in enumerate(sorted(voxels, key=lambda index: index[::-1])):
        some = voxels[index]
        assert layer["count"][row] == len(some)
        for column, values in columns.items():
            mean = values[some].astype(np.float64).mean(axis=0)
            found = layer[column][row]
            rounding = np.spacing(np.abs(mean).astype(found.dtype)) + 1e-15 * np.abs(values[some]).max()
            assert (np.abs(found - mean) <= 2 * rounding).all()
    if layer.rows:
        assert layer.lattice is not None
        assert layer.lattice.leaf == leaf


def test_of_voxels_counts_voxels() -> None:
    xyz = corner("origin")
    coarse = build_layer("voxel(2,of=voxel(0.5))", xyz)
    assert coarse["count"].sum() == build_layer("voxel(0.5)", xyz).rows


def test_points_keeps_what_is_finite() -> None:
    xyz = corner("not_finite")
    layer = build_layer("points", {"xyz": xyz, "ring": np.arange(len(xyz), dtype=np.uint16)})
    kept = np.flatnonzero(np.isfinite(xyz).all(axis=1))
    assert np.array_equal(layer["ring"], kept)
    assert np.array_equal(layer["xyz"], xyz[kept])


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
