# SPDX-License-Identifier: Apache-2.0
"""Drives of several processes that follow one vehicle, with one shared map or with private copies.

The last drive continues while the daemon is killed and restarted.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Literal

import msgspec

from shmmap.demo.consumer import TASKS, Pose, Step, StepReport
from shmmap.demo.program import Program, Progress, cpu_seconds, descendants, process_memory
from shmmap.errors import NoAnswer
from shmmap.quantities import format_bytes, format_duration
from shmmap.statistics.reader import Snapshot, read_statistics
from shmmap.testing.daemon_process import DaemonProcess

_TIMEOUT_S: Final = 60.0
_SHOWN: Final = 8  # consumers shown on the screen
_POLL_S: Final = 0.02
_BEFORE: Final = 5  # poses before the daemon is killed
_ALONE: Final = 12  # poses before the daemon is restarted
_PACE_S: Final = 0.1  # seconds between poses: a control loop at 10 Hz


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Results of one drive of several processes.

    Attributes
    ----------
    consumers, processes
        Number of processes that follow the vehicle, and the same with daemon and workers included.
    cells, points, map_bytes
        Cells that one consumer holds at the end, their points, and bytes of their columns.
    start_s
        Seconds from the first pose until all consumers have their first window.
    follow_max_s
        Longest time that a control loop waited for the map after that, seconds.
    cpu_s
        User and system time of all processes since their start, seconds.
    daemon_start_cpu_s
        Part of ``cpu_s`` that the daemon used before the drive; 0 without a daemon.
    process_bytes, private_bytes
        Memory of the processes at the end, without shared memory; and pages that only one process maps.
    shm_bytes
        Shared memory in use at the end, mapped or not, as the file system counts it.
    total_bytes
        All memory: ``process_bytes``, and shared memory once.
    """

    consumers: int
    processes: int
    cells: int
    points: int
    map_bytes: int
    start_s: float
    follow_max_s: float
    cpu_s: float
    daemon_start_cpu_s: float
    process_bytes: int
    private_bytes: int
    shm_bytes: int
    total_bytes: int


@dataclass(frozen=True, slots=True)
class OutageResult:
    """Results of the consumers while no daemon ran.

    Attributes
    ----------
    down_s
        From SIGKILL until the daemon was ready again.
    poses, counted
        Poses that all consumers processed in this time, and points of the map that each of them read.
    longest_pause_s
        Longest time between two replies of a control loop until full recovery, including the pace of poses.
    segments, adopted
        Segments in shared memory before SIGKILL, and those that the next daemon adopted.
    """

    down_s: float
    poses: int
    counted: list[int]
    longest_pause_s: float
    segments: int
    adopted: int


class Fleet:
    """Processes of `shmmap.demo.consumer`, which receive their tasks in rotation.

    Parameters
    ----------
    source
        The daemon of a shared map, or the directory of a map that each process reads privately.
    radius
        Radius of every consumer's window, metres.
    consumers
        Number of consumers.
    route
        The poses of the drive.
    work
        Directory for the consumers' stderr.

    Attributes
    ----------
    daemon
        Daemon of a shared map, else None.

    Used as a context manager, all consumers are ready on entry, and have ended on exit.

    Raises
    ------
    InternalError
        A consumer ended or did not answer within a minute; the message holds its last words.
    """

    def __init__(
        self, source: DaemonProcess | str, radius: float, consumers: int, route: Sequence[Pose], work: Path
    ) -> None:
        kind: Literal["private", "shared"] = "private" if isinstance(source, str) else "shared"
        where = source if isinstance(source, str) else source.endpoint
        self.daemon = None if isinstance(source, str) else source
        self._tasks = list(itertools.islice(itertools.cycle(TASKS), consumers))
        self._programs = [
            Program(f"consumer {number}", "shmmap.demo.consumer", [kind, where, str(radius), task], work)
            for number, task in enumerate(self._tasks)
        ]
        self._route = route
        self._running = contextlib.ExitStack()

    def __enter__(self) -> Fleet:
        with contextlib.ExitStack() as stack:
            for program in self._programs:
                stack.enter_context(program)
            self._ask(self._route)
            self._running = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running.close()

    @property
    def pids(self) -> list[int]:
        """Process ids, in the order of the consumers."""
        return [program.pid for program in self._programs]

    def move_to(self, pose: Pose, progress: Progress, *, drive_on: bool = False) -> list[StepReport]:
        """Send a pose to all, wait for the replies, and show and return them in the order of the consumers.

        Parameters
        ----------
        drive_on
            Whether consumers compute on the cells they have, instead of waiting for missing ones.
        """
        answers = self._ask(Step(pose, drive_on))
        reports = [msgspec.json.decode(answer, type=StepReport) for answer in answers]
        lines = self._consumer_lines(reports)
        if self.daemon is not None and not drive_on:  # this drive does not kill the daemon
            counters = read_statistics(self.daemon.instance, self.daemon.shm_dir).counters
            used_bytes = counters["bytes_resident"] + counters["bytes_zombie"]
            lines.append(
                f"shared memory: {counters['cells_resident']} cells, {format_bytes(used_bytes)} of"
                f" {format_bytes(counters['budget_bytes'])}, {counters['evictions']} evicted"
            )
        progress.step(*lines)
        return reports

    def _ask(self, question: object) -> list[str]:
        line = msgspec.json.encode(question)
        for program in self._programs:
            program.write_line(line)
        return [program.read_line(_TIMEOUT_S) for program in self._programs]

    def _consumer_lines(self, reports: Sequence[StepReport]) -> list[str]:
        """Return a line for each consumer, as many as fit on the screen."""
        lines = []
        for task, report in list(zip(self._tasks, reports, strict=True))[:_SHOWN]:
            did = f"{report.counted / 1e6:.1f} M points read" if report.counted else ""
            did = did or format_duration(report.complete_s)
            lines.append(f"{task:14}{report.cells:>4} cells  {did:>18}  {report.answer}")
        if len(reports) > _SHOWN:
            lines.append(f"and {len(reports) - _SHOWN} more")
        return lines


