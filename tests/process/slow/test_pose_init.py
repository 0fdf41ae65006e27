# SPDX-License-Identifier: Apache-2.0
"""Initial poses with a real daemon: found, repeated without loading, and as a program."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.map_extent import NoMapHere
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
from shmmap_clients.scans.scan_file import read_scan

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.forked_programs import run_verb
from tests.support.ndt_programs import TownDrive, town_drive_once


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    return town_drive_once(tmp_path_factory, blocks=(3, 3), density=5.0, frames=5, step=15.0)


@pytest.fixture
def initializer(town: TownDrive, daemon: DaemonFactory) -> Iterator[PoseInitializer]:
    one = daemon(town.map_dir)
    with PoseInitializer(one.endpoint, InitializerRules(map_radius=60.0, height=1.8)) as initializer:
        yield initializer


def rough(town: TownDrive, index: int, seed: int) -> RoughPose:
    x, y, _, _, _, yaw = town.poses[index]
    dx, dy, turn = np.random.default_rng(seed).uniform(-1.5, 1.5, 3)
    return RoughPose(x + dx, y + dy, z=500.0, yaw=yaw + turn * 0.08)


def test_poses_are_found_and_cost_no_loading(town: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(town.map_dir)
    rules = InitializerRules(map_radius=60.0, height=1.8)
    with (
        PoseInitializer(one.endpoint, rules) as initializer,
        shmmap.connect(one.endpoint) as session,
    ):
        for index in range(len(town.poses)):
            scan = read_scan(town.scans / f"scan_{index:04}.npz")
            found = initializer.initialize(scan, rough(town, index, index))
            assert found.reliable
            np.testing.assert_allclose(found.T_map_base[:3, 3], town.poses[index, :3], atol=0.3)
            assert found.ground_z == pytest.approx(found.T_map_base[2, 3] - 1.8, abs=0.1)
            assert all(other.score <= found.score for other in found.alternatives)
            misses = session.stats().counters["misses"]
            again = initializer.initialize(scan, rough(town, index, index))
            assert (again.T_map_base == found.T_map_base).all()
            assert session.stats().counters["misses"] == misses > 0


@pytest.mark.parametrize("below", ["reflections", "a stray point", "a pit"])
def test_the_ground_is_that_of_the_pose(
    town: TownDrive, daemon: DaemonFactory, tmp_path: Path, below: str
) -> None:
    x, y, z, _, _, yaw = town.poses[2]
    rng = np.random.default_rng(1)
    edge = 4.0 if below == "reflections" else 1.5
    deep = rng.uniform(-edge / 2, edge / 2, (200, 3)) * (1.0, 1.0, 0.0) + np.array([x, y, z - 5.0])
    keep = np.ones(len(town.points), np.bool_)
    if below == "a pit":
        keep = (np.abs(town.points[:, :2] - (x, y)) > edge / 2).any(axis=1)
    cloud = np.concatenate([town.points[keep], deep[:1] if below == "a stray point" else deep])
    shmmap.write_pcd(tmp_path / "map.pcd", {"xyz": cloud.astype(np.float32)})
    one = daemon(tmp_path / "map.pcd")
    scan = read_scan(town.scans / "scan_0002.npz")
    with PoseInitializer(one.endpoint, InitializerRules(map_radius=60.0, height=1.8)) as initializer:
        # the rough pose is on the spot, where Autoware's rule finds what lies below the street
        found = initializer.initialize(scan, RoughPose(x, y, yaw=yaw + 0.1))
    np.testing.assert_allclose(found.T_map_base[:3, 3], [x, y, z], atol=0.3)
    assert found.ground_z == pytest.approx(z - 1.8, abs=0.1)


def test_of_levels_above_each_other_the_rough_height_chooses(
    town: TownDrive, daemon: DaemonFactory, tmp_path: Path
) -> None:
    x, y, z, _, _, yaw = town.poses[2]
    storeys = [town.points + np.array([0.0, 0.0, height], np.float32) for height in (0.0, 8.0)]
    shmmap.write_pcd(tmp_path / "map.pcd", {"xyz": np.concatenate(storeys)})
    one = daemon(tmp_path / "map.pcd")
    file = town.scans / "scan_0002.npz"
    scan = read_scan(file)
    with PoseInitializer(one.endpoint, InitializerRules(map_radius=60.0, height=1.8)) as initializer:
        for rough_z, found_z in ((z, z), (z + 8.0, z + 8.0), (z - 2.0, z), (z + 10.5, z + 8.0)):
            found = initializer.initialize(scan, RoughPose(x + 1.0, y - 1.0, rough_z, yaw=yaw + 0.08))
            np.testing.assert_allclose(found.T_map_base[:3, 3], [x, y, found_z], atol=0.1)
            assert found.reliable
            np.testing.assert_allclose(found.grounds, [z - 1.8, z + 6.2], atol=0.1)
        for unclear in (None, z + 4.0, z + 500.0):
            found = initializer.initialize(scan, RoughPose(x + 1.0, y - 1.0, unclear, yaw=yaw + 0.08))
            assert not found.reliable
            assert found.failed_limits == ("level",)
            low, high = found.grounds
            assert found.level_doubt == f"two grounds, {low:.1f} and {high:.1f} m: the scan fits both"
            poses = [found.T_map_base, *(one.T_map_base for one in found.alternatives)]
            assert {round(float(T[2, 3] - z)) for T in poses} == {0, 8}
    program = ["--endpoint", one.endpoint, "--scan", str(file), "--height", "1.8", "--map-radius", "60"]
    done = pose_init(*program, "--pose", f"{x + 1},{y - 1},{yaw}", "--pose-format", "xyyaw")
    assert done.returncode == 1, done.stderr
    assert f"NOT reliable (two grounds, {low:.1f} and {high:.1f} m: the scan fits both)" in done.stdout
    done = pose_init(*program, "--pose", f"{x + 1},{y - 1},{z + 8.0},0,0,{yaw}", "--json")
    document = json.loads(done.stdout)
    assert (done.returncode, document["failed_limits"], document["level_doubt"]) == (0, [], None)
    assert document["T_map_base"][2][3] == pytest.approx(z + 8.0, abs=0.1)
    assert document["grounds"] == pytest.approx([low, high])


@pytest.mark.parametrize(
    ("part", "failed"),
    [
        ("one point", "points"),
        ("twenty points", "points"),
        ("all in one place", "spread"),
        ("within 6 m", "distance"),
        ("a sector of 10 degrees", "angle"),
        ("the ground", "sharpness"),
    ],
)
def test_a_pose_that_rests_on_little_is_not_reliable(
    initializer: PoseInitializer, town: TownDrive, part: str, failed: str
) -> None:
    scan = read_scan(town.scans / "scan_0002.npz")
    heading = np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))
    chosen = {
        "one point": scan[:1],
        "twenty points": scan[:: len(scan) // 20],
        "all in one place": np.repeat(scan[:1], 500, axis=0),
        "within 6 m": scan[np.linalg.norm(scan, axis=1) < 6.0],
        "a sector of 10 degrees": scan[np.abs(heading) < 5.0],
        "the ground": scan[(np.abs(scan[:, 2] + 1.8) < 0.1) & (np.linalg.norm(scan, axis=1) < 15.0)],
    }[part]
    found = initializer.initialize(chosen, rough(town, 2, 0))
    assert not found.reliable
    assert failed in found.result.failed_limits, (found.result.failed_limits, found.result.evidence)


def test_a_place_without_map_is_no_answer(town: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(town.map_dir)
    with PoseInitializer(one.endpoint, InitializerRules(map_radius=60.0, wait_s=5.0)) as initializer:
        scan = read_scan(town.scans / "scan_0000.npz")
        for x in (5000.0, 9e7):
            with pytest.raises(NoMapHere, match=r"no map within 60 m .* the map spans x .* the pose is at"):
                initializer.initialize(scan, RoughPose(x, 0.0))


def pose_init(*words: str) -> subprocess.CompletedProcess[str]:
    return run_verb(words, module="shmmap_clients.pose_initializer")


def test_the_program_away_from_the_map_says_where_it_is(town: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(town.map_dir)
    program = ["--endpoint", one.endpoint]
    words = ["--scan", str(town.scans / "scan_0002.npz"), "--pose", "5000,0,0,0,0,0", "--json"]
    done = pose_init(*program, *words)
    assert done.returncode == 1
    assert re.fullmatch(
        r"shmmap-pose-init: no map within 150 m of the rough pose: the map spans x \S+ .. \S+ m,"
        r" y \S+ .. \S+ m, the pose is at \(5000.000, 0.000\)\n",
        done.stderr,
    )
    document = json.loads(done.stdout)
    assert document["no_map"]
    assert document["T_map_base"] is None
    assert not document["reliable"]
    allowed = pose_init(*program, *words, "--allow-empty")
    assert (allowed.returncode, allowed.stderr) == (0, done.stderr)


def test_the_program(town: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(town.map_dir)
    x, y, z, _, _, yaw = town.poses[2]
    program = ["--endpoint", one.endpoint, "--shm-dir", one.shm_dir]
    words = [
        "--scan",
        str(town.scans / "scan_0002.npz"),
        "--pose",
        f"{x + 1},{y - 1},0,0,0,{yaw}",
        "--height",
        "1.8",
    ]
    done = pose_init(*program, *words, "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    np.testing.assert_allclose(np.array(document["T_map_base"])[:3, 3], [x, y, z], atol=0.3)
    assert document["reliable"] is True
    done = pose_init(*program, *words)
    assert ": reliable" in done.stdout
    flat = [*words[:3], f"{x + 1},{y - 1},{yaw}", *words[4:], "--pose-format", "xyyaw"]
    again = pose_init(*program, *flat)
    # the first is the pose as --pose-format says, the last has times
    assert again.stdout.splitlines()[1:-1] == done.stdout.splitlines()[1:-1]
    assert again.stdout.splitlines()[0].count(",") == 2
    points = read_scan(town.scans / "scan_0002.npz")
    np.savez(tmp_path / "near.npz", xyz=points[np.linalg.norm(points, axis=1) < 6.0])
    near = [*program, "--scan", str(tmp_path / "near.npz"), *words[2:]]
    done = pose_init(*near, "--json")
    assert done.returncode == 1, done.stderr
    document = json.loads(done.stdout)
    assert not document["reliable"]
    assert "distance" in document["failed_limits"]
    done = pose_init(*near)
    assert re.search(r"NOT reliable \(.*fewer than 20 points beyond 10 m", done.stdout)
    missing = [*program, "--scan", str(tmp_path / "none.npz"), "--pose", "0,0,0,0,0,0"]
    assert pose_init(*missing).returncode == 66
    assert pose_init(*program, "--scan", "x").returncode == 2
