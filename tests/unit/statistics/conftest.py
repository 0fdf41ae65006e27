# SPDX-License-Identifier: Apache-2.0
"""A writer of statistics, and rows to write."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from shmmap.protocol.rows import CellRow, ClientRow, LiveMapRow
from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.identity import DaemonIdentity, pid_namespace, start_time_ticks
from shmmap.statistics.writer import StatisticsWriter

BOX = (0.0, 0.0, 20.0, 20.0)


def row(number: int, *, nbytes: int = 4096) -> CellRow:
    """Row of a cell of that number."""
    return CellRow(f"{number:04d}.pcd", "points", number, f"{number:016x}", "resident", nbytes, 10, BOX)


def client(number: int) -> ClientRow:
    """Row of a client of that number."""
    return ClientRow(number + 1, 100 + number, 0, 0, f"client {number}", "python3", number, 0, 0, 0)


def live_map(number: int) -> LiveMapRow:
    """Row of a live map of that number."""
    return LiveMapRow(f"map{number}", "/live", 0.1, "map", number, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)


@pytest.fixture
def identity(shm: ShmDirectory) -> DaemonIdentity:
    """Return an identity of this process."""
    return DaemonIdentity(
        pid=os.getpid(),
        start_time_ticks=start_time_ticks(os.getpid()),
        pid_namespace=pid_namespace(),
        epoch=2**64 - 1,
        instance="unit",
        endpoint="/run/ä b\n.sock",
        map_path="/maps/city",
        map_version=7,
        shm_dir=shm.path,
        id_prefix="/maps/city/pointcloud_map.pcd/",
        library_version="1.2.3",
        started_unix_ns=5,
    )


@pytest.fixture
def writer(shm: ShmDirectory, identity: DaemonIdentity) -> Iterator[StatisticsWriter]:
    """Write statistics of instance ``unit``; nothing is left of them."""
    one = StatisticsWriter(shm, "unit", identity)
    yield one
    one.close()
    assert os.listdir(shm.path) == []
