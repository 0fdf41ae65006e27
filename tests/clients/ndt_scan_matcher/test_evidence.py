# SPDX-License-Identifier: Apache-2.0
"""Poses that rest on too little are not trusted, however well they fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    NdtMatcher,
    Result,
    Settings,
    VoxelMap,
    matrix_from_pose,
    voxel_cell,
)
from shmmap_clients.ndt_scan_matcher.matching.result import extent_of
from shmmap_clients.scans.scan_file import read_scan, thinned
from shmmap_clients.scans.trajectory import read_trajectory

from tests.clients.ndt_scan_matcher.scene import map_of, scan_from, street

Points = NDArray[np.floating]

TRUTH = np.array([1.0, -0.5, 1.8, 0.0, 0.0, 0.2])
BESIDE = np.array([1.2, -0.6, 1.85, 0.0, 0.0, 0.21])


@pytest.fixture(scope="module")
def scan() -> NDArray[np.float64]:
    """A scan of 8000 points, with a known pose."""
    return scan_from(street(5), TRUTH, 8000)


def sector(scan: Points, degrees: float, heading: float = 0.0) -> Points:
    """Return what lies between two headings, degrees."""
    off = np.degrees(np.arctan2(scan[:, 1], scan[:, 0])) - heading
    return scan[np.abs((off + 180.0) % 360.0 - 180.0) < degrees / 2]


def on_map(scan: Points) -> NDArray[np.float64]:
    T = matrix_from_pose(TRUTH)
    return np.asarray(scan @ T[:3, :3].T + T[:3, 3], np.float64)


def within(scan: Points, metres: float) -> Points:
    near: Points = scan[np.linalg.norm(scan, axis=1) < metres]
    return near


def aligned(
    points: Points,
    scan: Points,
    mode: str = "single",
    backend: str = "numba",
) -> Result:
    settings = Settings(mode="coarse_fine" if mode == "coarse_fine" else "single", steady=True)
    with NdtMatcher(settings, backend=backend) as matcher:
        matcher.set_map(map_of(points, 2.0))
        return matcher.align(scan, matrix_from_pose(BESIDE))


LITTLE: dict[str, tuple[Callable[[Points], Points], set[str]]] = {
    "one point": (lambda scan: scan[:1], {"points", "angle", "spread"}),
    "two points": (lambda scan: scan[[0, -1]], {"points", "spread"}),
    "twenty points": (lambda scan: scan[:: len(scan) // 20], {"points"}),
    "all in one place": (lambda scan: np.repeat(scan[:1], 500, axis=0), {"angle", "spread"}),
    "all near one place": (
        lambda scan: scan[5] + np.random.default_rng(0).normal(0.0, 0.05, (500, 3)),
        {"spread"},
    ),
    "a sector of 10 degrees": (lambda scan: sector(scan, 10.0), {"angle"}),
    "a wall": (lambda scan: scan[np.abs(on_map(scan)[:, 1] - 9.0) < 0.05], {"sharpness"}),
    "the ground": (lambda scan: scan[np.abs(on_map(scan)[:, 2]) < 0.05], {"sharpness"}),
    "all within 6 m": (lambda scan: within(scan, 6.0), {"distance"}),
    "all within 6 m but a few": (
        lambda scan: np.concatenate([within(scan, 6.0), scan[np.argsort(np.linalg.norm(scan, axis=1))[-5:]]]),
        {"distance"},
    ),
    "within 6 m, and points that are not finite": (
        lambda scan: np.concatenate([within(scan, 6.0), np.full((50, 3), np.inf), np.full((50, 3), np.nan)]),
        {"distance"},
    ),
    "many far points, few of them on the map": (
        lambda scan: np.concatenate([scan[:: len(scan) // 20], scan[:1000] + np.array([0.0, 0.0, 500.0])]),
        {"points"},
    ),
}


@pytest.mark.parametrize("mode", ["single", "coarse_fine"])
@pytest.mark.parametrize("part", LITTLE)
def test_what_rests_on_little_is_not_trusted(points: Points, scan: Points, part: str, mode: str) -> None:
    chosen, expected = LITTLE[part]
    result = aligned(points, chosen(scan), mode)
    assert expected <= set(result.failed_limits), (result.failed_limits, result.evidence)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
@pytest.mark.parametrize("mode", ["single", "coarse_fine"])
@pytest.mark.parametrize("degrees", [60.0, 90.0, 180.0, 360.0])
def test_front_scanners_are_trusted(
    points: Points, scan: Points, degrees: float, mode: str, backend: str
) -> None:
    result = aligned(points, sector(scan, degrees, heading=30.0), mode, backend)
    assert np.linalg.norm(result.T_map_base[:3, 3] - TRUTH[:3]) < 0.2
    assert result.trustworthy, (result.failed_limits, result.evidence)


def test_a_tunnel_holds_nothing_lengthwise() -> None:
    rng = np.random.default_rng(3)
    n = 20_000
    x, wall = rng.uniform(-60, 60, n), rng.integers(0, 3, n)
    y = np.where(wall == 0, -4.0, np.where(wall == 1, 4.0, rng.uniform(-4, 4, n)))
    z = np.where(wall == 2, 0.0, rng.uniform(0, 5, n))
    tunnel = np.column_stack([x, y, z]) + rng.normal(0.0, 0.01, (n, 3))
    seen = tunnel[np.abs(tunnel[:, 0]) < 25.0][::3]
    result = aligned(tunnel, seen - TRUTH[:3], "coarse_fine")
    assert "sharpness" in result.failed_limits or "spread" in result.failed_limits, result.evidence


def test_evidence_does_not_depend_on_the_number_of_points_or_the_heading(
    points: Points, scan: Points
) -> None:
    every, some = aligned(points, scan).evidence, aligned(points, scan[::5]).evidence
    assert some.points == pytest.approx(every.points / 5, rel=0.05)
    assert some.sharpness == pytest.approx(every.sharpness, rel=0.1)
    assert some.spread == pytest.approx(every.spread, rel=0.2)
    R = matrix_from_pose(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    with NdtMatcher(Settings(steady=True)) as matcher:
        matcher.set_map(map_of(points, 2.0))
        turned = matcher.align(scan @ R[:3, :3], matrix_from_pose(BESIDE) @ R).evidence
    assert turned.sharpness == pytest.approx(every.sharpness, rel=0.05)
    assert turned.spread == pytest.approx(every.spread, rel=0.05)


def test_the_distance_is_that_of_the_twentieth_farthest() -> None:
    away = np.arange(1.0, 101.0)
    line = np.column_stack([away, np.zeros(100), np.zeros(100)])
    assert extent_of(line).distance == 81.0
    assert extent_of(line.astype(np.float32)[::-1]).distance == 81.0
    assert extent_of(line[:5]).distance == 1.0
    assert extent_of(line[:0]).distance == 0.0
    line[90:] = np.nan
    assert extent_of(line).distance == 71.0


@pytest.mark.parametrize("width", [1.0, 10.0, 35.0, 60.0, 90.0])
def test_the_angle_is_the_width_of_a_sector(width: float) -> None:
    heading = np.radians(np.linspace(-width / 2, width / 2, 500) + 170.0)
    points = 30.0 * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(500)])
    assert extent_of(points).angle == pytest.approx(width, rel=0.02)
    points[::7] = np.nan
    points[1::7] = 0.0
    assert extent_of(points).angle == pytest.approx(width, rel=0.02)


def test_the_angle_all_around_and_of_nothing() -> None:
    heading = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    ring = np.column_stack([np.cos(heading), np.sin(heading), np.ones(500)])
    assert extent_of(ring).angle == pytest.approx(281, abs=1)
    for nothing in (ring[:1], ring[:0], np.zeros((5, 3)), np.full((5, 3), np.nan)):
        assert extent_of(nothing).angle == pytest.approx(0.0, abs=1e-5)


def test_parts_of_recorded_scans(data_dir: Path) -> None:
    folder = data_dir / "kitti0005_scans"
    cloud = read_scan(data_dir / "kitti0005_map" / "map_static_v010.pcd")
    poses = read_trajectory(folder / "poses_heldout_tum.txt").T_map_sensor
    rng = np.random.default_rng(4)
    files = sorted(folder.glob("scan_*.npz"))[::5]
    trusted = wrong = 0
    with NdtMatcher(Settings(mode="coarse_fine")) as matcher:
        matcher.set_map(VoxelMap({"map": voxel_cell(cloud, 2.0)}))
        for path, T in zip(files, poses[::5], strict=True):
            scan = thinned(read_scan(path), 1.0)
            assert matcher.align(scan, T).trustworthy
            assert matcher.align(sector(scan, 180.0), T).trustworthy
            for part in (
                scan[:1],
                scan[::200],
                within(scan, 6.0),
                sector(scan, 10.0),
                scan[scan[:, 2] < -1.4],
            ):
                for _ in range(4):
                    off = np.array([*rng.normal(0.0, 2.0, 2), 0.0, 0.0, 0.0, rng.normal(0.0, 0.05)])
                    result = matcher.align(part, T @ matrix_from_pose(off))
                    if np.linalg.norm(result.T_map_base[:3, 3] - T[:3, 3]) > 0.3:
                        wrong += 1
                        trusted += result.trustworthy
    assert wrong > 30
    assert not trusted
