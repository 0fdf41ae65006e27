# SPDX-License-Identifier: Apache-2.0
"""The demonstration: a town, a vehicle, many processes on one copy of the map, and the same with a copy each.

Everything is real: files on disk, a daemon process that is killed and comes back, consumer processes, memory
and processor time as the kernel counts them, a program that localizes.  It leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shmmap.demo.demo_town import (
    DemoSettings,
    Progress,
    TownMap,
    build_town,
    fit,
    free_bytes,
    free_memory_bytes,
)
from shmmap.demo.drive import DriveResult, drive
from shmmap.demo.fleet import Fleet
from shmmap.demo.localization import Localization, LocalizationResult
from shmmap.demo.outage import OutageResult, drive_through_outage
from shmmap.demo.three_programs import ThreeProgramsResult, run_three_programs
from shmmap.demo.watched_daemon import Traffic, WatchedDaemon, statistics_now
from shmmap.processes.end_with_parent import with_us
from shmmap.processes.interrupts import scratch_directory
from shmmap.segment.directory import DEFAULT_SHM_DIR
from shmmap.statistics.cell_rows import CellRow
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["FULL_COUNTS", "DemoResult", "Round", "run_demo"]

FULL_COUNTS: Final = (1, 2, 4, 8, 16)
"""Processes that drive together in a full demonstration."""
PREFETCH_SHARE: Final = "0.02"
"""The drive is faster than any vehicle: as far ahead as that needs, all of the town would be fetched."""


@dataclass(frozen=True, slots=True)
class Round:
    """The same drive on one shared copy, and with a private copy in each process."""

    shared: DriveResult
    private: DriveResult


@dataclass(slots=True)
class DemoResult:
    """Everything the demonstration measured.

    Attributes
    ----------
    rounds
        By how many processes drove.
    outage
        Of the daemon, with ``settings.many`` processes.
    traffic, resident
        Messages of the shared drive of that many processes, and the cells in shared memory at its end.
    localization
        None where a package is missing, see ``missing``; in a full demonstration ``programs`` holds it.
    missing
        The package that the localization lacks.
    programs
        The three programs of a full demonstration.
    """

    settings: DemoSettings
    town: TownMap
    rounds: dict[int, Round]
    outage: OutageResult
    traffic: Traffic
    resident: list[CellRow]
    localization: LocalizationResult | None = None
    missing: str = ""
    programs: ThreeProgramsResult | None = None

    @property
    def many(self) -> Round:
        """The drives of ``settings.many`` processes."""
        return self.rounds[self.settings.many]

    @property
    def one_more_bytes(self) -> tuple[float, float]:
        """What one process more costs in memory, from the first round to the last: shared, private."""
        first, last = min(self.rounds), max(self.rounds)
        shared, private = (
            (after - before) / (last - first)
            for before, after in (
                (self.rounds[first].shared.total_bytes, self.rounds[last].shared.total_bytes),
                (self.rounds[first].private.total_bytes, self.rounds[last].private.total_bytes),
            )
        )
        return shared, private


def run_demo(
    settings: DemoSettings,
    progress: Progress,
    *,
    map_dir: str | None = None,
    full: bool = False,
) -> DemoResult:
    """Build, drive, measure, clean up.

    Parameters
    ----------
    map_dir
        Where the map is built and stays; by default in a temporary directory that is removed.
    full
        Whether three programs drive in the end, and not just the localization.

    Raises
    ------
    ConfigError
        There is not enough memory.
    BadRequest
        ``map_dir`` exists and is not empty.
    InternalError
        A process failed.
    """
    many = settings.many
    with contextlib.ExitStack() as stack:
        scratch = Path(stack.enter_context(scratch_directory("shmmap-demo-")))
        map_dir = os.path.abspath(map_dir or scratch / "map")
        parent = Path(map_dir).parent
        parent.mkdir(parents=True, exist_ok=True)
        settings, budget_bytes = fit(
            settings,
            shm_bytes=free_bytes(DEFAULT_SHM_DIR),
            disk_bytes=free_bytes(str(parent)),
            memory_bytes=free_memory_bytes(),
            copies=max(settings.counts),
        )
        options = ["--budget", str(budget_bytes), "--workers", "2", "--cache-dir", str(scratch / "cache")]
        options += ["--prefetch-share", PREFETCH_SHARE]
        localization = None if full else stack.enter_context(Localization(settings, scratch))
        town = build_town(settings, map_dir, progress)
        if localization is not None:
            progress.stage("Simulating LiDAR scans, compiling kernels", 1)
            localization.wait_prepared()
            progress.step()
        show = _Show(settings, town, options, progress)
        rounds = {count: Round(*show.compare(count)) for count in settings.counts if count != many}
        private = show.private(many)
        with DaemonProcess(town.path, *options, command=with_us()) as daemon:
            watched = WatchedDaemon(daemon)
            with Fleet("shared", daemon.endpoint, settings.radius, many, town.way) as fleet:
                rounds[many] = Round(show.shared(fleet, watched), private)
                traffic, resident = watched.traffic(), statistics_now(daemon).cells
                progress.stage(f"Killing the daemon while {many} processes keep driving", len(town.onward))
                outage = drive_through_outage(fleet, daemon, town.onward, progress)
        result = DemoResult(settings, town, dict(sorted(rounds.items())), outage, traffic, resident)
        if localization is None:
            with DaemonProcess(town.path, *options, command=with_us()) as daemon:
                result.programs = run_three_programs(settings, daemon, scratch, progress)
        elif localization.missing:
            result.missing = localization.missing
        else:
            result.localization = localization.run(town.path, options, progress)
        return result


class _Show:
    """The drives, each with processes of its own."""

    def __init__(
        self, settings: DemoSettings, town: TownMap, options: Sequence[str], progress: Progress
    ) -> None:
        self._settings, self._town, self._options, self._progress = settings, town, options, progress

    def compare(self, count: int) -> tuple[DriveResult, DriveResult]:
        """Drive with a copy each, then on a daemon of their own; returns shared, private."""
        private = self.private(count)
        with DaemonProcess(self._town.path, *self._options, command=with_us()) as daemon:
            watched = WatchedDaemon(daemon)
            with Fleet("shared", daemon.endpoint, self._settings.radius, count, self._town.way) as fleet:
                return self.shared(fleet, watched), private

    def private(self, count: int) -> DriveResult:
        """Drive with a copy each."""
        with Fleet("private", self._town.path, self._settings.radius, count, self._town.way) as fleet:
            self._stage(
                f"{_processes(count)} with a private copy each" if count > 1 else "1 process, private copy"
            )
            return drive(fleet, self._town.route, self._settings.pace_s, self._progress, None)

    def shared(self, fleet: Fleet, daemon: WatchedDaemon) -> DriveResult:
        """Drive on the daemon's copy."""
        self._stage(f"{_processes(len(fleet.pids))} on the copy that shmmap shares")
        return drive(fleet, self._town.route, self._settings.pace_s, self._progress, daemon)

    def _stage(self, text: str) -> None:
        self._progress.stage(f"Driving, {text}", len(self._town.route))


def _processes(count: int) -> str:
    return f"{count} process" + ("es" if count > 1 else "")
