# SPDX-License-Identifier: Apache-2.0
"""Localization, compare filter and elevation map on one daemon: one copy, nothing lost, nothing left."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory

import shmmap
from tests.benchmarks.programs_side_by_side import run_three_programs, table
from tests.support.daemon_process import DaemonProcess, until
from tests.support.ndt_programs import make_town_drive

Factory = Callable[..., DaemonProcess]
BUDGET = 24 << 20


def test_three_programs_on_one_map(daemon: Factory, tmp_path: Path) -> None:
    drive = make_town_drive(tmp_path / "drive", blocks=(3, 3), density=12.0, frames=30, step=4.0)
    one = daemon(drive.map_dir, "--budget", str(BUDGET))
    trajectory = read_trajectory(drive.truth)

    def scans() -> Iterator[Scan]:
        for turn in range(2):  # there, and from the beginning once more: cells go and come again
            for scan in ScanSequence(drive.scans, trajectory):
                yield dataclasses.replace(scan, name=f"{turn}/{scan.name}", stamp_s=scan.stamp_s + 100 * turn)

    poses = [
        (float(stamp) + 100 * turn, T)
        for turn in range(2)
        for stamp, T in zip(trajectory.stamps_s, trajectory.T_map_sensor, strict=True)
    ]
    work = tmp_path / "work"
    work.mkdir()
    window = ["--update-distance", "10"]
    result = run_three_programs(
        one.endpoint, one.shm_dir, one.instance, scans(), poses, work,
        ndt=["--map-radius", "60", "--lidar-radius", "40", "--thin", "0.5", *window],
        compare=["--mode", "distance", "--map-radius", "60", "--allow-empty", *window],  # nothing moves here
        elevation=["--resolution", "0.5", "--rule", "surface"],
    )  # fmt: skip
    assert result.scans == 60
    ndt, compare, elevation = (result.programs[name] for name in ("ndt", "compare", "elevation"))
    # nothing was lost between the programs
    assert ndt.document["frames"] == ndt.document["trustworthy"] == 60
    assert compare.document["scans"] == 60
    assert compare.document["incomplete_scans"] == 0
    assert compare.exit_code == 0
    assert result.acknowledged["compare"] == 60
    assert result.acknowledged["ndt"] >= 59  # it does not wait for listeners
    assert elevation.runs >= 1
    assert elevation.exit_code == 0
    assert elevation.document["cells"] == 144
    # one copy: never more than the budget, whichever process holds it
    assert 0 < max(result.segment_bytes) <= BUDGET
    assert len(result.segments_seen) > 200
    assert (work / "ndt.svg").exists()
    assert (work / "compare.svg").exists()
    assert (
        table(result)[-1] == "localized 60 of 60 scans (60 to be trusted), compared 60 (0 with cells missing)"
    )
    # nothing is held any more: everything can be evicted
    with shmmap.connect(one.endpoint) as client:
        client.evict()
        assert not client.stats().unknown_holders
        until(lambda: client.stats().counters["zombies"] <= 0)
    assert one.segments() == []
