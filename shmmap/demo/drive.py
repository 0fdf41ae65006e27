# SPDX-License-Identifier: Apache-2.0
"""One drive of several processes, on one shared map or each with a copy of its own, and what it costs."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from shmmap.client import Client
from shmmap.demo.consumer import Pose
from shmmap.demo.demo_town import Progress
from shmmap.demo.fleet import Fleet, StepReport
from shmmap.demo.process_cpu import cpu_seconds
from shmmap.demo.process_memory import ProcessMemory, descendants, sum_memory
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import Stats
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["DriveResult", "Traffic", "WatchedDaemon", "drive", "paced"]


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


class WatchedDaemon:
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

    def pids(self) -> list[int]:
        """Return the daemon and its workers."""
        return descendants(self.process.pid)

    def loads(self) -> int:
        """Read the counters; returns how many loads began so far."""
        self.counters = self._ask()
        return self.counters["loads_started"]

    def layers_computed(self) -> int:
        """Read the counters; returns how many layers its present life has computed."""
        return self._ask()["layers_computed"]

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
    loaded = daemon.loads() if daemon else 0
    for pose, started_s in paced(route, pace_s):
        first, loaded_before = not reports, loaded
        reports = fleet.move_to(pose)
        if first:
            start_s = time.perf_counter() - started_s
        loaded = daemon.loads() if daemon else 0
        if not first:
            with_new = [report for report in reports if report.new]
            updates += with_new
            if daemon and loaded == loaded_before:
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
