# SPDX-License-Identifier: Apache-2.0
"""The OpenCL backend gives what the compiled one gives: sums, alignments, bits."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    DeviceError,
    DeviceOptions,
    Limits,
    NdtMatcher,
    Result,
    Scoring,
    Settings,
    VoxelMap,
    matrix_from_pose,
    voxel_cell,
)
from shmmap_clients.ndt_scan_matcher.backends.backend import Backend
from shmmap_clients.ndt_scan_matcher.backends.opencl_backend import OpenclBackend, build_kernel
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.matching.evaluation import Neighbors

from tests.clients.ndt_scan_matcher.references import (
    assert_as_the_original,
    clouds,
    reference_rows,
    settings_of,
    target,
)
from tests.clients.ndt_scan_matcher.scene import (
    NEAR,
    TRUTH,
    cells_of,
    counts,
    map_of,
    off,
    same_bits,
    worth,
)
from tests.support.opencl_device import as_if, need_device

SVM = DeviceOptions(memory="svm")
COPY = DeviceOptions(memory="copy")
FLOAT = DeviceOptions(precision="float")


@pytest.fixture(scope="module", autouse=True)
def device() -> None:
    need_device()


@pytest.fixture(params=["CPU", "GPU"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A work-item for each chunk of points, or for each point."""
    as_if(monkeypatch, kind=request.param)
    return str(request.param)


def ready(
    name: str,
    voxel_map: VoxelMap,
    scan: NDArray[np.floating],
    *,
    limits: Limits | None = None,
    options: DeviceOptions | None = None,
) -> Backend:
    backend = backend_named(name, limits or Limits(source_points=4096), 1, options)
    backend.set_map(voxel_map)
    backend.set_source(scan)
    return backend


@pytest.mark.parametrize(
    ("memory", "neighbors"), [("copy", "direct1"), ("copy", "direct7"), ("copy", "radius"), ("svm", "radius")]
)
def test_sums_and_counts_are_those_of_the_compiled_backend(
    points: NDArray[np.float64], scan: NDArray[np.float64], kind: str, memory: str, neighbors: Neighbors
) -> None:
    # cells of 7 m with voxels of 2 m: most borders cut voxels, and both halves count
    voxel_map = map_of(points, 2.0, edge=7.0)
    for most in (32, 3, 1):
        limits = Limits(source_points=4096, neighbors=most)
        here = ready("numba", voxel_map, scan, limits=limits)
        there = ready("opencl", voxel_map, scan, limits=limits, options=replace(COPY, memory=memory))  # type: ignore[arg-type]
        for covariance in ("autoware", "pclomp", "pcl"):
            for sign in (-1.0, 1.0):
                how = Scoring(neighbors, covariance, sign)
                wanted, found = worth(here, NEAR, how), worth(there, NEAR, how)
                assert counts(found) == counts(wanted), (most, covariance)
                assert off(found, wanted) <= 1e-12, (most, covariance)
                if most == 1:
                    assert wanted.cut_points > 0


@pytest.mark.parametrize("options", [COPY, SVM, FLOAT])
def test_repeats_and_poses_in_a_batch_have_the_same_bits(
    points: NDArray[np.float64], scan: NDArray[np.float64], kind: str, options: DeviceOptions
) -> None:
    # so few rows that a batch takes several launches
    there = ready("opencl", map_of(points, 2.0), scan, options=options)
    assert isinstance(there, OpenclBackend)
    there._max_rows = 40
    how = Scoring("radius", "autoware")
    poses = NEAR + np.random.default_rng(4).normal(0.0, 0.3, (17, 6)) * [1, 1, 0.2, 0.05, 0.05, 0.3]
    batch = there.evaluate(poses, how)
    assert len(batch) == len(poses)
    for pose, among_others in zip(poses, batch, strict=True):
        assert same_bits(worth(there, pose, how), among_others)
    first = worth(there, NEAR, how)
    assert all(same_bits(worth(there, NEAR, how), first) for _ in range(20))
    assert there.evaluate(poses[:0], how) == []


