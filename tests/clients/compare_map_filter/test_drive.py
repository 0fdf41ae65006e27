# SPDX-License-Identifier: Apache-2.0
"""Sums over a drive: right, and no larger for a longer drive."""

from __future__ import annotations

import pickle

import numpy as np
from shmmap_clients.compare_map_filter.drive import ComparedScan, DriveStatistics
from shmmap_clients.compare_map_filter.filter import Comparison
from shmmap_clients.compare_map_filter.output import TopView
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.spread import KEPT


def compared(number: int) -> ComparedScan:
    """A scan of two points of which one is kept; every tenth had no map, every seventh lacked cells."""
    comparison = Comparison(
        kept=np.array([True, False]),
        cells=0 if number % 10 == 0 else 4,
        no_map=number % 10 == 0,
        compare_s=1e-3 * (number + 1),
        update_s=2e-3 if number % 2 else 0.0,
    )
    scan = Scan(f"scan_{number}", 0.1 * number, {"xyz": np.zeros((2, 3), np.float32)}, np.eye(4))
    return ComparedScan(scan, comparison, "1 cells still loading" if number % 7 == 6 else "")


def test_sums_are_right() -> None:
    statistics = DriveStatistics()
    for number in range(100):
        statistics.add(compared(number))
    summary = statistics.summary()
    assert (summary["scans"], summary["points"], summary["kept"]) == (100, 200, 100)
    assert (summary["no_map_scans"], summary["incomplete_scans"], summary["updates"]) == (10, 14, 50)
    assert summary["first_missing"] == "scan_6: 1 cells still loading"
    assert np.isclose(summary["compare_ms"]["p50"], 50.5)
    assert np.isclose(summary["compare_ms"]["max"], 100.0)
    assert DriveStatistics().summary()["compare_ms"] is None
    assert ", no map" in statistics.line(compared(0))
    assert statistics.document(compared(0))["no_map"]


def test_a_long_drive_takes_no_more_memory() -> None:
    statistics, view = DriveStatistics(), TopView()
    sizes = []
    for number in range(3 * KEPT):
        statistics.add(compared(number))
        view.add(np.zeros((1, 3)), np.array([True]), (0.5 * number, 0.0))
        if number + 1 in (KEPT, 3 * KEPT):
            sizes.append(len(pickle.dumps((statistics, view))))
    assert sizes[1] < 1.1 * sizes[0]
