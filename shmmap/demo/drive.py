# SPDX-License-Identifier: Apache-2.0
"""One drive of several processes, on one shared map or each with a copy of its own, and what it costs."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from shmmap.demo.consumer import Pose
from shmmap.demo.demo_town import Progress
from shmmap.demo.fleet import Fleet, StepReport
from shmmap.demo.process_cpu import cpu_seconds
from shmmap.demo.process_memory import ProcessMemory, sum_memory
from shmmap.demo.watched_daemon import WatchedDaemon

__all__ = ["DriveResult", "drive", "paced"]


@dataclass(frozen=True, slots=True)
class DriveResult:
    """One drive of several processes.

    Attributes
    ----------
    consumers
        Processes that follow the vehicle.
    processes
        How many in all, the daemon and its workers included.
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
    cpu_s
        Processor time of all processes since they were started, user and system.
    daemon_start_cpu_s
        The part of it that the daemon used before there was a client; 0 without a daemon.
    memory
        Of all processes at the end, as the kernel counts it.
    shm_bytes
        Shared memory in use at the end, mapped or not, as the file system counts it.
    """

    consumers: int
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
    cpu_s: float
    daemon_start_cpu_s: float
    memory: ProcessMemory
    shm_bytes: int

    @property
    def total_bytes(self) -> int:
        """All memory: what processes have for themselves, and shared memory once."""
        return self.memory.own_bytes + self.shm_bytes


def drive(
    fleet: Fleet, route: Sequence[Pose], pace_s: float, progress: Progress, daemon: WatchedDaemon | None
) -> DriveResult:
    """Follow the route with everybody, in step.

    Parameters
    ----------
    pace_s
        Least time per pose, seconds.
    daemon
        None where everybody has a copy of its own.
    """
    updates: list[StepReport] = []
    warm: list[StepReport] = []
    handed_bytes = 0
    start_s = 0.0
    reports: list[StepReport] = []
    loaded = daemon.loaded() if daemon else set()
    for pose, started_s in paced(route, pace_s):
        first, loaded_before = not reports, loaded
        reports = fleet.move_to(pose)
        if first:
            start_s = time.perf_counter() - started_s
        loaded = daemon.loaded() if daemon else set()
        if not first:
            with_new = [report for report in reports if report.new]
            updates += with_new
            if daemon and loaded <= loaded_before:
                warm += with_new
        handed_bytes += sum(report.new_bytes for report in reports)
        progress.step(reports, daemon.counters if daemon else None)
    pids = [*fleet.pids, *(daemon.pids() if daemon else ())]
    one = reports[0]
    return DriveResult(
        consumers=len(reports),
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
        cpu_s=cpu_seconds(pids),
        daemon_start_cpu_s=daemon.start_cpu_s if daemon else 0.0,
        memory=sum_memory(pids),
        shm_bytes=daemon.process.shm_bytes() if daemon else 0,
    )


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else math.nan


def paced(route: Sequence[Pose], pace_s: float) -> Iterator[tuple[Pose, float]]:
    """Yield the poses, and when each began, no faster than one per ``pace_s``."""
    due_s = time.perf_counter()
    for pose in route:
        time.sleep(max(due_s - time.perf_counter(), 0.0))
        started_s = time.perf_counter()
        yield pose, started_s
        due_s = max(due_s + pace_s, started_s)
