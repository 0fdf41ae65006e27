# SPDX-License-Identifier: Apache-2.0
"""Every rule against a brute force that knows nothing of columns, tiles or cells."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.compare_map_filter import CompareMapFilter, CompareRule
from shmmap_clients.compare_map_filter.rule import MODES

from shmmap import BadRequest
from shmmap.layers import LayerTable, build_layer

ORIGINS = {
    "origin": (0.0, 0.0, 0.0),
    "negative": (-61.25, -40.5, -7.0),
    "MGRS": (89_560.0, 42_340.0, 12.0),
    "UTM": (-512_000.0, 4_427_000.0, 430.0),
}
DISTANCES = ((0.3, 1.0), (0.7, 2.5), (1.0, 0.25))


def brute_force(
    points: NDArray[Any], rule: CompareRule, clouds: list[NDArray[Any]], centroids: list[NDArray[Any]]
) -> NDArray[np.bool_]:
    """Whether each point (map frame) is explained, by comparing it with everything there is."""
    d = rule.distance
    d_z = d * rule.z_ratio
    scale = np.array([1 / d, 1 / d, 1 / d_z])
    everything = np.concatenate(centroids if rule.mode == "voxel" else clouds).astype(np.float64).T.copy()
    voxels = np.floor(everything * scale[:, None]) if rule.mode == "voxel-distance" else None
    result = np.zeros(len(points), np.bool_)
    for n, place in enumerate(points.astype(np.float64)):
        x, y, z = everything - place[:, None]
        if rule.mode == "voxel":
            result[n] = ((np.abs(x) < d) & (np.abs(y) < d) & (np.abs(z) < d_z)).any()
            continue
        result[n] = (x * x + y * y + z * z <= d * d).any()
        if voxels is not None:
            result[n] |= (voxels == np.floor(place * scale)[:, None]).all(axis=0).any()
    return result


def town_of_cells(
    rng: np.random.Generator, origin: tuple[float, float, float], dtype: type[np.floating[Any]]
) -> list[NDArray[Any]]:
    """Nine cells of 8 m with ground, a wall across all borders, and empty places."""
    ground = np.column_stack([rng.uniform(0, 24, (2500, 2)), rng.normal(0, 0.05, 2500)])
    wall = np.column_stack([rng.uniform(0, 24, 900), np.full(900, 8.0), rng.uniform(0, 5, 900)])
    wall[:, 1] += rng.normal(0, 0.02, 900)
    xyz = (np.concatenate([ground, wall]) + origin).astype(dtype)
    local = np.floor((xyz[:, :2].astype(np.float64) - origin[:2]) / 8.0)
    cells = [xyz[(local == (i, j)).all(axis=1)] for i, j in itertools.product(range(3), repeat=2)]
    cells[4] = cells[4][:0]  # an empty one among them
    return cells


def scan_points(rng: np.random.Generator, origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Points everywhere, many of them on borders, at exact distances and at lattice planes."""
    anywhere = rng.uniform((-2, -2, -1.5), (26, 26, 6), (700, 3))
    low = rng.uniform((-1, -1, -0.8), (25, 25, 0.8), (700, 3))
    border = rng.uniform((0, 0, -0.6), (24, 24, 1.2), (500, 3))
    border[:, rng.integers(0, 2)] = rng.choice([8.0, 16.0], 500) + rng.choice([-0.5, 0.0, 0.5], 500)
    return np.concatenate([anywhere, low, border]) + origin


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("place", "distance", "z_ratio"),
    [*((place, 0.5, 0.5) for place in ORIGINS), *(("origin", *one) for one in DISTANCES)],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_equals_brute_force(
    mode: str, place: str, dtype: type[np.floating[Any]], distance: float, z_ratio: float
) -> None:
    rng = np.random.default_rng(7)
    origin = ORIGINS[place]
    clouds = town_of_cells(rng, origin, dtype)
    rule = CompareRule(mode, distance, z_ratio)
    tables = [build_layer(rule.layer, cloud) for cloud in clouds]
    voxel = f"voxel(leaf_x={rule.distance},leaf_y={rule.distance},leaf_z={rule.distance_z})"
    centroids = [np.asarray(build_layer(voxel, cloud)["xyz"]) for cloud in clouds]
    points = scan_points(rng, origin)
    expected = brute_force(points, rule, clouds, centroids)
    assert 0.1 < expected.mean() < 0.9
    for backend in ("numba", "numpy"):
        compare = CompareMapFilter(rule, backend=backend).use_tables(tables)
        got = compare.apply(points)
        assert np.array_equal(~got.kept, expected), backend
        assert got.cells == 8
        assert np.array_equal(got.indices, np.flatnonzero(~expected))


