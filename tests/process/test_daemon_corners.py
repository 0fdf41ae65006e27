# SPDX-License-Identifier: Apache-2.0
"""Corners of a running daemon: signals at bad moments."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import numpy as np
import pytest

from tests.process.conftest import DaemonFactory
from tests.support.divided_map import DividedMap, random_points
from tests.support.raw_client import DaemonError, RawClient, circle

Connect = Callable[..., RawClient]


# --- signals ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_the_daemon_starts(
    daemon: DaemonFactory, divided_map: DividedMap, number: signal.Signals
) -> None:
    """As soon as it has a name on disk, a signal must take it away again, wherever the start is by then."""
    one = daemon(divided_map.root, start=False)
    process = one.spawn()
    while not [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")]:
        assert process.poll() is None, one.log
    process.send_signal(number)
    assert process.wait(30) == 0, one.log
    assert one.leftovers() == []
    assert [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")] == []


def test_signals_one_after_the_other_end_it_at_once(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Whatever the first one's work has come to when the others arrive."""
    for _ in range(5):
        one = daemon(divided_map.root)
        client = connect(one)
        client.area(circle(0, 0, 60))
        assert one.process is not None
        process, one.process = one.process, None
        while process.poll() is None:
            process.send_signal(signal.SIGTERM)
        assert process.returncode == 0, one.log
        assert "Traceback" not in one.log
        assert one.leftovers() == []
        assert [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")] == []


def test_a_burst_of_reload_signals(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    before = client.selected(["0_0.pcd"]).cells[0]
    corner = divided_map.corners["0_0.pcd"]
    divided_map.write_cell("0_0.pcd", corner, random_points(np.random.default_rng(4), corner, 40))
    for _ in range(200):
        one.send(signal.SIGHUP)
    reply = client.selected(["0_0.pcd"])
    while reply.cells[0].version == before.version:
        reply = client.selected(["0_0.pcd"])
    assert reply.cells[0].points == 40
    assert client.ask("reload")[3:6] == [0, 0, 0]
    assert 1 <= client.ask("stats")[4]["reloads"] <= 202


def test_poses_that_are_not_finite(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Refused, and nobody's cells are lost in the queue for it."""
    client = connect(daemon(divided_map.root))
    nan, inf = float("nan"), float("inf")
    for intent in ([nan, 0.0], [0.0, inf], [0.0, 0.0, nan], [0.0, 0.0, 0.0, 0.0, inf, [[0.0, nan]]]):
        with pytest.raises(DaemonError) as failure:
            client.area(circle(0, 0, 5), intent=intent)
        assert failure.value.code == "bad_request"
    assert len(client.area(circle(0, 0, 5)).cells) == 4
