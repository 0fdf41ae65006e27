# SPDX-License-Identifier: Apache-2.0
"""Drives of several processes that follow one vehicle, on one shared map or each with a private copy.

The last drive goes on while the daemon is killed and starts again.
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
from shmmap.statistics.reader import read_statistics
from shmmap.statistics.snapshot import Snapshot
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["DriveResult", "Fleet", "OutageResult", "drive", "drive_through_outage", "statistics_now"]

_TIMEOUT_S: Final = 60.0
_SHOWN: Final = 8  # consumers on a spectator's screen
_POLL_S: Final = 0.02
_BEFORE: Final = 5  # poses with the daemon, to begin with
_ALONE: Final = 12  # poses before it is started again
_PACE_S: Final = 0.1  # between poses: a control loop at 10 Hz


@dataclass(frozen=True, slots=True)
class DriveResult:
    """One drive of several processes.

    Attributes
    ----------
    consumers, processes
        Processes that follow the vehicle, and these with the daemon and its workers.
    cells, points, map_bytes
        What one consumer holds at the end; bytes of its columns.
    start_s
        From the first pose until all have their first window.
    follow_max_s
        How long a control loop waited for the map after that at most.
    cpu_s
        Processor time of all processes since they were started, user and system.
    daemon_start_cpu_s
        The part of it that the daemon used before the drive; 0 without a daemon.
    process_bytes, private_bytes
        Memory of the processes at the end without shared memory; pages that one process alone maps.
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
    """What the consumers did while there was no daemon.

    Attributes
    ----------
    down_s
        From SIGKILL until the daemon was ready again.
    poses, counted
        Poses that all consumers answered in this time, and points of the map that each read.
    longest_pause_s
        Longest time between two answers of a control loop until all was as before, with the pace of poses.
    segments, adopted
        In shared memory before SIGKILL, and taken over by the next daemon.
    """

    down_s: float
    poses: int
    counted: list[int]
    longest_pause_s: float
    segments: int
    adopted: int


class Fleet:
    """Processes of `shmmap.demo.consumer`, which take their tasks in turn.

    Parameters
    ----------
    source
        The daemon of a shared map, or the directory of a map of which each reads a private copy.
    radius
        Of every consumer's window, metres.
    consumers
        How many.
    route
        The poses to come.
    work
        Directory for what they write to stderr.

    Attributes
    ----------
    daemon
        That of a shared map, else None.

    Used as a context manager: all consumers are ready on entry, and gone on exit.

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
        """Process ids, in the order of the tasks."""
        return [program.pid for program in self._programs]

    def move_to(self, pose: Pose, progress: Progress, *, drive_on: bool = False) -> list[StepReport]:
        """Send all to a pose, wait for their answers, show and return them in the order of the tasks.

        Parameters
        ----------
        drive_on
            Whether they compute on the cells they have, instead of waiting until none is missing.
        """
        answers = self._ask(Step(pose, drive_on))
        reports = [msgspec.json.decode(answer, type=StepReport) for answer in answers]
        lines = self._consumer_lines(reports)
        if self.daemon is not None and not drive_on:  # the daemon is not killed
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
        """Return a line for each consumer, as far as a screen has room for them."""
        lines = []
        for task, report in list(zip(self._tasks, reports, strict=True))[:_SHOWN]:
            did = f"{report.counted / 1e6:.1f} M points read" if report.counted else ""
            did = did or format_duration(report.complete_s)
            lines.append(f"{task:14}{report.cells:>4} cells  {did:>18}  {report.answer}")
        if len(reports) > _SHOWN:
            lines.append(f"and {len(reports) - _SHOWN} more")
        return lines


def drive(fleet: Fleet, route: Sequence[Pose], pace_s: float, progress: Progress) -> DriveResult:
    """Follow the route with all consumers, in step, at least ``pace_s`` seconds per pose."""
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
    """Drive on, kill the daemon, drive on, start it again, drive on until all is as before and to the end.

    Parameters
    ----------
    route
        If it is too short the vehicle waits at its end.
    pace_s
        Least time per pose, seconds.

    Raises
    ------
    InternalError
        The daemon does not start again.
    NoAnswer
        A consumer has not all its cells a minute after SIGKILL.
    """
    reports: list[StepReport] = []
    poses = itertools.chain(route, itertools.repeat(route[-1]))
    driven, longest_pause_s = 0, 0.0
    due_s = time.perf_counter()

    def step() -> None:
        """Send all to the next pose when it is due; they answer with the cells they have."""
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
    step()  # the first report after it is about a pose before it
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
    """Read a daemon's statistics as they are now or later: it writes them four times a second.

    Unlike the request `Stats` this costs the daemon no processor time.
    """
    asked_s = time.monotonic()
    while True:
        found = read_statistics(daemon.instance, daemon.shm_dir)
        if found.beat_age_s < time.monotonic() - asked_s or found.state != "healthy":
            return found
        time.sleep(_POLL_S)
