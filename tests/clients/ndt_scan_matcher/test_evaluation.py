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

from tests.clients.ndt_scan_matcher.brute_force import rotation, score
from tests.clients.ndt_scan_matcher.scene import cells_of, map_of, scan_from
from tests.clients.ndt_scan_matcher.textbook import Textbook

NEIGHBORS = ("direct1", "direct7", "radius")
COVARIANCES = ("autoware", "pclomp", "pcl")
TRUTH = np.array([1.3, 0.4, 1.8, 0.02, -0.03, 0.4])
NEAR = TRUTH + np.array([0.2, -0.15, 0.1, 0.01, 0.02, -0.03])


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


def assert_equal(a: Evaluation, b: Evaluation, tolerance: float = 1e-11) -> None:
    assert (a.found, a.neighbours, a.cut_points, a.cut_neighbours) == (
        b.found,
        b.neighbours,
        b.cut_points,
        b.cut_neighbours,
    )
    assert a.score == pytest.approx(b.score, rel=tolerance)
    assert a.nvtl == pytest.approx(b.nvtl, rel=tolerance)
    np.testing.assert_allclose(a.gradient, b.gradient, atol=tolerance * np.abs(b.gradient).max())
    np.testing.assert_allclose(a.hessian, b.hessian, atol=tolerance * np.abs(b.hessian).max())


@pytest.mark.parametrize("neighbors", NEIGHBORS)
@pytest.mark.parametrize("covariance", COVARIANCES)
def test_the_backends_agree_and_equal_the_definition(
    points: NDArray[np.float64], neighbors: str, covariance: str
) -> None:
    # cells of 7 m with voxels of 2 m: most borders cut voxels, and both halves count
    voxel_map = map_of(points, 2.0, edge=7.0)
    scan = scan_from(points, TRUTH, 60)
    settings: dict[str, Any] = {"neighbors": neighbors, "covariance": covariance}
    compiled = evaluated("numba", voxel_map, scan, NEAR, **settings)
    assert_equal(evaluated("numpy", voxel_map, scan, NEAR, **settings), compiled)
    total, nearest, found, number = score(scan, NEAR, voxel_map, settings["covariance"], neighbors)
    assert (compiled.found, compiled.neighbours) == (found, number)
    assert compiled.score == pytest.approx(total, rel=1e-12)
    assert compiled.nearest == pytest.approx(nearest, rel=1e-12)


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
    expected, gradient, hessian = Textbook(points, leaf, covariance).derivatives(scan, pose, neighbors)
    settings: dict[str, Any] = {"neighbors": neighbors, "covariance": covariance}
    found = evaluated("numba", VoxelMap({"map": voxel_cell(points, leaf)}), scan, pose, **settings)
    assert found.score == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(found.gradient, gradient, rtol=0, atol=1e-8 * np.abs(gradient).max())
    np.testing.assert_allclose(found.hessian, hessian, rtol=0, atol=1e-6 * np.abs(hessian).max())


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_derivatives_are_those_of_the_score(points: NDArray[np.float64], backend: str) -> None:
    voxel_map = map_of(points, 2.0)
    scan = scan_from(points, TRUTH, 300)
    computer = backend_named(backend, Limits(source_points=300))
    computer.set_map(voxel_map)
    computer.set_source(scan)

    def at(pose: NDArray[np.float64]) -> Evaluation:
        # own lattice place only, and steps far smaller than the distance to its faces
        return computer.evaluate(pose[None], Scoring("direct1", "autoware"))[0]

    here, h = at(NEAR), 1e-7
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = h
        ahead, behind = at(NEAR + step), at(NEAR - step)
        assert (ahead.score - behind.score) / (2 * h) == pytest.approx(
            here.gradient[axis], rel=1e-5, abs=1e-4
        )
        slope = (ahead.gradient - behind.gradient) / (2 * h)
        np.testing.assert_allclose(slope, here.hessian[axis], atol=1e-6 * np.abs(here.hessian).max())


