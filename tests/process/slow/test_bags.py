# SPDX-License-Identifier: Apache-2.0
"""Programs on bags give what they give on the same scans in files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import pose_errors
from shmmap_clients.scans.trajectory import matrix_of, read_trajectory

import shmmap
from tests.process.conftest import DaemonFactory
from tests.support.forked_programs import run_verb
from tests.support.live_drive import drive as live_drive
from tests.support.live_reference import LiveDaemon, held, reference
from tests.support.ndt_programs import TownDrive, make_town_drive
from tests.support.pages import read_page, reader_with_programs

pytest.importorskip("rosbags", reason="rosbags is not installed")

from tests.support import bags
from tests.support.bags import LAYOUTS, MCAP, SQLITE, cloud, write_bag

FRAMES: Final = 60
MOUNTED: Final = matrix_of((0.9, -0.1, 1.7), (0.01, -0.02, 0.6, 0.8))  # T_base_link_lidar
# the drive is 72 m long: the first map is the last
WINDOW: Final = ["--map-radius", "200", "--lidar-radius", "80", "--update-distance", "100", "--thin", "0.5"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    folder = tmp_path_factory.mktemp("drive")
    made = make_town_drive(folder, blocks=(3, 3), density=5.0, frames=FRAMES, step=1.2)
    for path in made.scans.iterdir():
        np.savez(path, xyz=np.load(path)["xyz"].astype(np.float32))
    return made


def scans_of(drive: TownDrive) -> list[NDArray[np.float32]]:
    return [np.load(path)["xyz"] for path in sorted(drive.scans.iterdir())]


def numbers_of(truth: Path) -> NDArray[np.float64]:
    """The numbers of a TUM file, as they are written."""
    return np.loadtxt(truth)


def ns(number: int) -> int:
    return number * 10**8


def follow(endpoint: str, shm_dir: str, folder: Path, *words: str) -> list[dict[str, Any]]:
    """Localize, and return what is written of each scan."""
    given = ["follow", "--endpoint", endpoint, "--shm-dir", shm_dir, *WINDOW, *words]
    done = run_verb([*given, "--json-lines", f"{folder}/lines"], module="shmmap_clients.ndt_scan_matcher")
    assert done.returncode == 0, done.stderr + done.stdout
    return [json.loads(line) for line in (folder / "lines").read_text().splitlines()]


SAME: Final = ("stamp_s", "pose", "iterations", "transform_probability", "nvtl", "error_m", "error_deg")


def test_poses_are_those_of_files(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(drive.map_dir)
    truth = ["--truth", str(drive.truth)]
    expected = follow(one.endpoint, one.shm_dir, tmp_path, "--scans", str(drive.scans), *truth)
    assert len(expected) == FRAMES
    scans, numbers = scans_of(drive), numbers_of(drive.truth)
    for plugin in (SQLITE, MCAP):
        for name in ("float32", "padded", "doubles"):
            entries = [
                ("/points", ns(n), cloud(xyz, ns(n), layout=LAYOUTS[name])) for n, xyz in enumerate(scans)
            ]
            entries += [("/pose", ns(n), bags.odometry(row[1:], ns(n))) for n, row in enumerate(numbers)]
            bag = write_bag(tmp_path / f"{plugin.name}_{name}", entries, plugin)
            found = follow(one.endpoint, one.shm_dir, tmp_path, "--scans", str(bag))
            assert len(found) == FRAMES
            for other, line in zip(expected, found, strict=True):
                if name == "doubles":  # sums of cubes are those of doubles, not of floats
                    np.testing.assert_allclose(line["pose"], other["pose"], atol=1e-4)
                else:
                    assert [line[key] for key in SAME] == [other[key] for key in SAME]
    again = follow(one.endpoint, one.shm_dir, tmp_path, "--scans", str(bag), *truth)
    assert [line["pose"] for line in again] == [line["pose"] for line in found], "from the file and the topic"


def test_a_scanner_on_a_vehicle(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    """Scans in the scanner's frame, what is true of the vehicle's, odometry of that in a frame of its own."""
    one = daemon(drive.map_dir)
    T_map_base = read_trajectory(drive.truth).T_map_sensor @ np.linalg.inv(MOUNTED)
    start = np.linalg.inv(T_map_base[0])
    entries = [("/tf_static", 0, bags.transforms(("base_link", "lidar", MOUNTED)))]
    for n, (xyz, T) in enumerate(zip(scans_of(drive), T_map_base, strict=True)):
        entries.append(("/odom", ns(n), bags.odometry(start @ T, ns(n), "odom")))
        edge = bags.transforms(("map", "base_link", T), stamp_ns=ns(n))
        entries += [("/tf", ns(n), edge), ("/points", ns(n), cloud(xyz, ns(n), "lidar"))]
    bag = write_bag(tmp_path / "bag", entries, MCAP)
    found = follow(one.endpoint, one.shm_dir, tmp_path, "--scans", str(bag), "--odometry", "/odom")
    poses = np.array([matrix_of(line["pose"][:3], line["pose"][3:]) for line in found])
    metres, degrees = pose_errors(poses, T_map_base)
    assert metres.max() < 0.2
    assert degrees.max() < 0.5


def test_the_first_pose(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(drive.map_dir)
    entries = [("/points", ns(n), cloud(xyz, ns(n))) for n, xyz in enumerate(scans_of(drive)[:12])]
    bag = write_bag(tmp_path / "bag", entries)
    x, y, _, _, _, yaw = drive.poses[11]
    words = [
        "--endpoint",
        one.endpoint,
        "--shm-dir",
        one.shm_dir,
        "--pose",
        f"{x + 1},{y - 1},0,0,0,{yaw + 0.05}",
    ]
    words += ["--height", "1.8", "--map-radius", "60", "--json", "--scan"]
    found = [
        json.loads(run_verb([*words, scan], module="shmmap_clients.pose_initializer").stdout)
        for scan in (str(drive.scans / "scan_0011.npz"), f"{bag}@1.1")
    ]
    assert found[0]["reliable"]
    assert found[0]["T_map_base"] == found[1]["T_map_base"]


def test_what_is_not_in_the_map(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    one = daemon(drive.map_dir)
    numbers = numbers_of(drive.truth)
    entries = [("/points", ns(n), cloud(xyz, ns(n))) for n, xyz in enumerate(scans_of(drive))]
    entries += [("/pose", ns(n), bags.odometry(row[1:], ns(n))) for n, row in enumerate(numbers)]
    bag = write_bag(tmp_path / "bag", entries, MCAP)
    words = ["follow", "--endpoint", one.endpoint, "--shm-dir", one.shm_dir, "--mode", "distance", "--quiet"]
    lines: list[list[dict[str, Any]]] = []
    for given in (["--scans", str(drive.scans), "--poses", str(drive.truth)], ["--scans", str(bag)]):
        written = ["--json-lines", "-", "--out", f"{tmp_path}/kept{len(lines)}"]
        done = run_verb([*words, *given, *written], module="shmmap_clients.compare_map_filter")
        assert done.returncode == 0, done.stderr
        lines.append([json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")])
    same = ("stamp_s", "points", "kept", "no_map", "missing")
    assert [[line[key] for key in same] for line in lines[0]] == [
        [line[key] for key in same] for line in lines[1]
    ]
    assert len(lines[1]) == FRAMES
    names = [f"{line['name']}.pcd" for line in lines[1]]
    assert sorted(path.name for path in (tmp_path / "kept1").iterdir()) == names


def test_a_live_map(live_daemon: LiveDaemon, tmp_path: Path) -> None:
    """Rays begin at the scanner, not where the vehicle's frame is."""
    one = live_daemon()
    entries = [("/tf_static", 0, bags.transforms(("base_link", "lidar", MOUNTED)))]
    scans = []
    for n, (points, T) in enumerate(live_drive(6)):
        T[:3, 3] += 0.07  # away from the border of a voxel
        entries.append(("/points", ns(n), cloud(points, ns(n), "lidar")))
        entries.append(("/pose", ns(n), bags.odometry(T @ np.linalg.inv(MOUNTED), ns(n), "odom")))
        scans.append((points.astype(np.float32).astype(np.float64), T))
    bag = write_bag(tmp_path / "bag", entries)
    words = ["run", "--live", "lidar", "--endpoint", one.endpoint, "--scans", str(bag), "--poses", "/pose"]
    words += ["--min-range", "0.2", "--max-range", "9", "--min-z", "-5", "--max-z", "5"]  # of the reference
    done = run_verb(words, module="shmmap_clients.rolling_map")
    assert done.returncode == 0, done.stderr
    with shmmap.connect(one.endpoint) as client:
        assert held(client.live("lidar"), "disk") == reference(scans)
    refused = run_verb([*words, "--resume"], module="shmmap_clients.rolling_map")
    assert refused.returncode == 2
    assert "--resume is for a directory of scans" in refused.stderr


