# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt follow`` where the vehicle is not where it should be: kidnapped, badly placed, off the map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.scans.trajectory import tum_line

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
