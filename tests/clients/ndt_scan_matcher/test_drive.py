# SPDX-License-Identifier: Apache-2.0
"""What surrounds the alignments of a drive: predictions, errors, summaries, pictures, poses on a wire."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.command_line import complain
from shmmap_clients.ndt_scan_matcher import TrustLimits, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.backends.backend import UploadStatistics
from shmmap_clients.ndt_scan_matcher.cli.follow_report import FollowReport, print_summary
from shmmap_clients.ndt_scan_matcher.drive.drive_plot import DrivePlot, value_label
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import (
    DriveStatistics,
    RunningErrors,
    TrajectoryErrors,
    frame_document,
    pose_errors,
)
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity, Odometry
from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometrySubscriber, PosePublisher, decode_pose
from shmmap_clients.ndt_scan_matcher.map.map_updater import UpdateStatistics
from shmmap_clients.scans.scan_file import thinned
from shmmap_clients.scans.trajectory import Trajectory, interpolate
from shmmap_clients.spread import KEPT

import shmmap
from tests.clients.ndt_scan_matcher.scene import frame


def arc(count: int, step_s: float = 0.1) -> Trajectory:
    """A drive round a bend, climbing."""
    motion = matrix_from_pose(np.array([1.2, 0.0, 0.03, 0.002, -0.004, 0.05]))
    poses = [matrix_from_pose(np.array([5.0, -3.0, 1.0, 0.01, 0.02, 2.0]))]
    while len(poses) < count:
        poses.append(poses[-1] @ motion)
    return Trajectory(np.arange(count, dtype=np.float64) * step_s, np.array(poses))


def test_constant_velocity_continues_a_screw() -> None:
    drive = arc(6)
    prediction = ConstantVelocity(drive.T_map_sensor[0])
    for index in range(5):
        stamp = float(drive.stamps_s[index])
        guess = prediction.predict(stamp)
        if index >= 2:
            np.testing.assert_allclose(guess, drive.T_map_sensor[index], atol=1e-9)
        prediction.correct(stamp, drive.T_map_sensor[index])
    # half the time, half the distance: as far along the arc as interpolation
    half = interpolate(drive, 0.45)
    assert half is not None
    np.testing.assert_allclose(prediction.predict(0.45), half, atol=1e-9)
    speed = np.hypot(*prediction.velocity)
    assert speed == pytest.approx(12.0, rel=0.01)


def test_odometry_gives_the_motion_in_any_frame() -> None:
    drive = arc(6)
    elsewhere = matrix_from_pose(np.array([100.0, 50.0, -3.0, 0.3, 0.2, -1.0]))
    other = Trajectory(drive.stamps_s[:5], elsewhere @ drive.T_map_sensor[:5])
    prediction = Odometry(drive.T_map_sensor[0], lambda: other)
    prediction.correct(0.0, drive.T_map_sensor[0])
    np.testing.assert_allclose(prediction.predict(0.3), drive.T_map_sensor[3], atol=1e-9)
    prediction.correct(0.3, drive.T_map_sensor[3])
    prediction.correct(0.4, drive.T_map_sensor[4])
    # beyond what the odometry knows: constant velocity
    np.testing.assert_allclose(prediction.predict(0.5), drive.T_map_sensor[5], atol=1e-9)
    assert interpolate(other, -0.1) is None
    assert interpolate(other, 0.41) is None


def trajectory_errors(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> TrajectoryErrors:
    """Compare (N, 4, 4) poses with the truth."""
    running = RunningErrors()
    for pose, true in zip(poses, truth, strict=True):
        running.add(pose, true)
    assert running.errors is not None
    return running.errors


def test_errors_are_those_that_were_made() -> None:
    truth = arc(200).T_map_sensor
    off = matrix_from_pose(np.array([0.3, 0.4, 0.0, 0.0, 0.0, np.radians(2.0)]))
    metres, degrees = pose_errors(truth @ off, truth)
    np.testing.assert_allclose(metres, 0.5)
    np.testing.assert_allclose(degrees, 2.0, atol=1e-6)
    same = trajectory_errors(truth, truth)
    assert same.ate_m.max < 1e-9
    assert set(same.rte) == {10.0, 50.0, 100.0}
    assert max(same.rte.values()) < 1e-6
    # a scale error of 1% is a metre in a hundred
    longer = truth.copy()
    longer[:, :3, 3] *= 1.01
    straight = np.tile(np.eye(4), (200, 1, 1))
    straight[:, 0, 3] = np.arange(200)
    stretched = straight.copy()
    stretched[:, 0, 3] *= 1.01
    assert trajectory_errors(stretched, straight).rte[50.0] == pytest.approx(1.0)


def test_relative_errors_are_of_every_stretch() -> None:
    """Against the definition: from each pose to the first one at that distance along the path."""
    truth = arc(150).T_map_sensor
    noise = np.random.default_rng(4).normal(0.0, 0.05, (150, 6)) * (1, 1, 1, 0.1, 0.1, 0.1)
    poses = np.array([T @ matrix_from_pose(one) for T, one in zip(truth, noise, strict=True)])
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    for stretch, found in trajectory_errors(poses, truth).rte.items():
        errors = []
        for start in range(150):
            later = np.flatnonzero(travelled_m >= travelled_m[start] + stretch)
            if len(later):
                ours = np.linalg.inv(poses[start]) @ poses[later[0]]
                theirs = np.linalg.inv(truth[start]) @ truth[later[0]]
                errors.append(np.linalg.norm((np.linalg.inv(theirs) @ ours)[:3, 3]) * 100.0 / stretch)
        assert found == pytest.approx(np.mean(errors))


def test_a_vehicle_that_stands_begins_no_stretches() -> None:
    running = RunningErrors()
    for _ in range(1000):
        running.add(np.eye(4), np.eye(4))
    assert max(len(starts) for starts in running._starts.values()) == 1
    assert running.errors is not None
    assert running.errors.rte == {}


def test_summary_and_picture_of_a_drive(tmp_path: Path) -> None:
    drive = arc(30)
    frames = [frame(i, T, T) for i, T in enumerate(drive.T_map_sensor)]
    uploads = UploadStatistics()
    updates = UpdateStatistics(uploads)
    updates.add(added=5, removed=2, request_s=0.1, build_s=0.01, prepare_s=0.004, private_bytes=1000)
    uploads.written_bytes, uploads.writes, uploads.laid_out_again = 123_456, 7, 1
    statistics = DriveStatistics()
    for one in frames:
        statistics.add(one)
    summary = statistics.summary(updates, 1, TrustLimits(nvtl=2.3))
    assert summary.errors is not None
    assert summary.errors.ate_rmse_m < 1e-9
    assert (summary.frames, summary.waited, summary.too_slow) == (30, 1, 1)
    assert (summary.cells_added, summary.cells_removed, summary.map_private_bytes) == (5, 2, 1000)
    assert (summary.map_written_bytes, summary.map_writes, summary.map_laid_out_again) == (123_456, 7, 1)
    assert summary.map_build_ms.max == pytest.approx(10.0)
    assert summary.map_prepare_ms.max == pytest.approx(4.0)
    assert summary.latency_ms.max == pytest.approx(11.0 + 29.0)
    json.dumps(summary.as_document(), allow_nan=False)
    assert (summary.no_map, summary.lost, summary.trustworthy) == (30, 30, 0)
    assert summary.failed_limits == {"no_map": 30}
    assert summary.as_document()["trust"]["nvtl"] == 2.3
    nothing = DriveStatistics().summary(UpdateStatistics(), 0, TrustLimits())
    json.dumps(nothing.as_document(), allow_nan=False)
    for drawn in (frames, frames[:1], [frame(0, np.eye(4), None)], []):
        plot = DrivePlot()
        for one in drawn:
            plot.add(one)
        assert ElementTree.fromstring(plot.svg()).tag.endswith("svg")


def test_the_summary_in_words_leaves_out_what_has_no_data(capsys: pytest.CaptureFixture[str]) -> None:
    statistics = DriveStatistics()
    for number in range(3):
        statistics.add(frame(number, np.eye(4), None))  # without a map: no score
    updates = UpdateStatistics()
    updates.add(added=64, removed=0, request_s=0.1, build_s=0.01, prepare_s=0.002, private_bytes=60_000)
    print_summary(statistics.summary(updates, 0, TrustLimits(nvtl=2.3)))
    out = capsys.readouterr().out
    assert "on the device" not in out
    updates.uploads.written_bytes, updates.uploads.writes = 5_360_000, 2
    print_summary(statistics.summary(updates, 0, TrustLimits(nvtl=2.3)))
    assert "5.1 MiB written in 2 writes\n" in capsys.readouterr().out
    updates.uploads.laid_out_again = 3
    print_summary(statistics.summary(updates, 0, TrustLimits(nvtl=2.3)))
    assert "5.1 MiB written in 2 writes, laid out again 3 times\n" in capsys.readouterr().out
    assert "updates: 1, cells added: 64, cells removed: 0" in out
    assert "58.6 KiB at most, beside the shared memory" in out
    rows = [line.split("  ")[0] for line in out.splitlines() if " variance " in line]
    assert "latency, ms" in rows
    assert "map request, ms" in rows
    assert "NVTL" not in rows
    assert "transform probability" not in rows


def test_a_frame_as_json_says_how_far_it_is_from_the_truth() -> None:
    off = matrix_from_pose(np.array([0.3, 0.4, 0.0, 0.0, 0.0, np.radians(2.0)]))
    document = frame_document(frame(1, off, np.eye(4)))
    json.dumps(document, allow_nan=False)
    assert document["error_m"] == pytest.approx(0.5)
    assert document["error_deg"] == pytest.approx(2.0)
    assert document["pose"][:2] == pytest.approx([0.3, 0.4])
    assert document["no_map"]
    assert document["failed_limits"] == ["no_map"]
    assert document["state"] == "lost"
    assert frame_document(frame(1, off, None))["error_m"] is None


def test_a_long_drive_takes_no_more_memory() -> None:
    statistics, plot = DriveStatistics(), DrivePlot()
    one = frame(0, np.eye(4), np.eye(4))
    sizes = []
    for number in range(3 * KEPT):
        truth = np.eye(4)
        truth[0, 3] = 0.4 * number
        moved = dataclasses.replace(one, T_truth=truth)
        statistics.add(moved)
        plot.add(moved)
        if number + 1 in (KEPT, 3 * KEPT):
            sizes.append(len(pickle.dumps((statistics, plot))))
    assert sizes[1] < 1.1 * sizes[0]
    summary = statistics.summary(UpdateStatistics(), 0, TrustLimits())
    assert summary.frames == 3 * KEPT
    assert len(re.findall("<circle", plot.svg())) <= KEPT


def test_thinning_leaves_a_point_per_cube() -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (5000, 3)).astype(np.float32)
    few = thinned(points, 2.5)
    assert len(few) == 64
    assert few.dtype == np.float32
    assert thinned(points, None) is points


def test_poses_and_odometry_travel(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/poses"
    drive = arc(5)
    with PosePublisher(address) as publisher:
        odometry = OdometrySubscriber(address)
        try:
            assert publisher.wait_for_subscriber(60.0)
            for index, T in enumerate(drive.T_map_sensor):
                publisher.send(frame(index, T, None))
            assert odometry.wait_until(float(drive.stamps_s[-1]), 60.0)
            assert not odometry.wait_until(float(drive.stamps_s[-1]) + 0.1, 0.0)
            received = odometry.trajectory
        finally:
            odometry.close()
    np.testing.assert_allclose(received.T_map_sensor, drive.T_map_sensor)
    np.testing.assert_allclose(received.stamps_s, drive.stamps_s)


@pytest.mark.parametrize(
    "message", [b"", b"\x80", b"nonsense", b"\x82\xa7stamp_s\xcb" + bytes(8) + b"\xa1T\x90"]
)
def test_what_is_no_pose_is_refused(message: bytes) -> None:
    with pytest.raises(shmmap.BadRequest, match="no pose"):
        decode_pose(message)


@pytest.mark.parametrize(
    "wrong",
    [
        {"T": [0.0] * 16},  # would have no inverse
        {"T": [1e300] * 16},
        {"T": [math.nan] * 16},
        {"T": np.diag([1.0, 1.0, -1.0, 1.0]).ravel().tolist()},
        {"T": np.eye(4).ravel().tolist()[:15]},
        {"T": np.diag([1.0, 1.0, 1.0, 2.0]).ravel().tolist()},
        {"stamp_s": math.nan},
        {"shmmap_pose": 2},
    ],
)
def test_a_pose_is_a_rigid_motion_at_a_time(wrong: dict[str, Any]) -> None:
    good = {"stamp_s": 1.0, "T": np.eye(4).ravel().tolist()}
    assert good["T"] == decode_pose(msgspec.msgpack.encode(good)).T
    with pytest.raises(shmmap.BadRequest, match="no pose"):
        decode_pose(msgspec.msgpack.encode(good | wrong))


def test_what_scans_are_called_is_not_obeyed_by_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    def say(text: str, hint: str = "") -> None:
        complain("shmmap-ndt", text, hint)

    drive: Any = SimpleNamespace(say=say)
    client: Any = SimpleNamespace(welcome=SimpleNamespace(bounds=(0.0, -1.5, 20.0, 30.25)))
    matcher: Any = SimpleNamespace(trust=TrustLimits(nvtl=2.3), fault=None)
    maps: Any = SimpleNamespace(too_slow=1)
    report = FollowReport(drive, client, matcher, maps, None, "--relocalize searches for it")
    named = dataclasses.replace(frame(0, np.eye(4), None), name="\x1b[2Jscan\n")
    report.add(named)
    report.add(named)
    said = capsys.readouterr().err
    assert said.splitlines() == [
        (
            "shmmap-ndt: no map at scan \\x1b[2Jscan\\n: the map spans x 0 .. 20 m, y -1.5 .. 30.25 m,"
            " the pose is at (0.000, 0.000)"
        ),
        "shmmap-ndt: the map did not keep up with the vehicle: scan \\x1b[2Jscan\\n waited for it",
        "shmmap-ndt: lost at scan \\x1b[2Jscan\\n: no map",
        "hint: --relocalize searches for it",
    ]


def test_labels_of_values_fit_into_the_margin() -> None:
    values = (
        9.87654321e-15,
        0.00099999,
        0.0046789,
        0.1,
        1.0,
        99.95,
        999.4,
        999.9,
        1620.4,
        999_999.4,
        1.6e6,
        3e9,
    )
    labels = [value_label(value) for value in values]
    assert [label for label in labels if len(label) > 7] == []
    np.testing.assert_allclose([float(label.replace(",", "")) for label in labels], values, rtol=0.5)
    assert labels[2:4] + labels[8:10] == ["0.00468", "0.1", "1,620", "999,999"]
