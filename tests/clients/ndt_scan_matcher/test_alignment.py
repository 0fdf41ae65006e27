# SPDX-License-Identifier: Apache-2.0
"""Alignments of a generated street: they arrive, in any frame, by any backend, and say what they did."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients import ndt_scan_matcher
from shmmap_clients.ndt_scan_matcher import (
    Evaluation,
    Limits,
    NdtMatcher,
    Regularization,
    Result,
    Settings,
    VoxelMap,
    matrix_from_pose,
)
from shmmap_clients.ndt_scan_matcher.matching.newton import Ascent, StepRule, ascend, variant_named
from shmmap_clients.ndt_scan_matcher.matching.result import covariance_of, oscillations

import shmmap
from tests.clients.ndt_scan_matcher.scene import GUESS, TRUTH, cells_of, map_of


def aligned(
    voxel_map: VoxelMap,
    scan: NDArray[np.floating],
    guess: NDArray[np.float64] = GUESS,
    settings: Settings | None = None,
    *,
    backend: str = "numba",
    limits: Limits | None = None,
    regularization: Regularization | None = None,
) -> Result:
    with NdtMatcher(settings, backend=backend, limits=limits) as matcher:
        matcher.set_map(voxel_map)
        return matcher.align(scan, guess, regularization=regularization)


def error_m(result: Result) -> float:
    return float(np.linalg.norm(result.T_map_base[:3, 3] - TRUTH[:3]))


def test_a_result_prints_as_one_line(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    shown = repr(aligned(map_of(points, 2.0), scan, backend="numpy"))
    assert re.fullmatch(
        r"<Result at x -?\d+\.\d{3}, y \S+, z \S+ m, yaw \S+ deg: NVTL \d\.\d\d, \d+ steps, trusted>", shown
    ), shown
    assert repr(aligned(VoxelMap({}), scan, backend="numpy")).endswith("not trusted (no_map)>")
    assert re.fullmatch(r"<VoxelMap of \d+ cells, \d+ voxels of 2 m>", repr(map_of(points, 2.0)))


@pytest.mark.parametrize("variant", ["autoware", "pclomp", "pcl"])
@pytest.mark.parametrize("neighbors", ["direct1", "direct7", "radius"])
@pytest.mark.parametrize("line_search", [False, True])
def test_backends_take_the_same_steps(
    points: NDArray[np.float64], scan: NDArray[np.float64], variant: str, neighbors: str, line_search: bool
) -> None:
    settings = Settings(variant, neighbors, line_search=line_search)  # type: ignore[arg-type]
    voxel_map = map_of(points, 2.0)
    a, b = (aligned(voxel_map, scan, settings=settings, backend=name) for name in ("numba", "numpy"))
    assert (a.iterations, a.evaluations, a.converged) == (b.iterations, b.evaluations, b.converged)
    np.testing.assert_allclose(a.transforms, b.transforms, atol=1e-8)
    np.testing.assert_allclose(a.nvtls, b.nvtls, rtol=1e-8)
    assert a.transform_probability == pytest.approx(b.transform_probability, rel=1e-8)


def test_a_reader_follows_one_alignment_through_few_files(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    """The package's docstring lists them."""
    folder, entered = Path(str(ndt_scan_matcher.__file__)).parent, set[str]()

    def enter(frame: FrameType, event: str, _argument: object) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and folder in path.parents:
            entered.add(str(path.relative_to(folder)))

    with NdtMatcher() as matcher:
        matcher.set_map(matcher.prepare(map_of(points, 2.0)))
        sys.setprofile(enter)
        try:
            matcher.align(scan, GUESS)
        finally:
            sys.setprofile(None)
    entered.add("backends/kernels.py")  # compiled: since Python 3.12 a profiler need not see it
    assert entered == set(re.findall(r"``(\w+/\w+\.py)``", str(ndt_scan_matcher.__doc__)))
    assert len(entered) <= 8


