# SPDX-License-Identifier: Apache-2.0
"""Limits that hold for every backend: bytes of the map, poses at once, time; and what they left out."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    Cut,
    Limits,
    NdtMatcher,
    Scoring,
    Settings,
    TrustLimits,
    VoxelMap,
    matrix_from_pose,
)
from shmmap_clients.ndt_scan_matcher.backends import kernels
from shmmap_clients.ndt_scan_matcher.backends.registry import backend_named
from shmmap_clients.ndt_scan_matcher.cli import main
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveStatistics
from shmmap_clients.ndt_scan_matcher.map.map_updater import UpdateStatistics
from shmmap_clients.ndt_scan_matcher.matching import matcher as matcher_module
from shmmap_clients.ndt_scan_matcher.matching import newton
from shmmap_clients.ndt_scan_matcher.matching.pose_batch import derivatives_of_poses, matrices_from_poses

import shmmap
from tests.clients.ndt_scan_matcher.scene import (
    GUESS,
    TRUTH,
    cells_of,
    frame,
    map_of,
    same_bits,
    scan_from,
    street,
    worth,
)
from tests.support.opencl_device import need_device

HOW = Scoring("radius", "autoware")


@pytest.fixture(scope="module")
def scan() -> NDArray[np.float64]:
    return scan_from(street(seed=7), TRUTH, 800)


@pytest.fixture(params=["numba", "numpy", "opencl"])
def backend(request: pytest.FixtureRequest) -> str:
    if request.param == "opencl":
        need_device()
    return str(request.param)


def test_a_map_has_no_more_bytes_than_allowed(
    points: NDArray[np.float64], scan: NDArray[np.float64], backend: str
) -> None:
    cells = cells_of(points, 2.0)
    whole = sum(cell.map_bytes for cell in cells.values())
    limits = Limits(map_bytes=whole // 2)
    assert limits.max_map_bytes == whole // 2
    with NdtMatcher(Settings(backend=backend), limits=limits) as matcher:
        capped = VoxelMap(cells, max_bytes=matcher.limits.max_map_bytes, centre=(-25.0, 0.0))
        kept = sum(cell.map_bytes for cell in capped.cells.values())
        assert 0 < kept <= whole // 2
        assert kept + capped.bytes_left_out == whole
        assert capped.voxels + capped.voxels_left_out == sum(len(cell.count) for cell in cells.values())
        farthest_kept = max(cell.lattice_origin[0] for cell in capped.cells.values())
        nearest_left = min(cell.lattice_origin[0] for key, cell in cells.items() if key not in capped.cells)
        assert farthest_kept <= nearest_left
        matcher.set_map(matcher.prepare(capped))
        cut = matcher.align(scan, GUESS).cut
    assert (cut.map_bytes, cut.voxels) == (capped.bytes_left_out, capped.voxels_left_out)
    assert set(cut.by) == {"voxels", "map_bytes"}
    # the stricter of two limits counts
    fewest = len(min(cells.values(), key=lambda cell: len(cell.count)).count)
    assert len(VoxelMap(cells, max_voxels=10**9, max_bytes=1).cells) == 0
    assert VoxelMap(cells, max_voxels=fewest - 1, max_bytes=whole).cells == {}
    assert VoxelMap(cells, max_voxels=10**9, max_bytes=whole).bytes_left_out == 0


def test_no_evaluation_begins_after_the_deadline(
    points: NDArray[np.float64], scan: NDArray[np.float64], backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    voxel_map = map_of(points, 2.0)
    ticks = itertools.count()

    class Clock:
        """A second passes from one look to the next."""

        monotonic = staticmethod(lambda: float(next(ticks)))

    settings = Settings(backend=backend, mode="coarse_fine")
    with NdtMatcher(settings) as free:
        free.set_map(free.prepare(voxel_map))
        whole = free.align(scan, GUESS)
    assert whole.iterations > 3
    assert not whole.cut
    # a device's own waiting looks at the real clock, which is far behind this deadline
    with NdtMatcher(settings, limits=Limits(deadline_s=3.0)) as matcher:
        matcher.set_map(matcher.prepare(voxel_map))
        matcher.align(scan, GUESS)
        ticks = itertools.count(start=int(time.monotonic()) + 1000)
        for module in (matcher_module, newton):
            monkeypatch.setattr(module, "time", Clock)
        result = matcher.align(scan, GUESS)
        three = matcher.align_many(scan, [GUESS, GUESS, np.eye(4)])
    assert result.cut.by == ("deadline",)
    assert result.cut.deadline
    assert not result.converged
    assert not result.trustworthy
    assert result.evaluations == 3
    np.testing.assert_array_equal(result.transforms, whole.transforms[: len(result.transforms)])
    assert all(one.cut.deadline and one.evaluations == 3 for one in three)


def test_more_poses_than_the_limit_are_refused_at_once_and_split_by_the_matcher(
    points: NDArray[np.float64], scan: NDArray[np.float64], backend: str
) -> None:
    poses = TRUTH + np.random.default_rng(3).normal(0.0, 0.2, (7, 6)) * [1, 1, 0.2, 0.05, 0.05, 0.3]
    limits = Limits(source_points=800, poses=3)
    one = backend_named(backend, limits)
    one.set_map(map_of(points, 2.0))
    one.set_source(scan)
    with pytest.raises(shmmap.BadRequest, match="7 poses at once, the limit on poses is 3"):
        one.evaluate(poses, HOW)
    with NdtMatcher(Settings(backend=backend), limits=limits) as matcher:
        matcher.set_map(map_of(points, 2.0))
        together = matcher.evaluate(scan, poses)
    for pose, found in zip(poses, together, strict=True):
        assert same_bits(found, worth(one, pose, HOW))


def test_limits_that_make_no_sense_are_refused() -> None:
    wrong: tuple[dict[str, Any], ...] = (
        {"map_bytes": 0},
        {"poses": 0},
        {"poses": 100_000},
        {"deadline_s": 0.0},
        {"deadline_s": -1.0},
        {"deadline_s": math.inf},
        {"deadline_s": math.nan},
    )
    for given in wrong:
        with pytest.raises(shmmap.BadRequest):
            Limits(**given)
    assert Limits(voxels=10).max_map_bytes == 960


def test_the_bound_of_time_is_measured_where_the_work_is_done(
    points: NDArray[np.float64], scan: NDArray[np.float64], backend: str
) -> None:
    with NdtMatcher(Settings(backend=backend), limits=Limits(source_points=800)) as matcher:
        matcher.set_map(matcher.prepare(map_of(points, 2.0)))
        bound = matcher.time_bound(scan, GUESS)
        begin = time.perf_counter()
        matcher.evaluate(scan, TRUTH[None])
        took_ms = (time.perf_counter() - begin) * 1e3
    assert bound.deadline_s is None
    assert bound.total_ms == pytest.approx(bound.evaluations * bound.pass_ms)
    if backend == "opencl":
        # not the time of the thread that only waits, which is a fraction of the device's
        assert bound.pass_ms > 0.02
    assert took_ms > 0
    with NdtMatcher(Settings(backend=backend), limits=Limits(source_points=800, deadline_s=1e-4)) as matcher:
        matcher.set_map(matcher.prepare(map_of(points, 2.0)))
        bounded = matcher.time_bound(scan, GUESS)
    assert bounded.total_ms == pytest.approx(0.1 + bounded.pass_ms)
    assert "0.0001 s" in bounded.describe()


def test_a_drive_counts_what_each_limit_left_out() -> None:
    plain, statistics = frame(0, np.eye(4), None), DriveStatistics()
    for cut in (Cut(points=3), Cut(points=1, deadline=True), Cut(voxels=5, map_bytes=500), Cut()):
        statistics.add(dataclasses.replace(plain, result=dataclasses.replace(plain.result, cut=cut)))
    summary = statistics.summary(UpdateStatistics(), 0, TrustLimits(nvtl=1.0), backend="opencl")
    assert summary.cut_frames == 3
    assert summary.cut_by == {"points": 2, "deadline": 1, "voxels": 1, "map_bytes": 1}
    document = summary.as_document()
    assert (document["backend"], document["fault"]) == ("opencl", None)


def test_the_program_says_what_limits_left_out(
    points: NDArray[np.float64], scan: NDArray[np.float64], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "map.npz", xyz=points)
    np.savez(tmp_path / "scan.npz", xyz=scan.astype(np.float32))
    words = ["align", "--map", str(tmp_path / "map.npz"), "--scan", str(tmp_path / "scan.npz")]
    words += ["--guess", "1.5,0.3,1.9,0.02,-0.03,0.42"]
    assert main([*words, "--max-map-bytes", "10", "--json"]) == 1
    cut = json.loads(capsys.readouterr().out)["cut"]
    assert cut["map_bytes"] > 10
    assert cut["voxels"] > 0
    assert main([*words, "--deadline", "1e-9", "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert document["cut"]["deadline"] is True
    assert document["evaluations"] == 1
    assert main([*words, "--deadline", "1e-9"]) == 1
    assert "the deadline ended it" in capsys.readouterr().out


def test_many_poses_have_the_same_matrices_and_derivatives_as_one_and_as_the_compiled_backend() -> None:
    poses = np.random.default_rng(2).uniform(-3, 3, (50, 6))
    poses[::7, 3:] = 0.0
    poses[1::7, 4] = 5e-5
    compiled_T, compiled_M = np.zeros((50, 4, 4)), np.zeros((50, 9, 3, 3))
    for sign in (-1.0, 1.0):
        matrices, derivatives = matrices_from_poses(poses), derivatives_of_poses(poses, sign)
        for pose, T, M in zip(poses, matrices, derivatives, strict=True):
            np.testing.assert_array_equal(T, matrix_from_pose(pose))
            np.testing.assert_array_equal(M, derivatives_of_poses(pose[None], sign)[0])
        kernels.derive(poses, sign, compiled_T, compiled_M)
        np.testing.assert_allclose(compiled_T, matrices, rtol=0, atol=1e-15)
        np.testing.assert_allclose(compiled_M, derivatives, rtol=0, atol=1e-15)