@pytest.mark.parametrize("options", [COPY, SVM, FLOAT])
def test_points_that_are_nowhere_find_nothing(
    points: NDArray[np.float64], scan: NDArray[np.float64], kind: str, options: DeviceOptions
) -> None:
    nowhere = np.array(
        [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 1e300], [1e9, 0, 0], [0, -5e8, 0], [0, 0, 1e12]]
    )
    how = Scoring("radius", "autoware")
    voxel_map = map_of(points, 2.0)
    alone = worth(ready("opencl", voxel_map, scan[:100], options=options), NEAR, how)
    with_them = ready("opencl", voxel_map, np.concatenate([scan[:100], nowhere]), options=options)
    assert same_bits(worth(with_them, NEAR, how), alone)
    for empty in (
        ready("opencl", VoxelMap({}), scan, options=options),
        ready("opencl", voxel_map, scan[:0], options=options),
    ):
        none = worth(empty, NEAR, how)
        assert (none.score, none.found, none.nvtl) == (0.0, 0, 0.0)


def aligned(settings: Settings, voxel_map: VoxelMap, scan: NDArray[np.floating], guess: Any) -> Result:
    with NdtMatcher(settings) as matcher:
        matcher.set_map(matcher.prepare(voxel_map))
        return matcher.align(scan, guess)


def assert_same_result(found: Result, wanted: Result, t: float, R: float, tp: float) -> None:
    assert found.iterations == wanted.iterations
    assert found.converged == wanted.converged
    np.testing.assert_allclose(found.T_map_base[:3, 3], wanted.T_map_base[:3, 3], atol=t, rtol=0)
    np.testing.assert_allclose(found.T_map_base[:3, :3], wanted.T_map_base[:3, :3], atol=R, rtol=0)
    assert found.transform_probability == pytest.approx(wanted.transform_probability, abs=tp)
    assert found.nvtl == pytest.approx(wanted.nvtl, abs=tp)
    assert found.cut == wanted.cut


@pytest.mark.parametrize(
    ("options", "step", "to_originals", "to_numba"),
    [
        (COPY, 1, (1e-4, 1e-5, 1e-4), (1e-9, 1e-9, 1e-9)),
        (SVM, 5, (1e-4, 1e-5, 1e-4), (1e-9, 1e-9, 1e-9)),  # the same program in other memory: some of them
        (FLOAT, 1, (2e-4, 3e-5, 2.1e-3), (1e-4, 2e-5, 2e-3)),
    ],
    ids=["copy", "svm", "float"],
)
def test_all_reference_alignments(
    data_dir: Path,
    options: DeviceOptions,
    step: int,
    to_originals: tuple[float, float, float],
    to_numba: tuple[float, float, float],
) -> None:
    folder = data_dir / "ndt"
    cases = reference_rows(folder)
    assert len(cases) == 32 + 78
    for row in cases[::step]:
        settings, guess = settings_of(row)
        voxel_map, scan = target(folder, row["dataset"], row["leaf"]), clouds(folder, row["dataset"])[1]
        found = aligned(replace(settings, backend="opencl", device=options), voxel_map, scan, guess)
        assert_as_the_original(found, row, *to_originals)
        assert_same_result(found, aligned(settings, voxel_map, scan, guess), *to_numba)


@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("kind_of_device", ["CPU", "GPU"])
def test_the_program_builds_without_a_warning(
    monkeypatch: pytest.MonkeyPatch, double: bool, kind_of_device: str
) -> None:
    import pyopencl as cl

    as_if(monkeypatch, kind=kind_of_device)
    backend = OpenclBackend(Limits(), options=COPY if double else FLOAT)
    for neighbors in ("direct1", "direct7", "radius"):
        kernel = build_kernel(backend._context, backend.device, neighbors, 32, extra=["-Werror"])
        program = kernel.program
        assert program.get_build_info(backend.device.handle, cl.program_build_info.LOG).strip() == ""