def test_autoware_and_fine_arrive(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    voxel_map = map_of(points, 2.0)
    plain = aligned(voxel_map, scan)
    fine = aligned(voxel_map, scan, settings=Settings(mode="coarse_fine"))
    assert plain.converged
    assert fine.converged
    assert error_m(plain) < 0.1
    assert error_m(fine) < 0.02
    assert error_m(fine) <= error_m(plain)
    assert plain.trustworthy
    assert plain.nvtl > 2.3
    assert len(plain.transforms) == plain.iterations + 1 == len(plain.nvtls) == plain.evaluations
    assert (plain.transforms[0] == GUESS).all()
    assert not plain.cut
    assert plain.covariance is not None
    assert (np.linalg.eigvalsh(plain.covariance) > 0).all()


def test_steady_steps_end_where_the_originals_do(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    voxel_map = map_of(points, 2.0)
    plain = aligned(voxel_map, scan, settings=Settings(epsilon=1e-4))
    steady = aligned(voxel_map, scan, settings=Settings(epsilon=1e-4, steady=True))
    assert steady.converged
    np.testing.assert_allclose(steady.T_map_base, plain.T_map_base, atol=1e-3)


def climbed(
    evaluate: Callable[[NDArray[np.float64], float], Evaluation],
    start: list[float],
    *,
    epsilon: float,
    max_step: float,
) -> Ascent:
    """Climb by steady steps from a pose vector to the peak, which is at zero."""
    rule = StepRule(variant_named("autoware"), epsilon, max_step, 30, False, steady=True)
    ascent = ascend(matrix_from_pose(np.array(start)), evaluate, rule)
    assert ascent.converged
    np.testing.assert_allclose(ascent.pose, np.zeros(6), atol=1e-3)
    return ascent


def test_steady_steps_do_not_swing() -> None:
    # far from a peak of this score a Newton step leads away, and at 0.5 m steps past the peak
    def evaluate(pose: NDArray[np.float64], _sign: float) -> Evaluation:
        value = float(np.exp(-0.5 * (pose @ pose) / 0.09))
        hessian = value * (np.outer(pose, pose) / 0.09 - np.eye(6)) / 0.09
        return Evaluation(value, -value * pose / 0.09, hessian, 0.0, 1, 1, 0, 0)

    ascent = climbed(evaluate, [0.55, 0.2, -0.1, 0.0, 0.0, 0.0], epsilon=1e-3, max_step=0.5)
    assert ascent.last.score > 0.999


@pytest.mark.parametrize("start", [0.13, 0.22])
def test_steady_steps_do_not_bounce_between_the_sides_of_a_crease(start: float) -> None:
    # the sides are straight: Newton's step leads far over the crease, along which the peak still lies ahead
    def evaluate(pose: NDArray[np.float64], _sign: float) -> Evaluation:
        width, steep = 0.002, 4.0
        length = float(np.hypot(pose[1], width))
        gradient, hessian = -pose, -np.eye(6)
        gradient[1] = -steep * pose[1] / length
        hessian[1, 1] = -steep * width**2 / length**3
        value = -steep * length - 0.5 * float(np.delete(pose, 1) @ np.delete(pose, 1))
        return Evaluation(value, gradient, hessian, 0.0, 1, 1, 0, 0)

    ascent = climbed(evaluate, [0.8, start, 0.0, 0.0, 0.0, 0.0], epsilon=0.01, max_step=0.1)
    assert ascent.last.score == max(at.score for at in ascent.evaluations)


def test_a_steady_step_that_loses_much_is_not_taken() -> None:
    # beside the start is a peak, a lower one farther on; with hardly any curvature a step leads over both
    def evaluate(pose: NDArray[np.float64], _sign: float) -> Evaluation:
        value, gradient, hessian = 0.0, np.zeros(6), np.zeros((6, 6))
        for peak, height in ((0.0, 1.0), (0.09, 0.6)):
            off = pose - peak * np.eye(6)[5]
            part = height * float(np.exp(-0.5 * (off @ off) / 0.0004))
            value += part
            gradient -= part * off / 0.0004
            hessian += part * (np.outer(off, off) / 0.0004 - np.eye(6)) / 0.0004
        return Evaluation(value, gradient, hessian, 0.0, 1, 1, 0, 0)

    climbed(evaluate, [0.0, 0.0, 0.0, 0.0, 0.0, -0.0199], epsilon=1e-4, max_step=0.1)


def test_the_same_pose_at_large_coordinates(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    shift = np.array([89570.0, 42300.0, 0.0])
    here = aligned(map_of(points, 2.0), scan)
    guess = GUESS.copy()
    guess[:3, 3] += shift
    there = aligned(map_of(points + shift, 2.0), scan, guess)
    assert there.iterations == here.iterations
    np.testing.assert_allclose(there.T_map_base[:3, 3] - shift, here.T_map_base[:3, 3], atol=1e-6)


def test_a_map_is_extended_without_computing_again(points: NDArray[np.float64]) -> None:
    cells = cells_of(points, 2.0)
    first = VoxelMap(dict(list(cells.items())[:-1]))
    tables = {key: first.inverses(key, "pcl") for key in first.cells}
    second = VoxelMap(cells, previous=first)
    assert all(second.inverses(key, "pcl") is table for key, table in tables.items())
    assert all(second.inverses(key, "autoware") is cell.inverse for key, cell in cells.items())


def test_no_map_is_no_pose(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    for backend in ("numba", "numpy"):
        far = GUESS.copy()
        far[0, 3] += 5000.0
        for voxel_map, guess in ((VoxelMap({}), GUESS), (map_of(points, 2.0), far)):
            result = aligned(voxel_map, scan, guess, Settings(mode="coarse_fine"), backend=backend)
            assert not result.converged
            assert (result.no_map, result.failed_limits) == (True, ("no_map",))
            assert (result.T_map_base == guess).all()
            assert (result.iterations, result.nvtl, result.transform_probability) == (0, 0.0, 0.0)
            assert result.covariance is None
        assert not aligned(VoxelMap({}), scan[:0], backend=backend).no_map, "no scan is not no map"


def test_regularization_pulls_along_the_heading(
    points: NDArray[np.float64], scan: NDArray[np.float64]
) -> None:
    voxel_map = map_of(points, 2.0)
    plain = aligned(voxel_map, scan)
    heading = np.array([np.cos(TRUTH[5]), np.sin(TRUTH[5])])
    ahead = plain.T_map_base[:2, 3] + heading
    pulled = aligned(voxel_map, scan, regularization=Regularization(float(ahead[0]), float(ahead[1]), 0.05))
    moved = pulled.T_map_base[:2, 3] - plain.T_map_base[:2, 3]
    assert 0.005 < moved @ heading < 1.0
    assert abs(moved @ np.array([-heading[1], heading[0]])) < 0.2 * moved @ heading


def test_caps_are_reported(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    limits = Limits(source_points=1000, neighbors=2, voxels=400, iterations=3)
    voxel_map = VoxelMap(cells_of(points, 2.0), max_voxels=limits.voxels, centre=(1.0, 0.0))
    result = aligned(voxel_map, scan, limits=limits)
    assert result.cut.points == 500
    assert result.cut.neighbor_points > 0
    assert result.cut.neighbors > 0
    assert result.cut.voxels == voxel_map.voxels_left_out > 0
    assert result.iterations == 3
    assert not result.converged


@pytest.mark.parametrize("variant", ["autoware", "pclomp"])
def test_evaluations_never_exceed_what_the_caps_allow(
    points: NDArray[np.float64], scan: NDArray[np.float64], variant: str
) -> None:
    settings = Settings(variant, epsilon=1e-9, mode="coarse_fine", fine_epsilon=1e-9)
    with NdtMatcher(settings, limits=Limits(source_points=600, iterations=4)) as matcher:
        matcher.set_map(map_of(points, 2.0))
        result = matcher.align(scan, GUESS)
        worst = matcher.time_bound(scan, result.T_map_base)
        assert result.evaluations <= worst.evaluations
        assert worst.points == 600
        assert worst.total_ms > 0


def test_an_oscillation_is_a_run_of_reversals() -> None:
    transforms = np.tile(np.eye(4), (7, 1, 1))
    transforms[:, 0, 3] = [0, 1, 2, 1, 2, 1, 0]
    assert oscillations(transforms) == 3
    assert oscillations(transforms[:3]) == 0
    assert oscillations(transforms[:1]) == 0


def test_covariance_wants_a_peak() -> None:
    covariance = covariance_of(-4.0 * np.eye(6))
    assert covariance is not None
    np.testing.assert_allclose(covariance, 0.25 * np.eye(6))
    assert covariance_of(np.eye(6)) is None
    assert covariance_of(np.zeros((6, 6))) is None


def test_wrong_requests_are_refused(points: NDArray[np.float64], scan: NDArray[np.float64]) -> None:
    for settings in (
        Settings("gicp"),
        Settings(neighbors="direct26"),  # type: ignore[arg-type]
        Settings(epsilon=0.0),
        Settings(max_iterations=0),
        Settings(mode="finest"),  # type: ignore[arg-type]
    ):
        with pytest.raises(shmmap.BadRequest):
            NdtMatcher(settings)
    with pytest.raises(shmmap.BadRequest):
        NdtMatcher(backend="fortran")
    with pytest.raises(shmmap.BadRequest):
        Limits(neighbors=0)
    with NdtMatcher() as matcher:
        with pytest.raises(shmmap.BadRequest):
            matcher.align(scan, np.full((4, 4), np.nan))
        with pytest.raises(shmmap.BadRequest):
            matcher.align(scan[:, :2], GUESS)
    a, b = cells_of(points, 2.0), cells_of(points, 1.0)
    with pytest.raises(shmmap.BadRequest, match="one leaf size"):
        VoxelMap({"a": next(iter(a.values())), "b": next(iter(b.values()))})
    with pytest.raises(shmmap.BadRequest, match="span"):
        VoxelMap(cells_of(np.concatenate([points, points + 10_000.0]), 2.0))
