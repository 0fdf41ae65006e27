# SPDX-License-Identifier: Apache-2.0
"""Run the demonstration: a vehicle in a town, and many processes with a shared map or private copies.

Nothing is simulated but town and sensor: files on disk, a daemon process that is killed and restarted,
consumer processes, memory and processor time as counted by the kernel, a localization program.  Everything is
removed at the end.
"""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from shmmap.client.client import connect
from shmmap.demo.demo_town import (
    DemoSettings,
    TownMap,
    build_town,
    fit,
    free_bytes,
    free_memory_bytes,
)
from shmmap.demo.drive import (
    DriveResult,
    Fleet,
    OutageResult,
    drive,
    drive_through_outage,
)
from shmmap.demo.localization import (
    LocalizationResult,
    localize,
    missing_package,
    prepare,
    wait_prepared,
)
from shmmap.demo.program import Progress
from shmmap.processes.end_with_parent import with_us
from shmmap.processes.interrupts import scratch_directory
from shmmap.protocol.rows import CellRow
from shmmap.segment.names import DEFAULT_SHM_DIR
from shmmap.testing.daemon_process import DaemonProcess

_PREFETCH_SHARE: Final = "0.02"
"""The drive is faster than any vehicle; prefetching for its speed would load the whole town."""


@dataclass(frozen=True, slots=True)
class Round:
    """The same drive of several processes on one shared copy, and with private copies."""

    consumers: int
    shared: DriveResult
    private: DriveResult


@dataclass(frozen=True, slots=True)
class DemoResult:
    """All measurements of the demonstration.

    Attributes
    ----------
    radius
        Radius of every process's window, metres.
    rounds
        One round for each number of processes, ascending.
    resident
        The cells in shared memory at the end of the last round.
    outage
        Outage of the daemon in the last round.
    localization
        Result of the localization; None if the package ``missing`` is not installed.
    """

    radius: float
    town: TownMap
    rounds: list[Round]
    resident: list[CellRow]
    outage: OutageResult
    localization: LocalizationResult | None
    missing: str

    @property
    def one_more_bytes(self) -> tuple[float, float]:
        """Memory that each further process needs: with the shared map, and with private copies."""
        first, last = self.rounds[0], self.rounds[-1]
        more = last.consumers - first.consumers
        return (
            (last.shared.total_bytes - first.shared.total_bytes) / more,
            (last.private.total_bytes - first.private.total_bytes) / more,
        )

    @property
    def pays_from(self) -> int | None:
        """Number of processes from which sharing takes less memory; None if it never does."""
        shared, private = self.one_more_bytes
        if shared >= private:
            return None
        first = self.rounds[0]
        lost = first.shared.total_bytes - first.private.total_bytes
        return first.consumers + max(0, math.floor(lost / (private - shared)) + 1)


def run_demo(settings: DemoSettings, progress: Progress, *, map_dir: str | None = None) -> DemoResult:
    """Build the map, drive, measure, and clean up.

    Parameters
    ----------
    map_dir
        Directory in which the map is built and kept; by default a temporary one.

    Raises
    ------
    ConfigError
        There is not enough memory.
    BadRequest
        ``map_dir`` exists and is not empty.
    InternalError
        A process failed.
    """
    with contextlib.ExitStack() as stack:
        work = Path(stack.enter_context(scratch_directory("shmmap-demo-")))
        map_dir = os.path.abspath(map_dir or work / "map")
        parent = Path(map_dir).parent
        parent.mkdir(parents=True, exist_ok=True)
        settings, budget_bytes = fit(
            settings,
            shm_bytes=free_bytes(DEFAULT_SHM_DIR),
            disk_bytes=free_bytes(str(parent)),
            memory_bytes=free_memory_bytes(),
            copies=max(settings.counts),
        )
        options = [
            "--budget",
            str(budget_bytes),
            "--workers",
            "2",
            "--cache-dir",
            str(work / "cache"),
            "--prefetch-share",
            _PREFETCH_SHARE,
        ]
        missing = missing_package()
        makers = [] if missing else prepare(settings, work, stack)
        town = build_town(settings, map_dir, progress)
        if makers:
            progress.stage("Simulating LiDAR scans, compiling kernels", 1)
            wait_prepared(makers)
            progress.step()
        route = town.route + town.onward
        rounds = []
        for count in settings.counts:
            one = "1 process" if count == 1 else f"{count} processes"
            copies = ", private copy" if count == 1 else " with a private copy each"
            with Fleet(town.path, settings.radius, count, route, work) as fleet:
                progress.stage(f"Driving, {one}{copies}", len(town.route))
                private = drive(fleet, town.route, settings.pace_s, progress)
            with (
                DaemonProcess(town.path, *options, command=with_us()) as daemon,
                Fleet(daemon, settings.radius, count, route, work) as fleet,
            ):
                progress.stage(f"Driving, {one} on the copy that shmmap shares", len(town.route))
                shared = drive(fleet, town.route, settings.pace_s, progress)
                rounds.append(Round(count, shared, private))
                if count == settings.counts[-1]:
                    with connect(daemon.endpoint, name="shmmap demo") as client:
                        resident = client.list_cells()
                    progress.stage(f"Killing the daemon while {one} keep driving", len(town.onward))
                    outage = drive_through_outage(fleet, daemon, town.onward, progress)
        found = None if missing else localize(town.path, options, work, progress)
        return DemoResult(settings.radius, town, rounds, resident, outage, found, missing)
