# SPDX-License-Identifier: Apache-2.0
"""A drive: points of each scan that the map does not explain, with counts and times over all scans."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from shmmap import MapWindow, ShmmapError, WindowUpdate
from shmmap_clients.compare_map_filter.filter import CompareMapFilter, Comparison
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.spread import RunningSpread


@dataclass(frozen=True, slots=True, eq=False)
class ComparedScan:
    """A scan and its comparison with the map.

    Attributes
    ----------
    scan, comparison
        The scan, sensor frame, and the result with its kept points.
    missing
        Description of the window's cells missing during the comparison; empty if it was complete.
    """

    scan: Scan
    comparison: Comparison
    missing: str = ""


class ScanComparer:
    """Comparer of scans with the window around their poses.

    Parameters
    ----------
    window
        Window of the rule's layer.
    compare
        Filter that compares.
    first_wait_s, wait_s
        Time that the first scan and each later one may wait for the window's cells, seconds; None: no wait.
    """

    def __init__(
        self, window: MapWindow, compare: CompareMapFilter, *, first_wait_s: float, wait_s: float | None
    ) -> None:
        self._window = window
        self._compare = compare
        self._wait_s: float | None = first_wait_s
        self._later_wait_s = wait_s

    def __call__(self, scan: Scan) -> ComparedScan:
        """Compare the next scan.

        Raises
        ------
        BadRequest
            The scan has no pose.
        ShmmapError
            The daemon cannot be reached, and there has been no cell yet.
        """
        T = scan.pose
        update = self._window.move_to(float(T[0, 3]), float(T[1, 3]), wait=self._wait_s)
        error = self._window.error
        # use one state of the window, which may change during the comparison
        cells = (*update.added, *update.kept, *update.changed)
        if error is not None and not cells:
            raise error
        self._wait_s = self._later_wait_s
        comparison = self._compare.use_cells(cells).apply(scan.xyz, T)
        return ComparedScan(scan, comparison, _missing(update, error))


def _missing(update: WindowUpdate, error: ShmmapError | None) -> str:
    reasons = Counter(failure.code for failure in update.failed)
    if update.pending:
        reasons["still loading"] = len(update.pending)
    words = [f"{count} cells {reason}" for reason, count in reasons.items()]
    return ", ".join(words if error is None else [*words, str(error)])


class DriveStatistics:
    """Running statistics of a drive's scans, in constant memory."""

    def __init__(self) -> None:
        self.scans = 0
        self.points = 0
        self.kept = 0
        self.incomplete = 0
        self.no_map = 0
        self._missing = ""
        self._compare_ms = RunningSpread()
        self._update_ms = RunningSpread()

    def add(self, compared: ComparedScan) -> None:
        """Count one scan."""
        comparison = compared.comparison
        self.scans += 1
        self.points += len(comparison.kept)
        self.kept += int(np.count_nonzero(comparison.kept))
        if compared.missing:
            self.incomplete += 1
            self._missing = self._missing or f"{compared.scan.name}: {compared.missing}"
        self.no_map += comparison.no_map
        self._compare_ms.add(comparison.compare_s * 1e3)
        if comparison.update_s:
            self._update_ms.add(comparison.update_s * 1e3)

    def line(self, compared: ComparedScan) -> str:
        """Return one line about the latest scan."""
        comparison = compared.comparison
        points, kept = len(comparison.kept), int(np.count_nonzero(comparison.kept))
        return (
            f"{compared.scan.name}: {points} points, {kept} kept ({100 * kept / max(points, 1):.1f} %),"
            f" {comparison.cells} cells, {comparison.compare_s * 1e3:.1f} ms"
            + (", no map" if comparison.no_map else "")
            + (f", missing: {compared.missing}" if compared.missing else "")
        )

    def document(self, compared: ComparedScan) -> dict[str, Any]:
        """Return the JSON object that ``--json-lines`` writes for one scan."""
        comparison = compared.comparison
        return {
            "name": compared.scan.name,
            "stamp_s": compared.scan.stamp_s,
            "points": len(comparison.kept),
            "kept": int(np.count_nonzero(comparison.kept)),
            "cells": comparison.cells,
            "no_map": comparison.no_map,
            "missing": compared.missing or None,
            "compare_ms": comparison.compare_s * 1e3,
            "update_ms": comparison.update_s * 1e3,
        }

    def summary(self) -> dict[str, Any]:
        """Return the JSON object that ``--json`` prints; times in milliseconds, null without a scan."""
        return {
            "scans": self.scans,
            "points": self.points,
            "kept": self.kept,
            "incomplete_scans": self.incomplete,
            "first_missing": self._missing or None,
            "no_map_scans": self.no_map,
            "compare_ms": self._compare_ms.document,
            "update_ms": self._update_ms.document,
            "updates": self._update_ms.count,
        }
