# SPDX-License-Identifier: Apache-2.0
"""Many processes, one copy."""

from __future__ import annotations

from pathlib import Path

from tests.process.conftest import DaemonFactory
from tests.support.client_programs import FollowingClient
from tests.support.divided_map import make_map
from tests.support.process_costs import proportional_bytes, proportional_bytes_under

PROCESSES = 8


def test_eight_processes_share_one_copy(daemon: DaemonFactory, tmp_path: Path) -> None:
    """100 MB held by eight processes, every byte read by each: summed PSS is that of one copy.

    The interpreters' own memory is measured before, when the same processes are connected and have
    computed the same over one cell.
    """
    made = make_map(tmp_path / "map", columns=8, rows=8, points=105_000)
    one = daemon(made.root, "--budget", "512M")
    clients = [FollowingClient(one.endpoint, "area") for _ in range(PROCESSES)]
    try:
        own = _ask_all(clients, 70.0, 70.0, 1.0)
        shared_before = sum(proportional_bytes_under(c.process.pid, one.shm_dir) for c in clients)
        held = _ask_all(clients, 0.0, 0.0, 500.0)
        shared = sum(proportional_bytes_under(c.process.pid, one.shm_dir) for c in clients)
        copy = one.segment_bytes()
        assert copy >= 100 << 20
        assert shared <= 1.02 * copy
        assert held - (own - shared_before) <= 1.1 * copy
    finally:
        for client in clients:
            client.kill()


def _ask_all(clients: list[FollowingClient], x: float, y: float, radius: float) -> int:
    """Have all read what is there; returns their summed PSS while they hold it."""
    for client in clients:
        client.ask(x, y, radius)
    answers = [client.answer() for client in clients]
    assert all(len(a["new"]) == len(answers[0]["new"]) > 0 for a in answers)
    return sum(proportional_bytes(client.process.pid) for client in clients)
