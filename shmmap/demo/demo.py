# SPDX-License-Identifier: Apache-2.0
"""The demonstration: a town, a daemon, a vehicle, four processes, and the same with private copies.

Everything is real: files on disk, a daemon process, consumer processes, memory as the kernel counts
it.  It leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from shmmap.client import Client, connect
from shmmap.demo.consumer import Pose
from shmmap.demo.daemon_process import DaemonProcess
from shmmap.demo.demo_town import DemoSettings, Progress, TownMap, build_town, fit, free_bytes
from shmmap.demo.fleet import Fleet, StepReport
from shmmap.demo.interrupts import scratch_directory
from shmmap.demo.process_memory import ProcessMemory, sum_memory
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import Stats
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.statistics.cell_rows import CellRow
from shmmap.statistics.reader import read_statistics

__all__ = ["DemoResult", "DriveResult", "Traffic", "run_demo"]


@dataclass(frozen=True, slots=True)
class DriveResult:
    """One drive of four processes.

    Attributes
    ----------
    processes
        How many processes, the daemon and its workers included.
    cells, points, map_bytes
        What one consumer holds at the end; bytes of its columns.
    start_s
        From the first pose until everybody had its first window.
    updates
        How often a consumer got new cells, the first window left out; what follows is about these.
    follow_s, follow_max_s
        How long a consumer's control loop waited for the map: median and longest.
    complete_s
        How long until the new cells were there, median.
    warm_updates, warm_complete_s
        The same of those for which the daemon had all cells in memory already (NaN: there was none).
    handed_bytes
        Columns that all consumers got in the drive, summed.
    memory
        Of all processes at the end, as the kernel counts it.
    shm_bytes
        Shared memory in use at the end, mapped or not, as the file system counts it.
    """

    processes: int
    cells: int
    points: int
    map_bytes: int
    start_s: float
    updates: int
    follow_s: float
    follow_max_s: float
    complete_s: float
    warm_updates: int
    warm_complete_s: float
    handed_bytes: int
    memory: ProcessMemory
    shm_bytes: int

    @property
    def total_bytes(self) -> int:
        """All memory: what processes have for themselves, and shared memory once."""
        return self.memory.own_bytes + self.shm_bytes


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages between consumers and daemon in a drive: how many requests, bytes, handles in replies."""

    requests: int
    request_bytes: int
    reply_bytes: int
    handles: int


@dataclass(slots=True)
class DemoResult:
    """Everything the demonstration measured."""

    settings: DemoSettings
    town: TownMap
    shared: DriveResult
    private: DriveResult
    traffic: Traffic
    resident: list[CellRow]


def run_demo(settings: DemoSettings, progress: Progress, *, map_dir: str | None = None) -> DemoResult:
    """Build, drive, measure, clean up.

    Parameters
    ----------
    map_dir
        Where the map is built and stays; by default in a temporary directory that is removed.

    Raises
    ------
    ConfigError
        There is not enough shared memory.
    BadRequest
        ``map_dir`` exists and is not empty.
    """
    with contextlib.ExitStack() as stack:
        if map_dir is None:
            scratch = stack.enter_context(scratch_directory("shmmap-demo-"))
            map_dir = str(Path(scratch, "map"))
        parent = Path(map_dir).absolute().parent
        parent.mkdir(parents=True, exist_ok=True)
        settings, budget_bytes = fit(
            settings, shm_bytes=free_bytes(DEFAULT_SHM_DIR), disk_bytes=free_bytes(str(parent))
        )
        town = build_town(settings, map_dir, progress)
        options = [
            "--budget",
            str(budget_bytes),
            "--workers",
            "2",
            "--cache-dir",
            str(Path(map_dir, ".cache")),
        ]
        with (
            DaemonProcess(map_dir, options=options) as daemon,
            connect(daemon.endpoint, name="demo", shm_dir=daemon.shm_dir) as client,
            Fleet("shared", daemon.endpoint, settings.radius) as fleet,
        ):
            progress.stage("Driving, four processes on one copy", len(town.route))
            watched = _WatchedDaemon(daemon, client)
            shared = _drive(fleet, town.route, settings.pace_s, progress, watched)
            traffic = watched.traffic()
            resident = _resident_now(daemon)
        with Fleet("private", map_dir, settings.radius) as fleet:
            progress.stage("The same drive, four private copies", len(town.route))
            private = _drive(fleet, town.route, 0.0, progress, None)
        return DemoResult(
            settings,
            town,
            shared,
            private,
            traffic,
            resident=resident,
        )