def test_results_do_not_depend_on_the_number_of_threads(points: NDArray[np.float64]) -> None:
    voxel_map = map_of(points, 2.0)
    scan = scan_from(points, TRUTH, 3001)
    settings: dict[str, Any] = {"neighbors": "radius", "covariance": "autoware"}
    one = evaluated("numba", voxel_map, scan, NEAR, threads=1, **settings)
    for threads in (2, 3, 40):
        many = evaluated("numba", voxel_map, scan, NEAR, threads=threads, **settings)
        assert many.score == one.score
        assert (many.gradient == one.gradient).all()
        assert (many.hessian == one.hessian).all()


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


def test_whole_cells_beyond_the_cap_are_left_out_the_farthest_first(points: NDArray[np.float64]) -> None:
    cells = cells_of(points, 2.0)
    total = sum(len(cell.count) for cell in cells.values())
    capped = VoxelMap(cells, max_voxels=total // 2, centre=(-25.0, 0.0))
    assert 0 < capped.voxels <= total // 2
    assert capped.voxels + capped.voxels_left_out == total
    left = [cell.lattice_origin[0] for key, cell in cells.items() if key not in capped.cells]
    kept = [cell.lattice_origin[0] for cell in capped.cells.values()]
    assert max(kept) <= min(left)


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


def test_read_only_arrays_are_taken_as_they_are(points: NDArray[np.float64]) -> None:
    cells = cells_of(points, 2.0)
    scan = scan_from(points, TRUTH, 200)
    settings: dict[str, Any] = {"neighbors": "direct7", "covariance": "autoware"}
    before = evaluated("numba", VoxelMap(cells), scan, NEAR, **settings)
    for cell in cells.values():
        for array in (cell.lattice, cell.mean, cell.inverse, cell.scatter, cell.count):
            array.flags.writeable = False
    scan.flags.writeable = False
    assert evaluated("numba", VoxelMap(cells), scan, NEAR, **settings).score == before.score


def test_a_next_maps_table_is_as_if_it_were_the_first(points: NDArray[np.float64]) -> None:
    cells = cells_of(points, 2.0, edge=5.0)
    names = list(cells)
    moved = cells_of(points + 0.05, 2.0, edge=5.0)[names[8]]
    whole = VoxelMap(cells)
    covariances: tuple[Covariance, ...] = ("autoware", "pcl")
    for covariance in covariances:
        whole.table(covariance)
    rng = np.random.default_rng(8)
    last = whole
    for _ in range(30):
        # some go, some come, one changes, in another order; not every map is asked for its tables
        some = {name: cells[name] for name in rng.permutation(names)[: rng.integers(0, len(names) + 1)]}
        if names[8] in some and rng.random() < 0.5:
            some[names[8]] = moved
        voxel_map = VoxelMap(some, previous=last)
        if rng.random() < 0.7:
            for covariance in covariances:
                table = voxel_map.table(covariance)
                alone = VoxelMap(some, derived=voxel_map._derived)
                assert (table == alone.table(covariance)).all()
                for row, (name, cell) in zip(table, some.items(), strict=True):
                    inverse = voxel_map.inverses(name, covariance)
                    arrays = (cell.lattice, cell.mean, inverse)
                    assert row[:3].tolist() == [array.ctypes.data for array in arrays]
                    i0, j0, k0 = cell.lattice_origin.tolist()
                    ni, nj, nk = cell.lattice.shape
                    steps = [stride // 4 for stride in cell.lattice.strides]
                    assert row[3:].tolist() == [i0, j0, k0, nk, *steps, len(cell.count), ni, nj]
        last = voxel_map


def test_a_pose_is_its_matrix() -> None:
    for pose in np.random.default_rng(3).uniform(-1.5, 1.5, (20, 6)):
        T = matrix_from_pose(pose)
        np.testing.assert_allclose(T[:3, :3], rotation(*pose[3:]), atol=1e-15)
        np.testing.assert_allclose(pose_from_matrix(T), pose, atol=1e-12)
