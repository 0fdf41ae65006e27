# SPDX-License-Identifier: Apache-2.0
"""One program on the map: ``shmmap-ndt follow`` localizes simulated scans, and the truth is known."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from shmmap.demo.demo_town import DemoSettings, Progress
from shmmap.demo.process_cpu import cpu_seconds
from shmmap.demo.process_memory import descendants
from shmmap.demo.program import Program
from shmmap.demo.scans import SEEN_METRES
from shmmap.demo.watched_daemon import statistics_now
from shmmap.errors import InternalError
from shmmap.processes.end_with_parent import with_us
from shmmap.testing.daemon_process import DaemonProcess

__all__ = ["Localization", "LocalizationResult"]

_PROGRAM: Final = "shmmap_clients.ndt_scan_matcher"
_WINDOW_METRES: Final = 80.0
_PATIENCE_S: Final = 300.0  # for a compiler on a slow machine


@dataclass(frozen=True, slots=True)
class LocalizationResult:
    """What the program found.

    Attributes
    ----------
    scans, trustworthy
        Localized, and of these the program itself trusts.
    error_m, error_max_m
        Distance of the found positions from the true ones: mean and largest, metres.
    scan_s
        From having a scan to having its pose, median.
    first_pose_s
        From starting the daemon, and then the program, until the first scan's pose was known.
    layers, layers_cpu_s
        NDT layers that the daemon computed for it, and the processor time of the daemon and its loaders
        meanwhile.
    document
        All that the program says (``--json``).
    """

    scans: int
    trustworthy: int
    error_m: float
    error_max_m: float
    scan_s: float
    first_pose_s: float
    layers: int
    layers_cpu_s: float
    document: dict[str, Any]


class Localization:
    """The program, and what it needs: scans and compiled kernels, made in the background.

    Parameters
    ----------
    settings
        Of the town.
    work
        Directory for scans and outputs.

    Used as a context manager: the preparation begins on entry, and nothing runs any more after exit.
    """

    missing: str
    """What is not installed, so that there is no localization; else empty."""

    def __init__(self, settings: DemoSettings, work: Path) -> None:
        self.missing = next((name for name in ("numba",) if importlib.util.find_spec(name) is None), "")
        self._work = work
        words = [str(work), str(settings.seed), *map(str, settings.blocks), str(settings.localized)]
        self._makers = [
            Program("simulated-scans", "shmmap.demo.scans", words, work),
            Program("shmmap-ndt-warmup", _PROGRAM, ["warmup"], work),
        ]
        self._running = contextlib.ExitStack()

    def __enter__(self) -> Localization:
        with contextlib.ExitStack() as stack:
            for maker in self._makers if not self.missing else ():
                stack.enter_context(maker)
            self._running = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running.close()

    def wait_prepared(self) -> None:
        """Wait for the scans and the kernels: what runs beside a measurement would be in it.

        Raises
        ------
        InternalError
            They could not be made.
        """
        for maker in self._makers if not self.missing else ():
            if code := maker.wait(_PATIENCE_S):
                raise InternalError(f"{maker.name} ended with {code}: {maker.last_words()}")

    def run(self, map_path: str, options: Sequence[str], progress: Progress) -> LocalizationResult:
        """Localize all scans, on a daemon that has yet to start and has nothing in memory.

        Parameters
        ----------
        options
            Of the daemon.

        Raises
        ------
        InternalError
            The program failed.
        """
        scans = sorted((self._work / "scans").iterdir())
        progress.stage("Localizing simulated LiDAR scans with shmmap-ndt", len(scans))
        started_s = time.perf_counter()
        first_pose_s = math.nan
        with contextlib.ExitStack() as stack:
            daemon = stack.enter_context(DaemonProcess(map_path, *options, command=with_us()))
            before_s = cpu_seconds(descendants(daemon.pid))
            program = Program("shmmap-ndt", _PROGRAM, self._words(daemon), self._work, piped=True)
            document: dict[str, Any] = {}
            for line in stack.enter_context(program).lines(_PATIENCE_S):
                document = json.loads(line)
                if "error_m" in document:
                    if math.isnan(first_pose_s):
                        first_pose_s = time.perf_counter() - started_s
                    progress.step(
                        note=f"{document['name']}: {document['error_m'] * 100:.1f} cm from the truth"
                    )
            if "frames" not in document:
                raise InternalError(f"shmmap-ndt ended early: {program.last_words()}")
            layers_cpu_s = cpu_seconds(descendants(daemon.pid)) - before_s
            layers = statistics_now(daemon).counters["layers_computed"]
        errors_m = document["errors"]["ate_m"]
        return LocalizationResult(
            scans=document["frames"],
            trustworthy=document["trustworthy"],
            error_m=errors_m["mean"],
            error_max_m=errors_m["max"],
            scan_s=document["latency_ms"]["p50"] / 1e3,
            first_pose_s=first_pose_s,
            layers=layers,
            layers_cpu_s=layers_cpu_s,
            document=document,
        )

    def _words(self, daemon: DaemonProcess) -> list[str]:
        return [
            "follow", "--scans", str(self._work / "scans"), "--truth", str(self._work / "truth.txt"),
            "--odometry", str(self._work / "odometry.txt"), "--endpoint", daemon.endpoint, "--json",
            "--json-lines", "-", "--quiet",
            "--map-radius", str(_WINDOW_METRES), "--lidar-radius", str(SEEN_METRES),
            "--update-distance", "10", "--route", str(self._work / "truth.txt"),
        ]  # fmt: skip
