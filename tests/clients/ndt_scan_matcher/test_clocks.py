# SPDX-License-Identifier: Apache-2.0
"""Predictions where a clock jumps, stands or runs back: never a motion that was not measured."""

from __future__ import annotations

import numpy as np
import pytest
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.ndt_scan_matcher.cli.follow import not_covered
from shmmap_clients.ndt_scan_matcher.drive import pose_stream
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import (
    LONGEST_STEP_S,
    ConstantVelocity,
    Odometry,
    first_twist,
    twist_on_route,
)
from shmmap_clients.ndt_scan_matcher.drive.pose_stream import OdometrySubscriber
from shmmap_clients.scans.trajectory import Trajectory


def straight(*stamps: float, speed: float = 10.0, step_s: float = 0.1) -> Trajectory:
    """A drive along x with these stamps; in truth a scan each ``step_s``."""
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, 0, 3] = speed * step_s * np.arange(len(stamps))
    return Trajectory(np.array(stamps, np.float64), poses)


def guesses(prediction: ConstantVelocity, drive: Trajectory, *, trusted: bool = True) -> list[float]:
    """How far from the last scan each prediction is, with every pose known."""
    found = []
    for stamp, T in zip(drive.stamps_s.tolist(), drive.T_map_sensor, strict=True):
        found.append(float(prediction.predict(stamp)[0, 3] - prediction.T_known[0, 3]))
        prediction.correct(stamp, T if trusted else None)
    return found


CLOCKS = {
    "set by decades": [0.0, 0.1, 0.2, 1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2],
    "begins again": [100.0, 100.1, 100.2, 0.0, 0.1, 0.2],
    "pause": [0.0, 0.1, 0.2, 30.2, 30.3, 30.4],
    "an hour back": [5000.0, 5000.1, 5000.2, 1400.3, 1400.4, 1400.5],
    "a little too late": [0.0, 0.1, 0.2, 1.3, 1.4, 1.5],
    "the same twice": [0.0, 0.1, 0.2, 0.2, 0.3, 0.4],
    "endless": [0.0, 0.1, 0.2, 1e300, 1e300, 1e300],
}


@pytest.mark.parametrize("name", CLOCKS)
def test_a_jump_predicts_no_motion(name: str) -> None:
    drive = straight(*CLOCKS[name])
    prediction = ConstantVelocity(drive.T_map_sensor[0])
    steps = guesses(prediction, drive)
    assert steps[:3] == pytest.approx([0.0, 0.0, 1.0])
    assert steps[3] == 0.0, "at the jump"
    assert steps[4] == 0.0, "nor with the velocity of before"
    if name != "endless":
        assert steps[5] == pytest.approx(1.0, rel=1e-5)
        assert prediction.velocity == pytest.approx((10.0, 0.0), rel=1e-5)


@pytest.mark.parametrize(
    "stamps", [[0.0] * 6, [5.0 - 0.1 * n for n in range(6)], [7.0 * n for n in range(6)]]
)
def test_times_that_never_make_sense(stamps: list[float]) -> None:
    drive = straight(*stamps)
    prediction = ConstantVelocity(drive.T_map_sensor[0])
    assert guesses(prediction, drive) == [0.0] * 6
    assert prediction.velocity == (0.0, 0.0)
    assert prediction.step(stamps[-1]) is None
    assert prediction.is_blind(stamps[-1])


def test_untrusted_poses_leave_it_near_the_last_known_one() -> None:
    drive = straight(*(0.1 * n for n in range(100)))
    prediction = ConstantVelocity(drive.T_map_sensor[0])
    for n in range(3):
        prediction.correct(float(drive.stamps_s[n]), drive.T_map_sensor[n])
    after = Trajectory(drive.stamps_s[3:], drive.T_map_sensor[3:])
    steps = guesses(prediction, after, trusted=False)
    assert steps[:5] == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])
    assert max(steps) <= 10.0 * LONGEST_STEP_S
    assert prediction.T_known[0, 3] == pytest.approx(2.0)
    assert prediction.velocity == (0.0, 0.0), "that was long ago"


def test_the_first_velocity_is_that_of_the_truth_or_of_a_route() -> None:
    drive = straight(0.0, 0.8, 1.6, step_s=0.8)
    prediction = ConstantVelocity(drive.T_map_sensor[0], first_twist(drive))
    assert guesses(prediction, drive) == pytest.approx([0.0, 8.0, 8.0])
    for stamps in ([0.0, 0.0], [0.0, 30.0], [1.0, 0.0], [0.0]):
        assert first_twist(straight(*stamps)) is None
    T = matrix_from_pose(np.array([7.9, 1.0, 0.0, 0.0, 0.0, np.pi / 2]))  # across the route
    twist = twist_on_route(drive, T)
    assert twist is not None
    assert ConstantVelocity(T, twist).velocity == pytest.approx((10.0, 0.0))
    T[1, 3] = 500.0
    assert twist_on_route(drive, T) is None
    assert twist_on_route(straight(0.0, 50.0), np.eye(4)) is None


@pytest.mark.parametrize("name", [*CLOCKS, "none"])
def test_odometry_of_the_same_clock(name: str) -> None:
    stamps = CLOCKS.get(name, [0.1 * n for n in range(6)])
    drive = straight(*stamps)
    prediction = Odometry(drive.T_map_sensor[0], lambda: drive)
    steps = guesses(prediction, drive)
    known = {"none", "set by decades", "pause", "a little too late", "endless"}  # one run of the odometry
    assert steps[:3] == pytest.approx([0.0, 1.0, 1.0])
    assert steps[3] == pytest.approx(1.0 if name in known else 0.0)
    if name not in {"endless", "the same twice"}:
        assert steps[4:] == pytest.approx([1.0, 1.0])


def test_odometry_that_begins_again_is_another_run() -> None:
    """Both runs have entries of the same times, of quite other places."""
    first, second = (
        straight(*(0.1 * n for n in range(20))),
        straight(*(0.1 * n for n in range(20)), speed=3.0),
    )
    both = Trajectory(
        np.concatenate([first.stamps_s, second.stamps_s]),
        np.concatenate([first.T_map_sensor, second.T_map_sensor]),
    )
    prediction = Odometry(np.eye(4), lambda: both)
    steps = guesses(prediction, both)
    assert steps[1:20] == pytest.approx([1.0] * 19)
    assert steps[20] == 0.0
    assert steps[21:] == pytest.approx([0.3] * 19)


def test_a_subscriber_drops_odometry_from_before_the_clock_was_set_back(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    subscriber = OdometrySubscriber(f"ipc://{tmp_path_factory.mktemp('s')}/none")
    try:
        for stamp in (100.0, 100.2, 100.1, 0.0, 0.1):
            subscriber._take(pose_stream.PoseMessage(stamp, np.eye(4).ravel().tolist()))
        assert subscriber.trajectory.stamps_s.tolist() == [0.0, 0.1]
        assert not subscriber.wait_until(50.0, 0.0)
        assert subscriber.wait_until(0.1, 0.0)
    finally:
        subscriber.close()


def test_odometry_of_another_clock_is_noted() -> None:
    recorded = straight(1.6e9, 1.6e9 + 0.1, 1.6e9 + 0.2)
    assert "no motion is known" in not_covered("odometry.tum", recorded, 0.0)
    assert "no motion is known" in not_covered("odometry.tum", straight(0.0, 0.1), 1.6e9)
    assert not not_covered("odometry.tum", recorded, 1.6e9 - 0.05)
    assert not not_covered("odometry.tum", straight(0.0, 0.1), 0.0)
