# SPDX-License-Identifier: Apache-2.0
"""The order of scans and which pose is whose, by names of every kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shmmap_clients.scans.scan_names import in_order, pair_with_poses
from shmmap_clients.scans.scan_sequence import ScanSequence
from shmmap_clients.scans.trajectory import Trajectory

from shmmap import BadRequest


def ordered(names: str) -> str:
    """Names of scans with blanks between them, shuffled and put in order."""
    files = [Path(f"{name}.npz") for name in names.split()]
    np.random.default_rng(0).shuffle(files)
    return " ".join(path.name.removesuffix(".npz") for path in in_order(files))


def drive(*stamps: float) -> Trajectory:
    return Trajectory(np.array(stamps, np.float64), np.tile(np.eye(4), (len(stamps), 1, 1)))


def paired(names: str, trajectory: Trajectory, suffix: str = ".npz") -> tuple[list[int], str]:
    return pair_with_poses(in_order([Path(f"{name}{suffix}") for name in names.split()]), trajectory)


@pytest.mark.parametrize(
    "names",
    [
        ".05 .1 .15 .2",
        "0.05 0.1 0.15 0.2",
        "0.1 0.15 0.2 0.25 0.3",
        "9.5 10.05 10.1 10.15 11",
        "scan_9.95 scan_10.0 scan_10.05 scan_10.1",
        "1700000000.05 1700000000.1 1700000000.15",
        "0.5 1.25 1.5 2",
        "1.8 1.9 1.10 1.11 1.12",  # counted
        "a1.9 a1.10 a2.1 a2.2",
        "log-2.99 log-2.100 log-2.101",
        "frame.9 frame.10 frame.11",
        "v1.2.9 v1.2.10",
        "s_9_1 s_9_10 s_10 s_0012",
        "0001 0002 0010 0100",
        "-0.5_1 -0.5_2 -0.5_10",
    ],
)
def test_order(names: str) -> None:
    assert ordered(names) == names


@pytest.mark.parametrize("names", ["0.5 0.10 0.15", "1.2 1.30 1.4 1.25", "t3.7 t3.10"])
def test_names_that_could_be_counters_or_decimals_are_refused(names: str) -> None:
    with pytest.raises(BadRequest, match="no clear order") as refused:
        ordered(names)
    assert "same width" in refused.value.hint


@pytest.mark.parametrize("other", ["s_1.pcd", "s_1.bin", "s_1.pcd.bin"])
def test_two_files_of_one_scan_are_refused(other: str) -> None:
    with pytest.raises(BadRequest, match="both called s_1"):
        in_order([Path("s_1.npz"), Path(other), Path("s_2.npz")])


def test_times_in_names_are_the_times_of_poses() -> None:
    ten = drive(*(0.1 * n for n in range(10)))
    assert paired("0.2 0.3 0.45", drive(0.0, 0.1, 0.2, 0.3, 0.4, 0.45)) == ([2, 3, 5], "time")
    assert paired("0.20_lidar_0 0.40_lidar_0", ten) == ([2, 4], "time")
    assert paired("200_lidar_0 400_lidar_0", ten) == ([2, 4], "time")  # milliseconds
    clock = drive(*(1.7e9 + 0.1 * n for n in range(10)))
    assert paired("1700000000100000 1700000000800000", clock) == ([1, 8], "time")
    assert paired("1700000000100000000_lidar_0 1700000000800000000_lidar_0", clock) == ([1, 8], "time")
    name = "n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{}.pcd"
    names = " ".join(name.format(1700000000000000 + 300_000 * n) for n in range(3))
    assert paired(names, clock, ".bin") == ([0, 3, 6], "time")
    # scans and poses 20 ms apart, also where the poses of two sensors follow each other closely
    assert paired("1700000000.12 1700000000.82", clock) == ([1, 8], "time")
    two = drive(*(1.7e9 + 0.1 * n + offset for n in range(5) for offset in (0.0, 0.002)))
    assert paired("1700000000.122 1700000000.322", two) == ([3, 7], "time")
    # poses in another order than scans, as many as these: the place would be wrong
    assert paired("0.1 0.2 0.3", drive(0.3, 0.1, 0.2)) == ([1, 2, 0], "time")
    assert paired("0.104 0.197 0.302", drive(0.1, 0.2, 0.3)) == ([0, 1, 2], "time")


def test_else_the_place_or_a_number_says_it() -> None:
    ten = drive(*(0.1035 * n for n in range(10)))
    assert paired("s_0 s_2 s_4", drive(5.0, 6.0, 7.0)) == ([0, 1, 2], "place")
    assert paired("s_0 s_2 s_4", ten) == ([0, 2, 4], "number")
    assert paired("s_5_lidar_0 s_7_lidar_0", ten) == ([5, 7], "number")
    assert paired("5.pcd 7.pcd", ten, ".bin") == ([5, 7], "number")
    # the clock was set in mid-drive: stamps say nothing, names do
    assert paired("s_1 s_9", drive(*([0.0] * 10))) == ([1, 9], "number")
    assert paired("100 101 102", drive(0.0, 0.1, 0.2)) == ([0, 1, 2], "place")
    assert paired("0.5 1.0 1.5", drive(1.7e9, 1.7e9 + 0.5, 1.7e9 + 1)) == ([0, 1, 2], "place")


@pytest.mark.parametrize(
    ("names", "trajectory", "said"),
    [
        (
            "a_lidar_0 b_lidar_0",
            drive(0.0, 0.1, 0.2),
            "a_lidar_0.npz and b_lidar_0.npz would both have pose 0",
        ),
        ("s_1 t_1", drive(0.0, 0.1, 0.2), "s_1.npz and t_1.npz would both have pose 1"),
        ("1.00 1.01 1.02", drive(1.0, 2.0, 3.0), "1.00.npz and 1.01.npz would both have pose 0"),
        ("1_2 2_1", drive(0.0, 0.1, 0.2), "several numbers"),
        ("0.1 0.2 0.75", drive(0.1, 0.2, 0.3), "times, and 0.75 has no pose within 0.05 s"),
        ("s_0 s_7", drive(0.0, 0.1, 0.2), "3 poses do not fit 2 scans: s_7.npz"),
        ("front back", drive(0.0, 0.1, 0.2), "3 poses do not fit 2 scans"),
    ],
)
def test_poses_that_do_not_fit_are_refused_by_name(names: str, trajectory: Trajectory, said: str) -> None:
    with pytest.raises(BadRequest) as refused:
        paired(names, trajectory)
    assert said in refused.value.message
    assert refused.value.hint


def test_scans_come_in_the_order_of_their_times_and_the_pairs_are_said(tmp_path: Path) -> None:
    for name in ("b_0.05", "a_0.1", "b_0.15"):
        np.savez(tmp_path / f"{name}.npz", xyz=np.ones((2, 3)))
    scans = ScanSequence(tmp_path, drive(0.0, 0.05, 0.1, 0.15))
    assert [scan.stamp_s for scan in scans] == sorted(scan.stamp_s for scan in scans)
    for path in tmp_path.iterdir():
        path.rename(path.with_name(path.name.replace("a_", "b_")))
    scans = ScanSequence(tmp_path, drive(0.0, 0.05, 0.1, 0.15))
    assert [scan.stamp_s for scan in scans] == [0.05, 0.1, 0.15]
    assert (
        scans.pairing == "3 scans have poses by time: b_0.05 pose 1 at 0.05 s, ..., b_0.15 pose 3 at 0.15 s"
    )
    assert ScanSequence(tmp_path).pairing == ""