def _drive(
    fleet: Fleet, route: Sequence[Pose], pace_s: float, progress: Progress, daemon: _WatchedDaemon | None
) -> DriveResult:
    """Follow the route with everybody, in step."""
    updates: list[StepReport] = []
    warm: list[StepReport] = []
    handed_bytes = 0
    start_s = 0.0
    reports: list[StepReport] = []
    for pose, started_s in _paced(route, pace_s):
        first = not reports
        loaded_before = daemon.loads() if daemon else 0
        reports = fleet.move_to(pose)
        if first:
            start_s = time.perf_counter() - started_s
        else:
            with_new = [report for report in reports if report.new]
            updates += with_new
            if daemon and daemon.loads() == loaded_before:
                warm += with_new
        handed_bytes += sum(report.new_bytes for report in reports)
        progress.step(reports, daemon.counters if daemon else None)
    pids = [*fleet.pids, *(daemon.process.pids() if daemon else ())]
    one = reports[0]
    return DriveResult(
        processes=len(pids),
        cells=one.cells,
        points=one.points,
        map_bytes=one.bytes,
        start_s=start_s,
        updates=len(updates),
        follow_s=_median([report.follow_s for report in updates]),
        follow_max_s=max((report.follow_s for report in updates), default=math.nan),
        complete_s=_median([report.complete_s for report in updates]),
        warm_updates=len(warm),
        warm_complete_s=_median([report.complete_s for report in warm]),
        handed_bytes=handed_bytes,
        memory=sum_memory(pids),
        shm_bytes=_shm_bytes(daemon.process) if daemon else 0,
    )


def _resident_now(daemon: DaemonProcess) -> list[CellRow]:
    """Read the table of resident cells as it is now or later: the daemon writes it four times a second."""
    asked_s = time.monotonic()
    while True:
        found = read_statistics(daemon.instance, daemon.shm_dir)
        if found.beat_age_s < time.monotonic() - asked_s or found.state != "healthy":
            return found.cells
        time.sleep(0.02)


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else math.nan


class _WatchedDaemon:
    """A daemon, and a client that reads its counters; what that itself costs is left out."""

    def __init__(self, process: DaemonProcess, client: Client) -> None:
        self.process = process
        self._client = client
        self._own = Traffic(0, 0, 0, 0)
        self.counters = self._first = self._ask()

    def _ask(self) -> dict[str, int]:
        reply = self._client.stats()
        # a reply's own bytes are in the next one's counters
        asked, answered = len(encode(Stats(reply.request))), len(encode(reply))
        own = self._own
        self._own = Traffic(own.requests + 1, own.request_bytes + asked, own.reply_bytes + answered, 0)
        return reply.counters

    def loads(self) -> int:
        """Read the counters; returns how many loads began so far."""
        self.counters = self._ask()
        return self.counters["loads_started"]

    def traffic(self) -> Traffic:
        """Return what others sent and got since the beginning."""
        start = self._own
        now = self._ask()
        grown = {name: now[name] - self._first[name] for name in now}
        return Traffic(
            requests=grown["requests"] - start.requests,
            request_bytes=grown["bytes_received"] - start.request_bytes,
            reply_bytes=grown["bytes_sent"] - start.reply_bytes,
            handles=grown["handles_sent"],
        )


def _paced(route: Sequence[Pose], pace_s: float) -> Iterator[tuple[Pose, float]]:
    """Yield the poses no faster than one per ``pace_s``: the drive is meant to be watched."""
    due_s = time.perf_counter()
    for pose in route:
        time.sleep(max(due_s - time.perf_counter(), 0.0))
        started_s = time.perf_counter()
        yield pose, started_s
        due_s = max(due_s + pace_s, started_s)


def _shm_bytes(daemon: DaemonProcess) -> int:
    """Measure every file of the daemon in the shared-memory directory."""
    total = 0
    for entry in os.scandir(daemon.shm_dir):
        if entry.name.startswith(f"shmmap.{daemon.instance}."):
            total += entry.stat(follow_symlinks=False).st_blocks * 512
    return total
