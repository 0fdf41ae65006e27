# SPDX-License-Identifier: Apache-2.0
"""Score, gradient and Hessian: against their definition, between backends, under limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    Evaluation,
    Limits,
    Scoring,
    VoxelMap,
    matrix_from_pose,
    pose_from_matrix,
    voxel_cell,
)
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors

from tests.clients.ndt_scan_matcher.scene import (
    NEAR,
    TRUTH,
    cells_of,
    counts,
    map_of,
    off,
    same_bits,
    scan_from,
    squares_of,
)
from tests.clients.ndt_scan_matcher.textbook import Textbook, rotation

NEIGHBORS = ("direct1", "direct7", "radius")
COVARIANCES = ("autoware", "pclomp", "pcl")


def evaluated(
    backend: str,
    voxel_map: VoxelMap,
    scan: NDArray[np.floating],
    pose: NDArray[np.float64],
    *,
    limits: Limits | None = None,
    threads: int = 1,
    neighbors: Neighbors = "radius",
    covariance: Covariance = "autoware",
) -> Evaluation:
    computer = backend_named(backend, limits or Limits(source_points=4096), threads)
    computer.set_map(voxel_map)
    computer.set_source(scan)
    (result,) = computer.evaluate(pose[None], Scoring(neighbors, covariance))
    computer.close()
    return result


def assert_equal(a: Evaluation, b: Evaluation) -> None:
    assert counts(a) == counts(b)
    assert off(a, b) <= 1e-11


@pytest.mark.parametrize("neighbors", NEIGHBORS)
@pytest.mark.parametrize("covariance", COVARIANCES)
def test_the_backends_agree_and_equal_the_textbook_where_borders_cut_voxels(
    points: NDArray[np.float64], neighbors: str, covariance: str
) -> None:
    # cells of 7 m with voxels of 2 m: most borders cut voxels, and both halves count
    voxel_map = map_of(points, 2.0, edge=7.0)
    scan = scan_from(points, TRUTH, 60)
    settings: dict[str, Any] = {"neighbors": neighbors, "covariance": covariance}
    compiled = evaluated("numba", voxel_map, scan, NEAR, **settings)
    assert_equal(evaluated("numpy", voxel_map, scan, NEAR, **settings), compiled)
    textbook = Textbook(squares_of(points, 7.0).values(), 2.0, covariance)
    point, voxel = textbook.near(scan, NEAR, neighbors)
    shares = textbook.shares(scan, NEAR, (point, voxel))
    assert (compiled.found, compiled.neighbours) == (len(np.unique(point)), len(voxel))
    assert compiled.score == pytest.approx(shares.sum(), rel=1e-9)
    best = np.zeros(len(scan))
    np.maximum.at(best, point, shares)
    assert compiled.nearest == pytest.approx(best.sum(), rel=1e-9)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("neighbors", NEIGHBORS)
@pytest.mark.parametrize("covariance", COVARIANCES)
def test_any_leaf_and_pose_equal_the_textbook(
    points: NDArray[np.float64], neighbors: str, covariance: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    leaf = float(rng.uniform(0.6, 4.0))
    pose = TRUTH + rng.uniform(-1, 1, 6) * [1.0, 1.0, 0.5, 0.1, 0.1, 0.5]
    scan = scan_from(points, TRUTH, 150, seed)
    expected, gradient, hessian = Textbook([points], leaf, covariance).derivatives(scan, pose, neighbors)
    settings: dict[str, Any] = {"neighbors": neighbors, "covariance": covariance}
    found = evaluated("numba", VoxelMap({"map": voxel_cell(points, leaf)}), scan, pose, **settings)
    assert found.score == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(found.gradient, gradient, rtol=0, atol=1e-8 * np.abs(gradient).max())
    np.testing.assert_allclose(found.hessian, hessian, rtol=0, atol=1e-6 * np.abs(hessian).max())


def test_results_do_not_depend_on_the_number_of_threads(points: NDArray[np.float64]) -> None:
    voxel_map = map_of(points, 2.0)
    scan = scan_from(points, TRUTH, 3001)
    settings: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    one = evaluated("numba", voxel_map, scan, NEAR, threads=1, **settings)
    for threads in (2, 3, 40):
        many = evaluated("numba", voxel_map, scan, NEAR, threads=threads, **settings)
        assert same_bits(many, one)


@pytest.mark.parametrize("most", [1, 3, 8])
def test_the_nearest_neighbours_are_kept_under_a_cap(points: NDArray[np.float64], most: int) -> None:
    voxel_map = map_of(points, 2.0)
    scan = scan_from(points, TRUTH, 500)
    settings: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    limits = Limits(source_points=500, neighbors=most)
    compiled = evaluated("numba", voxel_map, scan, NEAR, limits=limits, **settings)
    assert_equal(evaluated("numpy", voxel_map, scan, NEAR, limits=limits, **settings), compiled)
    free = evaluated("numba", voxel_map, scan, NEAR, **settings)
    assert compiled.neighbours + compiled.cut_neighbours == free.neighbours
    assert compiled.neighbours <= most * compiled.found
    if most == 1:
        assert compiled.cut_points > 0


def test_points_beyond_the_cap_are_left_out_evenly(points: NDArray[np.float64]) -> None:
    scan = scan_from(points, TRUTH, 1000)
    for backend in ("numba", "numpy"):
        computer = backend_named(backend, Limits(source_points=300))
        computer.set_map(map_of(points, 2.0))
        assert computer.set_source(scan) == 700
        (some,) = computer.evaluate(NEAR[None], Scoring("radius", "autoware"))
        assert computer.set_source(scan[np.arange(300) * 1000 // 300]) == 0
        (same,) = computer.evaluate(NEAR[None], Scoring("radius", "autoware"))
        assert some.score == same.score


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_points_that_are_nowhere_find_nothing(points: NDArray[np.float64], backend: str) -> None:
    scan = scan_from(points, TRUTH, 50)
    nowhere = np.array(
        [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 1e300], [1e9, 0, 0], [0, -5e8, 0], [0, 0, 1e12]]
    )
    settings: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    voxel_map = map_of(points, 2.0)
    with_them = evaluated(backend, voxel_map, np.concatenate([nowhere, scan]), NEAR, **settings)
    assert_equal(with_them, evaluated(backend, voxel_map, scan, NEAR, **settings))
    empty = evaluated(backend, VoxelMap({}), scan, NEAR, **settings)
    assert (empty.score, empty.found, empty.nvtl) == (0.0, 0, 0.0)
    none = evaluated(backend, voxel_map, np.empty((0, 3)), NEAR, **settings)
    assert (none.score, none.found) == (0.0, 0)


def test_the_table_of_a_map_has_the_addresses_and_boxes_of_its_cells(points: NDArray[np.float64]) -> None:
    """Also of a map that follows another one with some of its cells."""
    cells = cells_of(points, 2.0, edge=5.0)
    first = VoxelMap(cells)
    first.table("pcl")
    some = dict(list(cells.items())[::-2])
    voxel_map = VoxelMap(some, previous=first)
    for row, (name, cell) in zip(voxel_map.table("pcl"), some.items(), strict=True):
        arrays = (cell.lattice, cell.mean, voxel_map.inverses(name, "pcl"))
        assert row[:3].tolist() == [array.ctypes.data for array in arrays]
        i0, j0, k0 = cell.lattice_origin.tolist()
        ni, nj, nk = cell.lattice.shape
        steps = [stride // 4 for stride in cell.lattice.strides]
        assert row[3:].tolist() == [i0, j0, k0, nk, *steps, len(cell.count), ni, nj]


def test_a_pose_is_its_matrix() -> None:
    for pose in np.random.default_rng(3).uniform(-1.5, 1.5, (20, 6)):
        T = matrix_from_pose(pose)
        np.testing.assert_allclose(T[:3, :3], rotation(pose[3:]), atol=1e-15)
        np.testing.assert_allclose(pose_from_matrix(T), pose, atol=1e-12)
