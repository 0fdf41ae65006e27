# SPDX-License-Identifier: Apache-2.0
"""One program on the map: ``shmmap-ndt follow`` localizes simulated scans, and the truth is known."""

from __future__ import annotations

import contextlib
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from shmmap.demo.demo_town import DemoSettings, Progress
from shmmap.demo.drive import WatchedDaemon
from shmmap.demo.process_cpu import cpu_seconds
from shmmap.demo.program import Program
from shmmap.demo.scans import SEEN_METRES
from shmmap.errors import InternalError

__all__ = ["Localization", "LocalizationResult"]

_PROGRAM: Final = "shmmap_clients.ndt_scan_matcher"
_WINDOW_METRES: Final = 80.0
_LENGTH_METRES: Final = 80.0
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
        words = [str(work), str(settings.seed), *map(str, settings.blocks), str(_LENGTH_METRES)]
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

    def run(self, daemon: WatchedDaemon, progress: Progress) -> LocalizationResult:
        """Localize all scans on the daemon's map.

        Raises
        ------
        InternalError
            The program failed.
        """
        words = [
            "follow", "--scans", str(self._work / "scans"), "--truth", str(self._work / "truth.txt"),
            "--odometry", str(self._work / "odometry.txt"), "--endpoint", daemon.process.endpoint, "--json",
            "--json-lines", "/dev/stdout", "--quiet",
            "--map-radius", str(_WINDOW_METRES), "--lidar-radius", str(SEEN_METRES),
            "--update-distance", "10",
        ]  # fmt: skip
        computed, cpu_s = daemon.layers_computed(), cpu_seconds(daemon.pids())
        scans = sorted((self._work / "scans").iterdir())
        progress.stage("Localizing simulated LiDAR scans with shmmap-ndt", len(scans))
        with Program("shmmap-ndt", _PROGRAM, words, self._work, piped=True) as program:
            document: dict[str, Any] = {}
            for line in program.lines(_PATIENCE_S):
                document = json.loads(line)
                if "error_m" in document:
                    progress.step(
                        note=f"{document['name']}: {document['error_m'] * 100:.1f} cm from the truth"
                    )
            if "frames" not in document:
                raise InternalError(f"shmmap-ndt ended early: {program.last_words()}")
        errors_m = document["errors"]["ate_m"]
        return LocalizationResult(
            scans=document["frames"],
            trustworthy=document["trustworthy"],
            error_m=errors_m["mean"],
            error_max_m=errors_m["max"],
            scan_s=document["latency_ms"]["p50"] / 1e3,
            layers=daemon.layers_computed() - computed,
            layers_cpu_s=cpu_seconds(daemon.pids()) - cpu_s,
            document=document,
        )
