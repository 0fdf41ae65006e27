# SPDX-License-Identifier: Apache-2.0
"""A writer of statistics."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from shmmap.segment.directory import ShmDirectory
from shmmap.statistics.identity import DaemonIdentity, pid_namespace, start_time_ticks
from shmmap.statistics.writer import StatisticsWriter


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
