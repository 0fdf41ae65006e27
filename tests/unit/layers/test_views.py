# SPDX-License-Identifier: Apache-2.0
"""sample, crop, denoise, normals, elevation and ground against slow and independent answers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.layers.build import build_layer
from shmmap.layers.ground import ground_height
from shmmap.testing.layer_conformance import CORNERS, corner, surface
from tests.support.layer_oracles import columns_of, fitted_height, inliers_of, normal_of
from tests.support.skips import open3d_or_skip

TABLES = [name for name in CORNERS if name != "far_apart"]


def finite_of(xyz: NDArray[Any]) -> NDArray[Any]:
    kept: NDArray[Any] = xyz[np.isfinite(xyz).all(axis=1)]
    return kept


@pytest.mark.parametrize("name", CORNERS)
def test_sample(name: str) -> None:
    xyz = finite_of(corner(name))
    numbers = np.arange(len(corner(name)), dtype=np.uint32)
    every = build_layer("sample(every=7)", {"xyz": corner(name), "number": numbers})
    assert np.array_equal(every["xyz"], xyz[::7])
    few = build_layer("sample(count=50,seed=4)", {"xyz": corner(name), "number": numbers})
    assert few.rows == min(50, len(xyz))
    assert (np.diff(few["number"].astype(int)) > 0).all()
    assert np.array_equal(few["xyz"], corner(name)[few["number"]])
    if len(xyz) > 100:
        other = build_layer("sample(count=50,seed=5)", {"xyz": corner(name), "number": numbers})
        assert not np.array_equal(few["number"], other["number"])


def test_sample_chooses_every_point_equally_often() -> None:
    xyz = np.arange(3000, dtype=np.float64).reshape(1000, 3)
    chosen = np.zeros(1000)
    for seed in range(200):
        chosen[(build_layer(f"sample(count=100,seed={seed})", xyz)["xyz"][:, 0] / 3).astype(int)] += 1
    # binomial(200, 0.1): mean 20, standard deviation 4.2
    assert abs(chosen.mean() - 20) < 1e-9
    assert 3.5 < chosen.std() < 5.0
    assert chosen.max() < 45


def split_mix(row: int, seed: int) -> int:
    """SplitMix64 in whole numbers."""
    mask = (1 << 64) - 1
    state = ((row + 1) * 0x9E3779B97F4A7C15 + seed * 0xD1342543DE82EF95) & mask
    state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & mask
    state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & mask
    return state ^ (state >> 31)


def test_the_random_choice_never_changes() -> None:
    assert sorted(sorted(range(20), key=lambda row: split_mix(row, 1))[:6]) == [4, 5, 6, 11, 13, 18]
    xyz = np.arange(60, dtype=np.float64).reshape(20, 3)
    found = (build_layer("sample(count=6,seed=1)", xyz)["xyz"][:, 0] / 3).astype(int).tolist()
    assert found == [4, 5, 6, 11, 13, 18]


@pytest.mark.parametrize("name", CORNERS)
def test_crop(name: str) -> None:
    xyz = corner(name)
    low, high = -0.5, 1.5
    layer = build_layer(f"crop(z_min={low},z_max={high})", xyz)
    expected = [point for point in xyz if np.isfinite(point).all() and low <= point[2] <= high]
    assert np.array_equal(layer["xyz"], np.array(expected, xyz.dtype).reshape(-1, 3))
    assert build_layer(f"crop(z_min={high})", xyz).rows == sum(
        bool(np.isfinite(p).all() and p[2] >= high) for p in xyz
    )


@pytest.mark.parametrize("name", CORNERS)
def test_denoise(name: str) -> None:
    open3d_or_skip()
    xyz = corner(name, 300)
    halo = corner(name, 300)[::3] + np.array([0.3, 0.2, 0.1], xyz.dtype)
    halo = finite_of(halo)
    kept = finite_of(xyz)
    for neighbours, ratio, around in ((4, 1.0, None), (20, 2.0, halo)):
        layer = build_layer(f"denoise(neighbors={neighbours},std_ratio={ratio})", xyz, halo=around)
        means, limit = inliers_of(kept, neighbours, ratio, around)
        sure = np.abs(means - limit) > 1e-9 * (1 + limit)
        inside = {tuple(point) for point in layer["xyz"].tolist()}
        for point, mean in zip(kept[sure].tolist(), means[sure], strict=True):
            assert (tuple(point) in inside) is bool(mean <= limit)
        assert layer.rows <= len(kept)


@pytest.mark.parametrize("name", TABLES)
def test_normals(name: str) -> None:
    open3d_or_skip()
    xyz = corner(name, 300)
    kept = finite_of(xyz)
    halo = finite_of(corner(name, 300))[::4] + np.array([0.25, 0.5, 0.05], xyz.dtype)
    layer = build_layer("normals(radius=1.5,neighbors=12)", xyz, halo=halo)
    assert np.array_equal(layer["xyz"], kept)
    lengths = np.linalg.norm(layer["normal"].astype(np.float64), axis=1)
    assert np.allclose(lengths, 1.0, atol=1e-6)
    assert (layer["normal"][:, 2] >= 0).all()
    everything = np.concatenate([kept, halo])
    judged = 0
    for number in range(0, len(kept), 5):
        true, clear = normal_of(everything, number, 1.5, 12)
        if clear > 0.05:
            judged += 1
            assert abs(float(layer["normal"][number] @ true)) > 0.999, number
    assert judged > 20 or name in {"empty", "one_point", "duplicates", "borders"}


@pytest.mark.parametrize("edge", [0.5, 2.0])
@pytest.mark.parametrize("name", TABLES)
def test_elevation_and_ground(name: str, edge: float) -> None:
    xyz = corner(name)
    layer = build_layer(f"elevation(resolution={edge})", xyz)
    columns = columns_of(xyz, edge)
    assert layer.rows == len(columns)
    assert layer.lattice is not None
    assert layer["count"].shape == layer.lattice.shape[1::-1]
    seen = {}
    for j, i in zip(*np.nonzero(layer["count"]), strict=True):
        seen[i + layer.lattice.first[0], j + layer.lattice.first[1]] = (
            layer["count"][j, i], layer["min"][j, i], layer["max"][j, i], layer["mean"][j, i],
        )  # fmt: skip
    assert set(seen) == set(columns)
    for index, rows in columns.items():
        z = xyz[rows, 2].astype(np.float64)
        count, low, high, mean = seen[index]
        assert (count, low, high) == (len(rows), np.float32(z.min()), np.float32(z.max()))
        assert abs(mean - z.mean()) <= np.spacing(np.float32(abs(z.mean()))) + 1e-12
    assert np.isnan(layer["min"][layer["count"] == 0]).all()
    ground = build_layer(f"ground(resolution={edge})", xyz)
    assert ground["min"].tobytes() == layer["min"].tobytes()
    assert ground.lattice == layer.lattice


def lowest_within(xyz: NDArray[Any], x: float, y: float, radius: float) -> float:
    near = np.hypot(xyz[:, 0].astype(np.float64) - x, xyz[:, 1].astype(np.float64) - y) < radius
    return float(xyz[near, 2].min(initial=math.inf))


@pytest.mark.parametrize("edge", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (-500.0, 300.0), (89570.0, 42300.0)])
def test_the_fitted_height_is_within_its_stated_tolerance(edge: float, origin: tuple[float, float]) -> None:
    rng = np.random.default_rng(11)
    xyz = np.add(surface(rng, 3000, 40.0), (*origin, 7.0))
    west = xyz[:, 0] < origin[0] + 20.0  # two cells
    grids = []
    for part in (xyz[west], xyz[~west]):
        layer = build_layer(f"ground(resolution={edge})", part)
        assert layer.lattice is not None
        grids.append((layer["min"], layer.lattice))
    exact = 0
    for x, y in rng.uniform(-5, 45, (200, 2)) + origin:
        found = ground_height(grids, x, y, rule="min")
        true = fitted_height(xyz, x, y)
        assert found is not None
        assert true is not None
        nearest = float(np.hypot(xyz[:, 0] - x, xyz[:, 1] - y).min())
        slack = edge * math.sqrt(2) + 1e-9
        below = np.float32(lowest_within(xyz, x, y, nearest + 1.0 + slack))
        above = np.float32(lowest_within(xyz, x, y, nearest + 1.0 - slack))
        assert below <= found <= above
        exact += abs(found - true) < 0.05
    assert exact > 120


def test_nothing_near_has_no_height() -> None:
    layer = build_layer("ground", corner("origin"))
    assert layer.lattice is not None
    grids = [(layer["min"], layer.lattice)]
    assert ground_height(grids, 500.0, 0.0) is None
    assert ground_height(grids, math.nan, 0.0) is None
    assert ground_height([], 0.0, 0.0) is None
    empty = build_layer("ground", corner("empty"))
    assert empty.lattice is not None
    assert ground_height([(empty["min"], empty.lattice)], 0.0, 0.0) is None
