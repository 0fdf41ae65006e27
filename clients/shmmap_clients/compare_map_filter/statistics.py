# SPDX-License-Identifier: Apache-2.0
"""Counts and times of a drive: a line for each scan, and a summary."""

from __future__ import annotations

from typing import Any

import numpy as np

from shmmap_clients.compare_map_filter.drive import ComparedScan

__all__ = ["DriveStatistics"]


class DriveStatistics:
    """Sums over the scans of a drive."""

    def __init__(self) -> None:
        self.scans = 0
        self.points = 0
        self.kept = 0
        self.incomplete = 0
        self._missing = ""
        self._compare_ms: list[float] = []
        self._update_ms: list[float] = []

    def add(self, compared: ComparedScan) -> None:
        """Count one scan."""
        comparison = compared.comparison
        self.scans += 1
        self.points += len(comparison.kept)
        self.kept += int(np.count_nonzero(comparison.kept))
        if compared.missing:
            self.incomplete += 1
            self._missing = self._missing or f"{compared.scan.name}: {compared.missing}"
        self._compare_ms.append(comparison.compare_s * 1e3)
        if comparison.update_s:
            self._update_ms.append(comparison.update_s * 1e3)

    def line(self, compared: ComparedScan) -> str:
        """One line about the latest scan."""
        comparison = compared.comparison
        points, kept = len(comparison.kept), int(np.count_nonzero(comparison.kept))
        return (
            f"{compared.scan.name}: {points} points, {kept} kept ({100 * kept / max(points, 1):.1f} %),"
            f" {comparison.cells} cells, {comparison.compare_s * 1e3:.1f} ms"
            + (f", missing: {compared.missing}" if compared.missing else "")
        )

    def summary(self) -> dict[str, Any]:
        """Return what ``--json`` prints; times in milliseconds, null without a scan."""
        return {
            "scans": self.scans,
            "points": self.points,
            "kept": self.kept,
            "incomplete_scans": self.incomplete,
            "first_missing": self._missing or None,
            "compare_ms": _spread(self._compare_ms),
            "update_ms": _spread(self._update_ms),
            "updates": len(self._update_ms),
        }


def _spread(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    p50, p99, most = np.percentile(values, [50, 99, 100]).tolist()
    return {"p50": p50, "p99": p99, "max": most}
