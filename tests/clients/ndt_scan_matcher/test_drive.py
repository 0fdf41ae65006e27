# SPDX-License-Identifier: Apache-2.0
"""What surrounds the alignments of a drive: predictions, errors, summaries, pictures, poses on a wire."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, VoxelMap, matrix_from_pose
from shmmap_clients.ndt_scan_matcher.drive.drive_plot import drive_svg
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import summarize
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame, thinned
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity, Odometry, interpolate
from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometryListener, PosePublisher, decode_pose
from shmmap_clients.ndt_scan_matcher.drive.trajectory_error import Spread, drive_errors, pose_errors
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdate
from shmmap_clients.scans.trajectory import Trajectory

import shmmap


def arc(count: int, step_s: float = 0.1) -> Trajectory:
    """A drive round a bend, climbing."""
    motion = matrix_from_pose(np.array([1.2, 0.0, 0.03, 0.002, -0.004, 0.05]))
    poses = [matrix_from_pose(np.array([5.0, -3.0, 1.0, 0.01, 0.02, 2.0]))]
    while len(poses) < count:
        poses.append(poses[-1] @ motion)
    return Trajectory(np.arange(count, dtype=np.float64) * step_s, np.array(poses))


def frame(number: int, T: NDArray[np.float64], truth: NDArray[np.float64] | None) -> Frame:
    with NdtMatcher(backend="numpy") as matcher:
        matcher.set_map(VoxelMap({}))
        result = matcher.align(np.zeros((1, 3)), T)
    return Frame(
        f"scan_{number}", 0.1 * number, result, T, truth, 0.001, 0.0, 0.01 + number * 1e-3, number == 0
    )


def test_constant_velocity_continues_a_screw() -> None:
    drive = arc(6)
    prediction = ConstantVelocity(drive.T_map_sensor[0])
    for index in range(5):
        stamp = float(drive.stamps_s[index])
        guess = prediction.predict(stamp)
        if index >= 2:
            np.testing.assert_allclose(guess, drive.T_map_sensor[index], atol=1e-9)
        prediction.correct(stamp, drive.T_map_sensor[index])
    # half the time, half the way: as far along the arc as interpolation
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


def test_errors_are_those_that_were_made() -> None:
    truth = arc(200).T_map_sensor
    off = matrix_from_pose(np.array([0.3, 0.4, 0.0, 0.0, 0.0, np.radians(2.0)]))
    metres, degrees = pose_errors(truth @ off, truth)
    np.testing.assert_allclose(metres, 0.5)
    np.testing.assert_allclose(degrees, 2.0, atol=1e-6)
    same = drive_errors(truth, truth)
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
    assert drive_errors(stretched, straight).rte[50.0] == pytest.approx(1.0)


def test_a_spread_of_nothing_is_not_a_number() -> None:
    assert np.isnan(Spread.of(np.empty(0)).mean)
    spread = Spread.of(np.arange(101.0))
    assert (spread.mean, spread.p50, spread.p99, spread.max) == (50.0, 50.0, 99.0, 100.0)


def test_summary_and_picture_of_a_drive(tmp_path: Path) -> None:
    drive = arc(30)
    frames = [frame(i, T, T) for i, T in enumerate(drive.T_map_sensor)]
    summary = summarize(frames, [MapUpdate(5, 2, 0.1, 0.01, 1000)], 1)
    assert summary.errors is not None
    assert summary.errors.ate_rmse_m < 1e-9
    assert (summary.frames, summary.waited, summary.too_slow) == (30, 1, 1)
    assert (summary.cells_added, summary.cells_removed, summary.map_private_bytes) == (5, 2, 1000)
    assert summary.latency_ms.max == pytest.approx(11.0 + 29.0)
    json.dumps(summary.as_document(), allow_nan=False)
    json.dumps(summarize([], [], 0).as_document(), allow_nan=False)
    for drawn in (frames, frames[:1], [frame(0, np.eye(4), None)], []):
        assert ElementTree.fromstring(drive_svg(drawn)).tag.endswith("svg")


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
        listener = OdometryListener(address)
        try:
            assert publisher.wait_for_listener(60.0)
            for index, T in enumerate(drive.T_map_sensor):
                publisher.send(frame(index, T, None))
            assert listener.wait_until(float(drive.stamps_s[-1]), 60.0)
            assert not listener.wait_until(float(drive.stamps_s[-1]) + 0.1, 0.0)
            heard = listener.trajectory
        finally:
            listener.close()
    np.testing.assert_allclose(heard.T_map_sensor, drive.T_map_sensor)
    np.testing.assert_allclose(heard.stamps_s, drive.stamps_s)


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


def test_addresses_that_make_no_sense_are_refused() -> None:
    with pytest.raises(shmmap.BadRequest, match="cannot bind"):
        PosePublisher("nonsense")
    with pytest.raises(shmmap.BadRequest, match="cannot connect"):
        OdometryListener("nonsense")