def drive(fleet: Fleet, route: Sequence[Pose], pace_s: float, progress: Progress) -> DriveResult:
    """Follow the route with all consumers in step, at least ``pace_s`` seconds per pose."""
    daemon = fleet.daemon
    start_cpu_s = cpu_seconds(descendants(daemon.pid)) if daemon else 0.0
    reports: list[StepReport] = []
    start_s = follow_max_s = 0.0
    for pose in route:
        due_s = time.perf_counter() + pace_s
        reports = fleet.move_to(pose, progress)
        if not start_s:
            start_s = time.perf_counter() - (due_s - pace_s)
        else:
            follow_max_s = max(follow_max_s, *(report.follow_s for report in reports))
        time.sleep(max(due_s - time.perf_counter(), 0.0))
    pids = [*fleet.pids, *(descendants(daemon.pid) if daemon else ())]
    memory = [process_memory(pid) for pid in pids]
    process_bytes = sum(one.own_bytes for one in memory)
    shm_bytes = daemon.shm_bytes() if daemon else 0
    return DriveResult(
        consumers=len(reports),
        processes=len(pids),
        cells=reports[0].cells,
        points=reports[0].points,
        map_bytes=reports[0].bytes,
        start_s=start_s,
        follow_max_s=follow_max_s,
        cpu_s=cpu_seconds(pids),
        daemon_start_cpu_s=start_cpu_s,
        process_bytes=process_bytes,
        private_bytes=sum(one.private_bytes for one in memory),
        shm_bytes=shm_bytes,
        total_bytes=process_bytes + shm_bytes,
    )


def drive_through_outage(
    fleet: Fleet,
    daemon: DaemonProcess,
    route: Sequence[Pose],
    progress: Progress,
    *,
    pace_s: float = _PACE_S,
) -> OutageResult:
    """Kill the daemon during a drive, restart it, and drive on to full recovery and the route's end.

    Parameters
    ----------
    route
        Poses of the drive; if they are too few the vehicle waits at the last.
    pace_s
        Minimum time per pose, seconds.

    Raises
    ------
    InternalError
        The daemon fails to restart.
    NoAnswer
        A consumer still lacks cells a minute after SIGKILL.
    """
    reports: list[StepReport] = []
    poses = itertools.chain(route, itertools.repeat(route[-1]))
    driven, longest_pause_s = 0, 0.0
    due_s = time.perf_counter()

    def step() -> None:
        """Send the next pose when it is due; consumers reply with the cells they have."""
        nonlocal reports, driven, due_s, longest_pause_s
        time.sleep(max(due_s - time.perf_counter(), 0.0))
        due_s = max(due_s, time.perf_counter() - pace_s) + pace_s
        reports = fleet.move_to(next(poses), progress, drive_on=True)
        driven += 1
        longest_pause_s = max(longest_pause_s, *(report.paused_s for report in reports))

    for _ in range(_BEFORE):
        step()
    segments = sum(not name.endswith(".zombie") for name in daemon.segments())
    before, longest_pause_s = reports, 0.0
    daemon.kill()
    killed_s = time.perf_counter()
    progress.event(f"The daemon is killed (SIGKILL); {len(before)} processes keep driving without it")
    for _ in range(_ALONE):
        step()
    progress.event("The daemon starts again")
    daemon.launch()
    while not daemon.wait_ready(max(due_s - time.perf_counter(), 0.0)):
        step()
        if time.perf_counter() - killed_s > _TIMEOUT_S:
            raise NoAnswer(f"the daemon is not ready again after {_TIMEOUT_S:g} s")
    down_s, poses_alone, after = time.perf_counter() - killed_s, driven - _BEFORE, reports
    step()  # the first report after the restart is about an earlier pose
    step()
    while not all(report.current for report in reports):
        if time.perf_counter() - killed_s > down_s + _TIMEOUT_S:
            raise NoAnswer(f"a window is not complete {_TIMEOUT_S:g} s after the daemon's return")
        step()
    result = OutageResult(
        down_s=down_s,
        poses=poses_alone,
        counted=[b.counted - a.counted for a, b in zip(before, after, strict=True)],
        longest_pause_s=longest_pause_s,
        segments=segments,
        adopted=statistics_now(daemon).counters["adopted"],
    )
    progress.event(f"It is back with {result.adopted} of {segments} segments that were in shared memory")
    while driven < len(route):
        step()
    return result


def statistics_now(daemon: DaemonProcess) -> Snapshot:
    """Read statistics that a daemon writes after this call; it writes them every second at least.

    Unlike the request `Stats` this costs the daemon no processor time.
    """
    asked_s = time.monotonic()
    while True:
        found = read_statistics(daemon.instance, daemon.shm_dir)
        if found.beat_age_s < time.monotonic() - asked_s or found.state != "healthy":
            return found
        time.sleep(_POLL_S)
