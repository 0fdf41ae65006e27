# SPDX-License-Identifier: Apache-2.0
"""Statistics made up for screens: no daemon wrote them."""

from __future__ import annotations

from shmmap.protocol.rows import ClientRow, Window
from shmmap.statistics.counters import BUCKETS, COUNTERS, HISTOGRAMS
from shmmap.statistics.identity import DaemonIdentity
from shmmap.statistics.layout import State, plan
from shmmap.statistics.reader import Snapshot

MIB = 1 << 20
IDENTITY = DaemonIdentity(
    77, 1, 1, 5, "unit", "/run/x.sock", "/maps/city", 7, "/dev/shm", "/maps/", "1.2.3", 5 * 10**9
)
CLIENT = ClientRow(
    3, 4242, 1000, 1000, "localization", "python3", 12, 5 * MIB, 1234, 9 * 10**9,
    (50.0, 30.0), 0.5, Window("circle", 50.0, 30.0, 25.0, 25.0),
)  # fmt: skip


def counters(**values: int) -> dict[str, int]:
    assert set(values) <= {c.name for c in COUNTERS}
    return {c.name: values.get(c.name, 0) for c in COUNTERS}


def snapshot(values: dict[str, int], clients: list[ClientRow], *, state: str = "healthy") -> Snapshot:
    durations = [0] * (len(HISTOGRAMS) * (1 + BUCKETS))
    durations[1 + 40] = 99  # of the first histogram
    durations[1 + 60] = 1
    beat = State(1, 10 * 10**9, 0, tuple(values.values()), durations)
    found = Snapshot(state, IDENTITY, plan(COUNTERS, HISTOGRAMS), beat, beat_age_s=0.1)  # type: ignore[arg-type]
    found.clients = clients
    return found


FULL = counters(
    budget_bytes=100 * MIB, bytes_resident=60 * MIB, bytes_pinned=50 * MIB, bytes_zombie=10 * MIB,
    bytes_reserved=4 * MIB, bytes_statistics=MIB, hits=90, misses=10,
    hits_10s=3, misses_10s=1, map_cells=1234,
    sessions=1,
)  # fmt: skip
