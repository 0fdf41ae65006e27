# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow`` of a vehicle that is elsewhere, and of clocks that jump, stand or run back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import pose_errors
from shmmap_clients.ndt_scan_matcher.drive.follower import Follower
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, Relocalizer
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory, tum_line

import shmmap
from shmmap.dividing.map_writer import MapWriter
from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess
from tests.support.forked_programs import run_verb
from tests.support.ndt_programs import TownDrive, make_town_drive

BEFORE, GONE, FRAMES = 7, 6, 20
KEPT = [*range(BEFORE), *range(BEFORE + GONE, FRAMES)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> TownDrive:
    """A drive from which six scans in the middle are missing: 14 m that no odometry has noticed."""
    made = make_town_drive(
        tmp_path_factory.mktemp("drive"), blocks=(3, 3), density=5.0, frames=FRAMES, step=2.0
    )
    for number in range(BEFORE, BEFORE + GONE):
        (made.scans / f"scan_{number:04}.npz").unlink()
    return made


@pytest.fixture
def odometry(drive: TownDrive, tmp_path: Path) -> Path:
    """What wheels would say: from each scan as far as the step before it, also where it was carried away."""
    truth = [matrix_from_pose(pose) for pose in drive.poses]
    T, lines = np.eye(4), [tum_line(0.0, np.eye(4))]
    for number in KEPT[1:]:
        T = T @ np.linalg.inv(truth[number - 1]) @ truth[number]
        lines.append(tum_line(0.1 * number, T))
    (tmp_path / "odometry.txt").write_text("\n".join(lines) + "\n")
    return tmp_path / "odometry.txt"


def follow(one: DaemonProcess, drive: TownDrive, *words: str) -> tuple[int, str, list[dict[str, Any]]]:
    """Run the program; returns exit code, stderr, and its JSON lines, the summary last."""
    base = ["--endpoint", one.endpoint, "--scans", str(drive.scans), "--truth", str(drive.truth)]
    base += ["--thin", "0.5", "--map-radius", "200", "--steady", "--json-lines", "-", "--json"]
    done = run_verb(["follow", *base, *words], module="shmmap_clients.ndt_scan_matcher")
    return done.returncode, done.stderr, [json.loads(line) for line in done.stdout.splitlines()]


def test_a_kidnapped_vehicle_is_lost_and_found(
    drive: TownDrive, daemon: DaemonFactory, odometry: Path
) -> None:
    one = daemon(drive.map_dir)
    # in this town right poses score 3.3, and wrong ones in another part of the street 2.6
    words = ["--odometry", str(odometry), "--lost-after", "2", "--trust-nvtl", "3.0"]
    code, said, lines = follow(one, drive, *words, "--no-relocalize")
    frames, summary = lines[:-1], lines[-1]
    after = frames[BEFORE:]
    assert code == 1
    assert [frame["state"] for frame in frames[: BEFORE + 2]] == ["tracking"] * BEFORE + ["uncertain", "lost"]
    assert {frame["state"] for frame in after[1:]} == {"lost"}
    assert min(frame["error_m"] for frame in after) > 5.0
    assert summary["lost"] == len(after) - 1
    assert summary["failed_limits"]["nvtl"] == len(after)
    assert summary["trust"]["nvtl"] == 3.0
    assert summary["relocalized"] == 0
    assert f"shmmap-ndt: lost at scan scan_{KEPT[BEFORE + 1]:04}: " in said

    code, said, lines = follow(one, drive, *words)  # over files this is the default
    frames, summary = lines[:-1], lines[-1]
    found = [number for number, frame in enumerate(frames) if frame["relocalized"]]
    assert code == 1, "scans in between were not trusted"
    assert summary["relocalized"] == len(found) == 1
    assert found[0] < len(frames) - 1
    assert all(frame["state"] == "tracking" for frame in frames[found[0] :])
    assert max(frame["error_m"] for frame in frames[found[0] :]) < 0.2
    assert summary["too_slow"] == 0, "a jump is no map that does not keep up"
    assert f"shmmap-ndt: relocalized at scan {frames[found[0]]['name']}: (" in said


def test_a_rough_start_pose_is_enough(drive: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(drive.map_dir)
    x, y, z, _, _, yaw = drive.poses[0]
    rough = f"{x + 4.0},{y - 3.0},{z},0,0,{yaw + 0.15}"
    code, _, lines = follow(
        one, drive, "--rough", rough, "--sigma", "4", "--odometry", str(drive.truth), "--trust-nvtl", "3.0"
    )
    assert code == 0
    assert lines[0]["relocalized"]
    assert max(frame["error_m"] for frame in lines[:-1]) < 0.2


def test_without_a_map_every_result_says_so(drive: TownDrive, daemon: DaemonFactory) -> None:
    one = daemon(drive.map_dir)
    code, said, lines = follow(one, drive, "--init", "5000,7,0,0,0,0", "--relocalize")
    frames, summary = lines[:-1], lines[-1]
    assert code == 1
    assert all(frame["no_map"] and frame["failed_limits"] == ["no_map"] for frame in frames)
    assert {frame["state"] for frame in frames} == {"lost"}
    assert (summary["no_map"], summary["trustworthy"]) == (len(KEPT), 0)
    warnings = [line for line in said.splitlines() if "no map at scan" in line]
    assert len(warnings) == 1, "once"
    assert "the map spans x " in warnings[0]
    assert "the pose is at (5000.000, 7.000)" in warnings[0]
    code, _, _ = follow(one, drive, "--init", "5000,7,0,0,0,0", "--allow-empty")
    assert code == 0


# --- scans of a real street whose clock jumps, stands or runs back: each is found where it was taken -

JUMP, SCANS, PERIOD_S = 2, 5, 0.828  # 2.6 m apart


def clocks() -> dict[str, NDArray[np.float64]]:
    at = PERIOD_S * np.arange(SCANS)
    late = np.arange(SCANS) >= JUMP
    return {
        "set by decades": at + 1.7e9 * late,
        "begins again": np.where(late, at - at[JUMP], at + 1000.0),
        "pause of 30 s": at + 30.0 * late,
        "zeros": np.zeros(SCANS),
        "an hour back": at - 3600.0 * late,
        "runs back": at[::-1],
    }


@pytest.fixture(scope="module")
def recording(data_dir: Path) -> list[Scan]:
    """The first scans of a recorded drive, with their true poses."""
    folder = data_dir / "kitti0005_scans"
    scans = ScanSequence(folder, read_trajectory(folder / "poses_heldout_tum.txt"))
    return [scan for scan, _ in zip(scans, range(SCANS), strict=False)]


@pytest.fixture(scope="module")
def street(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map around these scans."""
    cloud = shmmap.read_cloud(data_dir / "kitti0005_map" / "map_static_v010.pcd").xyz
    folder = tmp_path_factory.mktemp("street") / "map"
    with MapWriter(folder, durable=False) as writer:
        writer.add({"xyz": cloud[(np.abs(cloud[:, :2]) < 80).all(axis=1)]})
        writer.finish()
    return folder


@pytest.fixture
def followed(street: Path, daemon: DaemonFactory) -> Iterator[tuple[NdtMatcher, MapUpdater, PoseInitializer]]:
    one = daemon(street)
    with (
        NdtMatcher(Settings()) as matcher,
        MapUpdater(one.endpoint, prepare=matcher.prepare) as maps,
        PoseInitializer(one.endpoint, InitializerRules(height=None)) as initializer,
    ):
        yield matcher, maps, initializer


def test_every_scan_after_a_jump_is_found(
    followed: tuple[NdtMatcher, MapUpdater, PoseInitializer], recording: list[Scan]
) -> None:
    matcher, maps, initializer = followed
    for name, stamps in clocks().items():
        start = recording[0].T_map_sensor
        assert start is not None
        follower = Follower(
            matcher, maps, ConstantVelocity(start), relocalize=Relocalizer(lambda: initializer)
        )
        jumps = 0
        for scan, stamp_s in zip(recording, stamps.tolist(), strict=True):
            frame = follower.follow(Scan(scan.name, stamp_s, scan.columns, scan.T_map_sensor))
            assert frame.T_truth is not None
            metres, degrees = pose_errors(frame.result.T_map_base[None], frame.T_truth[None])
            assert metres[0] < 0.15, (name, scan.name)
            assert degrees[0] < 1.0, (name, scan.name)
            assert frame.state == "tracking"
            guessed = float(np.linalg.norm(frame.T_guess[:3, 3] - frame.T_truth[:3, 3]))
            assert guessed < 5.0, "no motion that a clock has made up"
            jumps += frame.clock_jumped
        assert jumps == (SCANS - 1 if name in ("zeros", "runs back") else 1)