def test_exactly_the_distance_is_explained_and_exactly_a_voxel_is_not() -> None:
    cloud = np.array([[0.25, 0.25, 0.125]])
    point = cloud + np.array([0.5, 0.0, 0.0])
    for mode, explained in (("distance", True), ("voxel", False), ("voxel-distance", True)):
        rule = CompareRule(mode)
        for backend in ("numba", "numpy"):
            compare = CompareMapFilter(rule, backend=backend).use_tables([build_layer(rule.layer, cloud)])
            assert compare.apply(point).kept.tolist() == [not explained], (mode, backend)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_points_that_are_not_finite_or_far_away_are_kept(backend: str) -> None:
    rule = CompareRule("distance")
    table = build_layer(rule.layer, np.zeros((3, 3), np.float32))
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, 0, 0]], np.float32)
    got = CompareMapFilter(rule, backend=backend).use_tables([table]).apply(points)
    assert got.kept.tolist() == [True, True, True, True, False]


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_no_map_explains_nothing(backend: str) -> None:
    compare = CompareMapFilter(backend=backend)
    assert compare.apply(np.zeros((4, 3), np.float32)).kept.all()
    assert len(compare.apply(np.empty((0, 3), np.float32)).kept) == 0


def test_the_pose_is_applied_and_every_field_survives() -> None:
    rng = np.random.default_rng(5)
    rule = CompareRule("distance")
    tables = [build_layer(rule.layer, c) for c in town_of_cells(rng, (0.0, 0.0, 0.0), np.float32)]
    turn = 0.7
    T = np.eye(4)
    T[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    T[:3, 3] = 10.0, 9.0, 1.5
    points = scan_points(rng, (0.0, 0.0, 0.0))
    scan = (points - T[:3, 3]) @ T[:3, :3]
    results = [
        CompareMapFilter(rule, backend=backend).use_tables(tables).apply(scan, T)
        for backend in ("numba", "numpy")
    ]
    assert np.array_equal(results[0].kept, results[1].kept)
    plain = CompareMapFilter(rule).use_tables(tables).apply(points).kept
    assert np.count_nonzero(plain != results[0].kept) <= 2  # rounding of the turn there and back
    columns: dict[str, NDArray[Any]] = {"xyz": scan, "ring": np.arange(len(scan), dtype=np.uint16)}
    kept = results[0].select(columns)
    assert np.array_equal(kept["ring"], results[0].indices)
    assert kept["ring"].dtype == np.uint16


def test_cells_of_any_boxes(tmp_path: object) -> None:
    """Overlapping cells, stray points far from their cell, one huge and one tiny cell."""
    rng = np.random.default_rng(11)
    clouds = [
        rng.uniform((-300, -300, 0), (300, 300, 3), (4000, 3)),
        rng.uniform((0, 0, 0), (6, 6, 1), (300, 3)),
        rng.uniform((3, 3, 0), (9, 9, 1), (300, 3)),
        np.array([[1.0, 1.0, 0.5], [2500.0, -1700.0, 0.0]]),
    ]
    points = np.concatenate(
        [rng.uniform((-10, -10, -1), (15, 15, 3), (800, 3)), clouds[3] + 0.2, clouds[0][:200] + 0.25]
    )
    rule = CompareRule("distance", 0.5)
    expected = brute_force(points, rule, clouds, [])
    tables = [build_layer(rule.layer, cloud) for cloud in clouds]
    for backend in ("numba", "numpy"):
        got = CompareMapFilter(rule, backend=backend).use_tables(tables).apply(points)
        assert np.array_equal(~got.kept, expected), backend


def test_refusals() -> None:
    for wrong in ({"mode": "fast"}, {"distance": 0.0}, {"distance": float("nan")}, {"z_ratio": -1.0}):
        with pytest.raises(BadRequest):
            CompareRule(**wrong)
    with pytest.raises(BadRequest):
        CompareMapFilter(backend="gpu")
    with pytest.raises(BadRequest):
        CompareMapFilter().apply(np.zeros((3, 2), np.float32))
    cloud = np.zeros((2, 3), np.float32)
    with pytest.raises(BadRequest, match="no column"):
        CompareMapFilter().use_tables([build_layer("voxel(leaf=0.5)", cloud)])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("leaf", [0.1, 0.6])
def test_columns_of_another_edge_than_the_distance_are_refused(mode: str, leaf: float) -> None:
    cloud = np.zeros((2, 3), np.float32)
    compare = CompareMapFilter(CompareRule(mode, 0.5)).use_tables([build_layer("search(leaf=0.5)", cloud)])
    mixed: list[LayerTable] = [build_layer(f"search(leaf={edge})", cloud + 9) for edge in (0.5, leaf)]
    for _ in range(2):
        with pytest.raises(BadRequest, match=f"of {leaf} m cannot answer"):
            compare.use_tables(mixed)
    assert not compare.apply(cloud).kept.any()  # what it had is still what it has
