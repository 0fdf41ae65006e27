# SPDX-License-Identifier: Apache-2.0
"""Scans of a real street whose clock jumps, stands or runs back: each is found where it was taken."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import pose_errors
from shmmap_clients.ndt_scan_matcher.drive.follower import Follower
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import ConstantVelocity
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapUpdater
from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, Relocalizer
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory

import shmmap
from shmmap.dividing.map_writer import MapWriter
from tests.process.conftest import DaemonFactory

BEFORE, SCANS, PERIOD_S = 2, 5, 0.828  # 2.6 m apart


def clocks() -> dict[str, NDArray[np.float64]]:
    at = PERIOD_S * np.arange(SCANS)
    late = np.arange(SCANS) >= BEFORE
    return {
        "set by decades": at + 1.7e9 * late,
        "begins again": np.where(late, at - at[BEFORE], at + 1000.0),
        "pause of 30 s": at + 30.0 * late,
        "zeros": np.zeros(SCANS),
        "an hour back": at - 3600.0 * late,
        "runs back": at[::-1],
    }


@pytest.fixture(scope="module")
def drive(data_dir: Path) -> list[Scan]:
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
    followed: tuple[NdtMatcher, MapUpdater, PoseInitializer], drive: list[Scan]
) -> None:
    matcher, maps, initializer = followed
    for name, stamps in clocks().items():
        start = drive[0].T_map_sensor
        assert start is not None
        follower = Follower(
            matcher, maps, ConstantVelocity(start), relocalize=Relocalizer(lambda: initializer)
        )
        jumps = 0
        for scan, stamp_s in zip(drive, stamps.tolist(), strict=True):
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
