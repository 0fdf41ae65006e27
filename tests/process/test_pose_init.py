# SPDX-License-Identifier: Apache-2.0
"""Initial poses with a real daemon: found, repeated without loading, and as a program."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.map_extent import NoMapHere
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
from shmmap_clients.scans.scan_file import read_scan

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.town_drive import TownDrive, make_town_drive


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    return make_town_drive(tmp_path_factory.mktemp("town"), blocks=(3, 3), density=5.0, frames=5, step=15.0)


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
    deep = np.column_stack([rng.uniform(-edge / 2, edge / 2, (200, 2)) + (x, y), np.full(200, z - 5.0)])
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
    assert found.reliable
    np.testing.assert_allclose(found.T_map_base[:3, 3], [x, y, z], atol=0.3)
    assert found.ground_z == pytest.approx(z - 1.8, abs=0.1)


def test_a_place_without_map_is_no_answer(town: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(town.map_dir)
    with PoseInitializer(one.endpoint, InitializerRules(map_radius=60.0, wait_s=5.0)) as initializer:
        scan = read_scan(town.scans / "scan_0000.npz")
        for x in (5000.0, 9e7):
            with pytest.raises(NoMapHere, match=r"no map within 60 m .* the map spans x .* the pose is at"):
                initializer.initialize(scan, RoughPose(x, 0.0))


def test_the_program_away_from_the_map_says_where_it_is(town: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(town.map_dir)
    program = [sys.executable, "-m", "shmmap_clients.pose_initializer", "--endpoint", one.endpoint]
    words = ["--scan", str(town.scans / "scan_0002.npz"), "--pose", "5000,0,0,0,0,0", "--json"]
    done = subprocess.run([*program, *words], capture_output=True, text=True)
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
    allowed = subprocess.run([*program, *words, "--allow-empty"], capture_output=True, text=True)
    assert (allowed.returncode, allowed.stderr) == (0, done.stderr)


def test_the_program(town: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(town.map_dir)
    x, y, z, _, _, yaw = town.poses[2]
    program = [sys.executable, "-m", "shmmap_clients.pose_initializer"]
    program += ["--endpoint", one.endpoint, "--shm-dir", one.shm_dir]
    words = [
        "--scan",
        str(town.scans / "scan_0002.npz"),
        "--pose",
        f"{x + 1},{y - 1},0,0,0,{yaw}",
        "--height",
        "1.8",
    ]
    done = subprocess.run([*program, *words, "--json"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    np.testing.assert_allclose(np.array(document["T_map_base"])[:3, 3], [x, y, z], atol=0.3)
    assert document["reliable"] is True
    done = subprocess.run([*program, *words], capture_output=True, text=True)
    assert ": reliable" in done.stdout
    flat = [*words[:3], f"{x + 1},{y - 1},{yaw}", *words[4:], "--pose-format", "xyyaw"]
    again = subprocess.run([*program, *flat], capture_output=True, text=True)
    # the first is the pose as --pose-format says, the last has times
    assert again.stdout.splitlines()[1:-1] == done.stdout.splitlines()[1:-1]
    assert again.stdout.splitlines()[0].count(",") == 2
    missing = [*program, "--scan", str(tmp_path / "none.npz"), "--pose", "0,0,0,0,0,0"]
    assert subprocess.run(missing, capture_output=True).returncode == 66
    assert subprocess.run([*program, "--scan", "x"], capture_output=True).returncode == 2
