# SPDX-License-Identifier: Apache-2.0
"""Localization with a real daemon: a drive whose window moves, and many clients on one map."""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, VoxelMap, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveStatistics, pose_errors
from shmmap_clients.ndt_scan_matcher.drive.follower import Follower
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
from shmmap_clients.scans.scan_sequence import ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory

import shmmap
from shmmap.protocol.events import Evicted, Loaded
from shmmap.statistics.reader import StatisticsReader
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import Deadline, stop
from tests.support.forked_programs import run_verb
from tests.support.ndt_programs import PERIOD_S, TownDrive, make_town_drive, to_and_fro, town_drive_once

PROGRAM = [sys.executable, "-m", "shmmap_clients.ndt_scan_matcher"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    return town_drive_once(tmp_path_factory, blocks=(3, 3), density=5.0, frames=36, step=2.0)


def test_a_drive_whose_window_moves(drive: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(drive.map_dir)
    rules = MapRules(update_distance=10.0, map_radius=60.0, lidar_radius=40.0)
    statistics = DriveStatistics()
    with (
        NdtMatcher(Settings(mode="coarse_fine")) as matcher,
        MapUpdater(one.endpoint, rules, prepare=matcher.prepare) as maps,
    ):
        follower = Follower(matcher, maps, ConstantVelocity(matrix_from_pose(drive.poses[0])), thin=0.5)
        for scan in ScanSequence(drive.scans, read_trajectory(drive.truth)):
            statistics.add(follower.follow(scan))
            assert maps.wait_until_current(60.0)  # a drive at full speed would outrun the map
        assert maps.error is None
    summary = statistics.summary(maps.statistics, maps.too_slow, matcher.trust)
    assert summary.frames == summary.converged == summary.trustworthy == 36
    assert summary.too_slow == 0
    assert summary.waited == 1  # the first: there was no map before
    assert summary.map_updates >= 3
    assert summary.cells_removed > 0
    assert summary.errors is not None
    assert summary.errors.ate_m.max < 0.15
    assert summary.errors.ate_deg.max < 0.5
    assert summary.nvtl.p50 > 2.3


def test_the_program_follows_a_directory(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(drive.map_dir)
    words = ["follow", "--endpoint", one.endpoint, "--shm-dir", one.shm_dir]
    words += ["--scans", str(drive.scans), "--truth", str(drive.truth)]
    # the drive is 72 m long: no map is outrun, however fast
    words += ["--update-distance", "20", "--map-radius", "200", "--lidar-radius", "100", "--thin", "0.5"]
    words += ["--steady", "--odometry", str(drive.truth), "--tum", str(tmp_path / "out.tum")]
    address = f"ipc://{tmp_path}/poses"
    words += ["--plot", str(tmp_path / "out.svg"), "--publish", address, "--listener-wait", "60", "--json"]
    words += ["--json-lines", str(tmp_path / "out.jsonl"), "--route", str(drive.truth)]
    listener = subprocess.Popen(
        [sys.executable, "-m", "tests.support.ndt_programs", "listen", address, "36"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        done = run_verb(words, module=PROGRAM[-1])
        assert done.returncode == 0, done.stderr + done.stdout
        received = json.loads(listener.communicate(timeout=60.0)[0])
    finally:
        listener.kill()
        listener.wait()
    summary = json.loads(done.stdout)
    assert summary["frames"] == summary["trustworthy"] == 36
    assert summary["errors"]["ate_m"]["max"] < 0.2
    assert summary["errors"]["rte"]["10.0"] < 2.0
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [line["name"] for line in lines] == [path.stem for path in sorted(drive.scans.glob("*.npz"))]
    assert max(line["error_m"] for line in lines) == pytest.approx(summary["errors"]["ate_m"]["max"])
    squares = np.array([line["error_m"] for line in lines]) ** 2
    assert np.sqrt(squares.mean()) == pytest.approx(summary["errors"]["ate_rmse_m"])
    assert max(line["error_deg"] for line in lines) == pytest.approx(summary["errors"]["ate_deg"]["max"])
    written = read_trajectory(tmp_path / "out.tum")
    assert len(written) == 36
    np.testing.assert_allclose(
        [line["pose"][:3] for line in lines], written.T_map_sensor[:, :3, 3], atol=1e-8
    )
    picture = ElementTree.parse(tmp_path / "out.svg").getroot()
    assert picture.find(".//{*}image") is not None, "the map lies under the path"
    assert {"map: ground", "walls", "poses"} <= {
        text.text for text in picture.iter("{http://www.w3.org/2000/svg}text")
    }
    # the listener has every pose, in order
    assert [pose["name"] for pose in received] == [path.stem for path in sorted(drive.scans.glob("*.npz"))]
    assert all(pose["shmmap_pose"] == 1 and pose["trustworthy"] for pose in received)
    np.testing.assert_allclose([pose["stamp_s"] for pose in received], written.stamps_s)
    poses = np.array([pose["T"] for pose in received]).reshape(-1, 4, 4)
    np.testing.assert_allclose(poses, written.T_map_sensor, atol=1e-5)


def test_scans_and_odometry_come_from_another_process(
    drive: TownDrive, daemon: DaemonFactory, tmp_path: Path
) -> None:
    one = daemon(drive.map_dir)
    scans, odometry, poses = (f"ipc://{tmp_path}/{name}" for name in ("scans", "odometry", "poses"))
    words = ["follow", "--endpoint", one.endpoint, "--scans", scans, "--thin", "0.5"]
    words += ["--odometry", odometry, "--odometry-wait", "60", "--publish", poses, "--listener-wait", "60"]
    words += ["--init", ",".join(repr(float(value)) for value in drive.poses[0])]
    words += ["--map-radius", "200", "--tum", str(tmp_path / "out.tum"), "--json"]
    sender = subprocess.Popen(
        [
            *(sys.executable, "-m", "tests.support.ndt_programs", "send"),
            *(drive.scans, drive.truth, scans, odometry, poses),
        ]
    )
    try:
        done = run_verb(words, module=PROGRAM[-1])
        assert done.returncode == 0, done.stderr + done.stdout
        assert sender.wait(60.0) == 0
    finally:
        sender.kill()
        sender.wait()
    assert json.loads(done.stdout)["trustworthy"] == 36
    found = read_trajectory(tmp_path / "out.tum")
    np.testing.assert_allclose(found.stamps_s, PERIOD_S * np.arange(36))
    true = np.array([matrix_from_pose(drive.poses[index]) for index in to_and_fro(36)])
    metres, degrees = pose_errors(found.T_map_sensor, true)
    assert metres.max() < 0.2
    assert degrees.max() < 0.5


def has_waited(maps: MapUpdater) -> bool:
    """Whether the last map was waited for; a function, as type checkers take an attribute to be constant."""
    return maps.waited


def test_a_map_that_cannot_keep_up_is_an_error(drive: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(drive.map_dir)
    rules = MapRules(update_distance=5.0, map_radius=50.0, lidar_radius=45.0)
    x, y = drive.poses[0, :2]
    with MapUpdater(one.endpoint, rules) as maps:
        first = maps.map_at(x, y)
        assert has_waited(maps)
        same = maps.map_at(x + 4.0, y)
        assert same is first
        assert not has_waited(maps)
        assert maps.too_slow == 0
        # a jump beyond what the map reaches: waited for, and logged
        other = maps.map_at(x + 40.0, y + 40.0)
        assert has_waited(maps)
        assert maps.too_slow == 1
        assert other.cells.keys() != first.cells.keys()
        # where the pose itself was corrected the map is not to blame
        back = maps.map_at(x, y, jumped=True)
        assert has_waited(maps)
        assert maps.too_slow == 1
        assert back.cells.keys() == first.cells.keys()
    assert first.voxels > 0  # what was taken stays readable


def test_a_map_that_cannot_be_made_is_an_error_and_not_the_end(
    drive: TownDrive, daemon: DaemonFactory
) -> None:
    one = daemon(drive.map_dir)
    rules = MapRules(update_distance=5.0, map_radius=60.0, lidar_radius=40.0)
    x, y = drive.poses[0, :2]
    impossible = {1, 3}
    made = 0

    def prepare(voxel_map: VoxelMap) -> VoxelMap:
        nonlocal made
        made += 1
        if made in impossible:
            raise shmmap.BadRequest("the cells span too much")
        return voxel_map

    with MapUpdater(one.endpoint, rules, prepare=prepare) as maps:
        with pytest.raises(shmmap.BadRequest, match="span too much"):
            maps.map_at(x, y)
        first = maps.map_at(x, y)
        assert has_waited(maps)
        far = (x + 50.0, y + 50.0)  # waited for until the second attempt has succeeded
        other = maps.map_at(*far)
        assert has_waited(maps)
        assert other.cells.keys() != first.cells.keys()
        assert made == 4
        assert maps.error is None


def test_a_map_that_is_long_in_coming_is_waited_for(drive: TownDrive, daemon: DaemonFactory) -> None:
    """As where kernels are compiled for it, on a slow machine: the daemon says that it loads."""
    one = daemon(drive.map_dir)
    rules = MapRules(update_distance=5.0, map_radius=60.0, lidar_radius=40.0, wait_s=2.0)
    parent = one.loaders_parent()
    stop(parent)
    stopped = [parent, *one.stop_loaders()]
    waiting = Deadline()
    with (
        closing(StatisticsReader(one.instance, one.shm_dir)) as statistics,
        MapUpdater(one.endpoint, rules) as maps,
        ThreadPoolExecutor(1) as thread,
    ):
        asked = thread.submit(maps.map_at, *drive.poses[0, :2])
        while waiting(statistics.snapshot().counters["requests"] < 6):  # each may take 0.5 s
            pass
        assert not asked.done()
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
        assert asked.result().voxels > 0
        assert has_waited(maps)


@pytest.mark.parametrize(("route", "ahead_m"), [(((25.0, 125.0), (215.0, 125.0)), 105.0), ((), 45.0)])
def test_the_daemon_fetches_what_lies_ahead(
    drive: TownDrive, daemon: DaemonFactory, route: tuple[tuple[float, float], ...], ahead_m: float
) -> None:
    """Far along a route, a short distance without one; also while the vehicle's map is only kept current."""
    one = daemon(drive.map_dir)
    rules = MapRules(update_distance=10.0, map_radius=30.0, lidar_radius=15.0)
    x, y = 25.0, 125.0
    with (
        shmmap.connect(one.endpoint) as client,
        shmmap.events.EventStream(one.endpoint) as stream,
        closing(StatisticsReader(one.instance, one.shm_dir)) as statistics,
        MapUpdater(one.endpoint, rules, route=route) as maps,
    ):
        (cell,) = client.metadata(shmmap.Circle(x + ahead_m, y, 1.0))

        def until(kind: type[Loaded] | type[Evicted]) -> None:
            """Wait until that happens to the cell."""
            while True:
                event = stream.next(60.0)
                assert event is not None
                if isinstance(event, kind) and Path(event.id).name == Path(cell.id).name:
                    return

        maps.map_at(x, y, vx=5.0)
        until(Loaded)
        before, waiting = statistics.snapshot().counters["requests"], Deadline()
        while waiting(statistics.snapshot().counters["requests"] < before + 4):  # one a second
            pass
        client.evict(cell.id)
        until(Evicted)
        until(Loaded)


@pytest.mark.parametrize(("name", "code"), [("none.csv", 66), ("empty.csv", 65)])
def test_a_route_that_cannot_be_read(drive: TownDrive, tmp_path: Path, name: str, code: int) -> None:
    (tmp_path / "empty.csv").touch()
    words = [
        "follow",
        "--scans",
        str(drive.scans),
        "--truth",
        str(drive.truth),
        "--route",
        str(tmp_path / name),
    ]
    done = run_verb(words, module=PROGRAM[-1])
    assert done.returncode == code, done.stderr
    assert name in done.stderr


def test_rules_that_make_no_sense_are_refused() -> None:
    with pytest.raises(shmmap.BadRequest, match="cannot keep"):
        MapRules(update_distance=20.0, map_radius=100.0, lidar_radius=90.0)


def test_without_a_daemon_the_program_says_so(drive: TownDrive, tmp_path: Path) -> None:
    words = ["follow", "--endpoint", str(tmp_path / "none.sock"), "--scans", str(drive.scans)]
    done = run_verb([*words, "--truth", str(drive.truth)], module=PROGRAM[-1])
    assert done.returncode == 69
    assert "shmmap-ndt:" in done.stderr
    nowhere = run_verb(words, module=PROGRAM[-1])
    assert nowhere.returncode == 2
    assert nowhere.stderr.startswith("shmmap-ndt: no start pose: give --init, --rough or --truth")


def test_many_clients_share_one_map(daemon: DaemonFactory, tmp_path: Path) -> None:
    town = make_town_drive(tmp_path, blocks=(4, 4), density=4.0, frames=8, step=12.0)
    one = daemon(town.map_dir)
    localize = [sys.executable, "-m", "tests.support.ndt_programs", "localize"]
    clients = []
    for number, pose in enumerate(town.poses):
        guess = pose + np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.02])
        words = ",".join(repr(float(value)) for value in guess)
        scan = str(town.scans / f"scan_{number:04}.npz")
        clients.append(
            (
                words,
                scan,
                subprocess.Popen(
                    [*localize, one.endpoint, scan, words, "1000"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                ),
            )
        )
    found = []
    for _, _, client in clients:
        assert client.stdout is not None
        assert client.stdout.readline().strip() == "ready"
    for _, _, client in clients:
        assert client.stdin is not None
        client.stdin.write("go\n")
        client.stdin.flush()
    for _, _, client in clients:
        assert client.stdout is not None
        found.append(json.loads(client.stdout.readline()))
    with shmmap.connect(one.endpoint) as session:
        loads = session.stats().counters["loads_finished"]
    for _, _, client in clients:
        client.communicate()
        assert client.returncode == 0
    np.savez(tmp_path / "whole.npz", xyz=town.points)
    for seen in found:
        assert seen["cells"] == 256
        assert seen["converged"]
        assert seen["not_shared"] == []
    # of one process in ten it is some megabytes more
    assert statistics.median(seen["growth_bytes"] for seen in found) <= 8 << 20
    assert loads == 256  # one per cell and layer, not per client
    words, scan, _ = clients[0]
    align = ["align", "--map", str(tmp_path / "whole.npz"), "--scan", scan, "--guess", words, "--json"]
    alone = json.loads(run_verb(align, module=PROGRAM[-1]).stdout)
    np.testing.assert_allclose(found[0]["T_map_base"], alone["T_map_base"], atol=1e-6)
    assert found[0]["iterations"] == alone["iterations"]
    assert found[0]["voxels"] == alone["voxels"]
