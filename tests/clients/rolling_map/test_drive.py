# SPDX-License-Identifier: Apache-2.0
"""The path of a drive in bounded memory, with both its ends."""

from __future__ import annotations

import numpy as np
from shmmap_clients.rolling_map.live_map import DriveStatistics, MappedScan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.spread import KEPT

from shmmap.live import ScanCounts


def test_the_path_of_a_long_drive_keeps_its_ends() -> None:
    statistics = DriveStatistics()
    assert list(statistics.path) == []
    counts, points = ScanCounts(1, 0, 0, 0, 0), {"xyz": np.zeros((1, 3), np.float32)}
    for number in range(KEPT + 2):
        T = np.eye(4)
        T[:3, 3] = number, -number, 1.0
        statistics.add(MappedScan(Scan(str(number), 0.0, points, T), number, counts, 1, 0.01))
        if number < 9:
            assert [x for x, _, _ in statistics.path] == list(range(number + 1))
    assert len(statistics.path) < KEPT
    assert statistics.path[0] == (0.0, 0.0, 1.0)
    assert statistics.path[-1] == (KEPT + 1.0, -KEPT - 1.0, 1.0)
    assert statistics.summary(applied=7, durable=6)["counts"]["near"] == KEPT + 2
