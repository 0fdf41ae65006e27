# SPDX-License-Identifier: Apache-2.0
"""Localization, compare filter and elevation map on the demonstration's daemon: a program that runs them.

``python -m shmmap_clients.demo`` simulates the drive, runs the three beside one another, and knows the truth.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from shmmap.demo.demo_town import DemoSettings, Progress
from shmmap.demo.program import Program
from shmmap.errors import InternalError
from shmmap.processes.interrupts import scratch_directory
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["ThreeProgramsResult", "run_three_programs"]

_STEP_METRES: Final = 2.0
_PATIENCE_S: Final = 900.0  # the elevation map may just have begun when the last scan was sent


@dataclass(frozen=True, slots=True)
class ThreeProgramsResult:
    """What came of it.

    Attributes
    ----------
    document
        What the program says, see `shmmap_clients.demo.entry`.
    picture_svg
        The points that the compare filter kept and removed.
    """

    document: dict[str, Any]
    picture_svg: str


def run_three_programs(
    settings: DemoSettings, daemon: DaemonProcess, work: Path, progress: Progress
) -> ThreeProgramsResult:
    """Run them on the daemon's map, which is the settings' town.

    Raises
    ------
    InternalError
        A program failed.
    """
    picture = work / "compare.svg"
    words = [
        "--endpoint", daemon.endpoint, "--shm-dir", daemon.shm_dir, "--instance", daemon.instance,
        "--seed", str(settings.seed), "--blocks", *map(str, settings.blocks),
        "--density", str(settings.density), "--length", str(settings.scanned), "--step", str(_STEP_METRES),
        "--picture", str(picture),
    ]  # fmt: skip
    scans = int(settings.scanned / _STEP_METRES) + 1
    progress.stage("Driving: localization, compare filter and elevation map on one copy", scans)
    with (
        # its sockets under /tmp whatever TMPDIR says: a socket's path holds 107 bytes
        scratch_directory("shmmap-demo-", "/tmp") as sockets,  # noqa: S108
        Program(
            "three-programs", "shmmap_clients.demo", [*words, "--work", sockets], work, piped=True
        ) as program,
    ):
        last: dict[str, Any] = {}
        for line in program.lines(_PATIENCE_S):
            last = json.loads(line)
            if "programs" not in last:
                progress.step()
        if "programs" not in last:
            raise InternalError(f"the three programs ended early: {program.last_words()}")
        return ThreeProgramsResult(last, picture.read_text(encoding="utf-8"))