def test_many_guesses_are_aligned_as_one_by_one(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    voxel_map = map_of(points, 2.0)
    offsets = np.random.default_rng(5).normal(0.0, 0.3, (7, 6)) * [1, 1, 0.3, 0.05, 0.05, 0.2]
    guesses = [matrix_from_pose(TRUTH + off) for off in offsets]
    for backend in ("numba", "numpy", "opencl"):
        for variant, mode in (("autoware", "coarse_fine"), ("pclomp", "single")):
            settings = Settings(variant, mode=mode, backend=backend)  # type: ignore[arg-type]
            with NdtMatcher(settings, limits=Limits(poses=3)) as matcher:
                matcher.set_map(matcher.prepare(voxel_map))
                together = matcher.align_many(scan, guesses)
                for guess, one in zip(guesses, together, strict=True):
                    alone = matcher.align(scan, guess)
                    assert (alone.T_map_base == one.T_map_base).all(), backend
                    assert (alone.iterations, alone.evaluations) == (one.iterations, one.evaluations)
                    assert (alone.transform_probability, alone.nvtl) == (one.transform_probability, one.nvtl)
                assert matcher.align_many(scan, []) == []


def test_a_map_is_written_in_advance_and_the_old_one_stays(
    points: NDArray[np.float64], scan: NDArray[np.float64], kind: str
) -> None:
    cells = cells_of(points, 2.0, edge=10.0)
    names = list(cells)
    first = VoxelMap({name: cells[name] for name in names[:-4]})
    second = VoxelMap({name: cells[name] for name in names[2:]}, previous=first)
    there = ready("opencl", first, scan, options=COPY)
    assert isinstance(there, OpenclBackend)
    how = Scoring("radius", "autoware")
    there.prepare(first, how)
    before = worth(there, NEAR, how)
    for last in (second, VoxelMap(first.cells), VoxelMap(second.cells)):
        written, writes = there.uploads.written_bytes, there.uploads.writes
        there.prepare(last, how)
        needed = sum(cell.map_bytes for cell in last.cells.values())
        tables = last.private_bytes + 104 * len(last.cells) + 64 * (3 * len(last.cells) + 4)
        assert needed <= there.uploads.written_bytes - written <= needed + tables
        assert there.uploads.writes == writes + 1
        assert same_bits(worth(there, NEAR, how), before), "the map in use is untouched"
        there.set_map(last)
        before = worth(there, NEAR, how)
        assert there.uploads.writes == writes + 1, "all was done in advance"
        assert off(before, worth(ready("numba", last, scan), NEAR, how)) <= 1e-12
    assert there.uploads.laid_out_again == 0


def test_a_map_that_another_was_prepared_in_place_of_is_written_again(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    how = Scoring("radius", "autoware")
    maps = [map_of(points, 2.0, edge=edge) for edge in (20.0, 10.0, 5.0)]
    there = ready("opencl", maps[0], scan, options=COPY)
    wanted = [worth(ready("numba", one, scan), NEAR, how) for one in maps]
    worth(there, NEAR, how)
    for one in maps[1:]:
        there.prepare(one, how)
    writes = there.uploads.writes
    for one, at in zip(maps[1:], wanted[1:], strict=True):
        there.set_map(one)
        assert off(worth(there, NEAR, how), at) <= 1e-12
    assert there.uploads.writes == writes + 1, "only the one that had lost its place"


@pytest.mark.parametrize("options", [COPY, FLOAT])
def test_another_kind_of_covariance_is_written_beside_the_first(
    points: NDArray[np.float64], scan: NDArray[np.float64], kind: str, options: DeviceOptions
) -> None:
    voxel_map = map_of(points, 2.0)
    there = ready("opencl", VoxelMap({}), scan, options=options)
    assert isinstance(there, OpenclBackend)
    worth(there, NEAR, Scoring("radius", "autoware"))
    nothing = there.maps.used_bytes
    there.prepare(voxel_map, Scoring("radius", "autoware"))
    written, used = there.uploads.written_bytes, there.maps.used_bytes
    there.prepare(voxel_map, Scoring("radius", "pcl"))
    inverses = sum(cell.inverse.nbytes for cell in voxel_map.cells.values())
    tables = voxel_map.private_bytes + 104 * len(voxel_map.cells) + 64 * (len(voxel_map.cells) + 4)
    assert there.uploads.written_bytes - written <= inverses + tables
    there.set_map(voxel_map)
    for covariance in ("autoware", "pcl"):
        how = Scoring("radius", covariance)
        wanted = worth(ready("numba", voxel_map, scan), NEAR, how)
        assert off(worth(there, NEAR, how), wanted) <= (1e-12 if options is COPY else 1e-4)
    assert there.uploads.written_bytes - written <= inverses + tables, "nothing more"
    assert used < there.maps.used_bytes
    # all comes back, of both kinds
    empty = VoxelMap({})
    there.set_map(empty)
    worth(there, NEAR, Scoring("radius", "autoware"))
    there.prepare(VoxelMap({}), Scoring("radius", "autoware"))
    assert there.maps.used_bytes <= 2 * nothing


def test_a_cell_without_voxels_does_no_harm(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    cells = cells_of(points, 2.0)
    empty = voxel_cell(points[:3], 2.0)
    assert len(empty.count) == 0
    how = Scoring("radius", "autoware")
    for options in (COPY, SVM, FLOAT):
        there = ready("opencl", VoxelMap(cells), scan, options=options)
        without = worth(there, NEAR, how)
        for some in ({"empty": empty, **cells}, {**cells, "empty": empty}, {"empty": empty}):
            voxel_map = VoxelMap(some)
            there.prepare(voxel_map, how)
            there.set_map(voxel_map)
            found = worth(there, NEAR, how)
            assert same_bits(found, without) if len(some) > 1 else found.found == 0


def test_a_map_in_place_stays_while_it_is_in_use_beside_the_next_ones(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    how = Scoring("radius", "autoware")
    there = ready("opencl", map_of(points, 2.0), scan, options=SVM)
    before = worth(there, NEAR, how)
    for number in range(20):
        last = map_of(points, 2.0, edge=5.0 + number % 4)
        there.prepare(last, how)
        gc.collect()  # tables without an owner would be overwritten by the next map's
        assert same_bits(worth(there, NEAR, how), before)
    there.set_map(last)
    assert off(worth(there, NEAR, how), worth(ready("numba", last, scan), NEAR, how)) <= 1e-12


def test_a_write_that_fails_leaves_nothing_behind(
    points: NDArray[np.float64], scan: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    how = Scoring("radius", "autoware")
    there = ready("opencl", VoxelMap({}), scan, options=COPY)
    assert isinstance(there, OpenclBackend)
    worth(there, NEAR, how)
    used = there.maps.used_bytes
    voxel_map = map_of(points, 2.0)

    def fails(*arguments: object) -> None:
        raise DeviceError("it fails")

    with monkeypatch.context() as patch:
        patch.setattr(there.maps, "_write", fails)
        with pytest.raises(DeviceError):
            there.prepare(voxel_map, how)
    assert there.maps.used_bytes == used
    assert there.uploads.laid_out_again == 0
    there.prepare(voxel_map, how)
    there.set_map(voxel_map)
    assert off(worth(there, NEAR, how), worth(ready("numba", voxel_map, scan), NEAR, how)) <= 1e-12


def test_a_map_in_place_is_not_copied(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    voxel_map = map_of(points, 2.0)
    for cell in voxel_map.cells.values():
        for array in (cell.lattice, cell.mean, cell.inverse):
            array.flags.writeable = False
    there = ready("opencl", voxel_map, scan, options=SVM)
    assert isinstance(there, OpenclBackend)
    at = worth(there, NEAR, Scoring("radius", "autoware"))
    assert at.found > 0
    assert (there.uploads.writes, there.uploads.written_bytes, there.maps.used_bytes) == (0, 0, 0)
    assert voxel_map.private_bytes < 16_384, "tables, of which the device reads the only copy"
