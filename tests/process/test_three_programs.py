# SPDX-License-Identifier: Apache-2.0
"""Localization, compare filter and elevation map on one daemon: one copy, nothing lost, nothing left."""

from __future__ import annotations

import dataclasses
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from shmmap_clients.demo.three_programs import run_three_programs, table
from shmmap_clients.scans.scan_sequence import Scan, ScanSequence
from shmmap_clients.scans.trajectory import read_trajectory

import shmmap
from shmmap.cli.screens.demo_progress import QuietProgress
from shmmap.demo.demo import run_demo
from shmmap.demo.demo_town import DemoSettings
from tests.support.daemon_process import ROOT, DaemonProcess, processes_marked, wait_ended
from tests.support.patience import Patience
from tests.support.town_drive import make_town_drive

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
    # nothing was lost on the way
    assert ndt.document["frames"] == ndt.document["trustworthy"] == 60
    assert compare.document["scans"] == 60
    assert compare.document["incomplete_scans"] == 0
    assert compare.exit_code == 0
    assert result.acknowledged["compare"] == 60
    assert result.acknowledged["ndt"] >= 59  # it does not wait for whoever listens
    assert elevation.runs >= 1
    assert elevation.exit_code == 0
    assert elevation.document["cells"] == 144
    # one copy: never more than the budget, whoever holds it
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
        freed = Patience()
        while freed(client.stats().counters["zombies"] > 0):
            pass
    assert one.segments() == []


def test_the_full_demonstration(tmp_path: Path) -> None:
    before = set(os.listdir("/dev/shm"))
    settings = DemoSettings(
        blocks=(3, 2), density=8.0, radius=90.0, length=20.0, onward=12, scanned=12.0, counts=(2, 3), many=3
    )
    result = run_demo(settings, QuietProgress(), map_dir=str(tmp_path / "town"), full=True)
    assert (tmp_path / "town" / "pointcloud_map_metadata.yaml").exists()
    assert [each.shared.consumers for each in result.rounds.values()] == [2, 3]
    assert result.localization is None
    programs = result.programs
    assert programs is not None
    document = programs.document
    ran = document["programs"]
    assert document["scans"] == ran["ndt"]["frames"] == ran["compare"]["scans"] == 7
    assert ran["compare"]["incomplete_scans"] == 0
    assert ran["elevation"]["cells"] == result.town.cells == 96
    # each was measured against what the town knows
    errors = document["errors"]
    assert 0.0 < errors["ndt"]["mean_m"] <= errors["ndt"]["max_m"] < 0.2
    assert errors["compare"]["still_kept"] < 0.2 < errors["compare"]["moving_kept"]
    assert 5 <= errors["elevation"]["places"] <= 7
    assert errors["elevation"]["max_m"] < 0.1
    assert programs.picture_svg.startswith("<svg")
    mine = f"shmmap-test-{os.getpid()}-"
    assert not [name for name in set(os.listdir("/dev/shm")) - before if name.startswith(mine)]


INTERRUPTED = """
from shmmap.cli.screens.demo_progress import PlainProgress
from shmmap.demo.demo import run_demo
from shmmap.demo.demo_town import DemoSettings
from shmmap.processes.interrupts import signals_interrupt

settings = DemoSettings(
    blocks=(3, 2), density=8.0, radius=90.0, length=10.0, onward=12, scanned=160.0, counts=(1, 2), many=2
)
with signals_interrupt():
    run_demo(settings, PlainProgress(), full=True)
"""


def test_an_interrupted_full_demonstration_leaves_nothing(tmp_path: Path) -> None:
    mark = secrets.token_hex(8)
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path), "SHMMAP_TEST_RUN": mark},
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("Driving: localization"):
            break
    # the three programs and the one that started them are there
    waiting = Patience()
    while waiting(not any("shmmap_clients.elevation_map" in _command(pid) for pid in processes_marked(mark))):
        os.sched_yield()
    process.send_signal(signal.SIGTERM)
    assert wait_ended(process.pid)
    process.communicate()
    assert process.returncode not in (0, -signal.SIGTERM)
    assert [_command(pid) for pid in processes_marked(mark)] == []
    assert list(tmp_path.iterdir()) == []
    assert not [name for name in os.listdir("/tmp") if f"-test-{process.pid}-" in name]


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8").replace("\0", " ")
    except OSError:
        return ""
