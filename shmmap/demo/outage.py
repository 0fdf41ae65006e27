# SPDX-License-Identifier: Apache-2.0
"""A drive whose daemon is killed with SIGKILL and starts again, and all processes continue."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from shmmap.demo.consumer import Pose
from shmmap.demo.demo_town import Progress
from shmmap.demo.fleet import Fleet, StepReport
from shmmap.demo.watched_daemon import statistics_now
from shmmap.errors import NoAnswer
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["OutageResult", "drive_through_outage"]

_BEFORE: Final = 5  # poses with the daemon, to begin with
_ALONE: Final = 12  # poses before it is started again
_PACE_S: Final = 0.1  # between poses: a control loop at 10 Hz
_PATIENCE_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class OutageResult:
    """What the consumers did meanwhile.

    Attributes
    ----------
    consumers
        How many.
    down_s
        From SIGKILL until the daemon said again that it is ready.
    poses
        That everybody answered in this time.
    counted
        Points of the map that each consumer read in this time.
    follow_max_s
        Longest time that a control loop waited for the map, until all was as before.
    longest_pause_s
        Longest time between two answers of a control loop, likewise; it includes the pace of the poses.
    pace_s
        Between the poses.
    current_s
        From the daemon's being ready until all consumers had all cells for their pose.
    segments, adopted
        In shared memory before SIGKILL, and taken over by the daemon's next life.
    """

    consumers: int
    down_s: float
    poses: int
    counted: tuple[int, ...]
    follow_max_s: float
    longest_pause_s: float
    pace_s: float
    current_s: float
    segments: int
    adopted: int


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

    Raises
    ------
    InternalError
        The daemon does not start again.
    NoAnswer
        A consumer has not all its cells a minute after the daemon was ready.
    """
    leg = _Leg(fleet, route, pace_s, progress)
    for _ in range(_BEFORE):
        leg.step()
    segments = sum(not name.endswith(".zombie") for name in daemon.segments())
    before = leg.reports
    daemon.kill()
    killed_s = time.perf_counter()
    leg.follow_max_s = leg.longest_pause_s = 0.0
    progress.event(f"The daemon is killed (SIGKILL); {len(before)} processes keep driving without it")
    first = leg.driven
    for _ in range(_ALONE):
        leg.step()
    progress.event("The daemon starts again")
    daemon.launch()
    while not daemon.wait_ready(leg.due_in_s()):
        leg.step()
        if time.perf_counter() - killed_s > _PATIENCE_S:
            raise NoAnswer(f"the daemon is not ready again after {_PATIENCE_S:g} s")
    ready_s = time.perf_counter()
    poses, after = leg.driven - first, leg.reports
    leg.step()  # the first report after it tells of a pose before it
    while True:
        leg.step()
        if all(report.current for report in leg.reports):
            break
        if time.perf_counter() - ready_s > _PATIENCE_S:
            raise NoAnswer(f"a window is not complete {_PATIENCE_S:g} s after the daemon's return")
    current_s = time.perf_counter() - ready_s
    adopted = statistics_now(daemon).counters["adopted"]
    progress.event(f"It is back with {adopted} of {segments} segments that were in shared memory")
    result = OutageResult(
        consumers=len(before),
        down_s=ready_s - killed_s,
        poses=poses,
        counted=tuple(b.counted - a.counted for a, b in zip(before, after, strict=True)),
        follow_max_s=leg.follow_max_s,
        longest_pause_s=leg.longest_pause_s,
        pace_s=pace_s,
        current_s=current_s,
        segments=segments,
        adopted=adopted,
    )
    while leg.driven < len(route):
        leg.step()
    return result


class _Leg:
    """The vehicle on its way; everybody answers every pose with the cells it has."""

    def __init__(self, fleet: Fleet, route: Sequence[Pose], pace_s: float, progress: Progress) -> None:
        self._fleet, self._route, self._pace_s, self._progress = fleet, route, pace_s, progress
        self._due_s = time.perf_counter()
        self.driven = 0
        self.reports: list[StepReport] = []
        self.follow_max_s = self.longest_pause_s = 0.0

    def due_in_s(self) -> float:
        """Seconds until the next pose."""
        return max(self._due_s - time.perf_counter(), 0.0)

    def step(self) -> None:
        """Send everybody to the next pose when it is due."""
        time.sleep(self.due_in_s())
        started_s = time.perf_counter()
        pose = self._route[min(self.driven, len(self._route) - 1)]
        self.reports = self._fleet.move_to(pose, drive_on=True)
        self.driven += 1
        self._due_s = max(self._due_s + self._pace_s, started_s)
        self.follow_max_s = max(self.follow_max_s, *(report.follow_s for report in self.reports))
        self.longest_pause_s = max(self.longest_pause_s, *(report.paused_s for report in self.reports))
        self._progress.step(self.reports)