def test_the_page_s_commands(drive: TownDrive, daemon: DaemonFactory, tmp_path: Path) -> None:
    """A pose of this drive stands for the page's."""
    one = daemon(drive.map_dir)
    stamps = [n * 25 * 10**7 for n in range(FRAMES)]
    numbers = numbers_of(drive.truth)
    entries = [("/lidar", at, cloud(xyz, at)) for at, xyz in zip(stamps, scans_of(drive), strict=True)]
    entries += [
        ("/localization/kinematic_state", at, bags.odometry(row[1:], at))
        for at, row in zip(stamps, numbers, strict=True)
    ]
    write_bag(tmp_path / "drive", entries)
    follow, pose_init, compare = read_page("clients/README.md").commands("bags")
    x, y, _, _, _, yaw = drive.poses[50]  # after 12.5 s
    with reader_with_programs(tmp_path, SHMMAP_ENDPOINT=one.endpoint, SHMMAP_SHM_DIR=one.shm_dir) as reader:
        user = reader.terminal()
        user.run(follow)
        followed = read_trajectory(tmp_path / "poses.txt").T_map_sensor
        assert pose_errors(followed, read_trajectory(drive.truth).T_map_sensor)[0].max() < 0.2
        user.run(pose_init.replace("17,77,0,0,0,0.1", f"{x + 1},{y - 1},0,0,0,{yaw + 0.05}"))
        assert user.run(compare)
