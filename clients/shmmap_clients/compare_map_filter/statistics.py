# SPDX-License-Identifier: Apache-2.0
"""Counts and times of a drive: a line for each scan, and a summary; its size does not depend on how many."""

from __future__ import annotations

from typing import Any

import numpy as np

from shmmap_clients.compare_map_filter.drive import ComparedScan
from shmmap_clients.spread import RunningSpread

__all__ = ["DriveStatistics"]


class DriveStatistics:
    """Sums over the scans of a drive."""

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
        """One line about the latest scan."""
        comparison = compared.comparison
        points, kept = len(comparison.kept), int(np.count_nonzero(comparison.kept))
        return (
            f"{compared.scan.name}: {points} points, {kept} kept ({100 * kept / max(points, 1):.1f} %),"
            f" {comparison.cells} cells, {comparison.compare_s * 1e3:.1f} ms"
            + (", no map" if comparison.no_map else "")
            + (f", missing: {compared.missing}" if compared.missing else "")
        )

    def document(self, compared: ComparedScan) -> dict[str, Any]:
        """Return what ``--json-lines`` writes about one scan."""
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
        """Return what ``--json`` prints; times in milliseconds, null without a scan."""
        return {
            "scans": self.scans,
            "points": self.points,
            "kept": self.kept,
            "incomplete_scans": self.incomplete,
            "first_missing": self._missing or None,
            "no_map_scans": self.no_map,
            "compare_ms": _spread(self._compare_ms),
            "update_ms": _spread(self._update_ms),
            "updates": self._update_ms.count,
        }


def _spread(running: RunningSpread) -> dict[str, float] | None:
    if not running.count:
        return None
    spread = running.spread
    return {"p50": spread.p50, "p99": spread.p99, "max": spread.max}
