# SPDX-License-Identifier: Apache-2.0
"""A daemon uses the link to its map's store for clients, and for nothing else while there are none."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.command_line import verb
from tests.support.daemon_process import DaemonProcess
from tests.support.published_daemon import until
from tests.support.raw_client import RawClient, circle

pytest.importorskip("zstandard", reason="zstandard is not installed")

from shmmap.statistics.reader import read_statistics
from tests.support.made_map import CELL_M, SHARD_M, ServedMadeMap, serve_made_map
from tests.support.slow_link import Plan, SlowLink, slow_link

CELLS = 200 * 200
BEATS_NS = 2 * 10**9


@pytest.fixture(scope="module")
def served() -> Iterator[ServedMadeMap]:
    with serve_made_map(CELLS, 4000) as one:
        yield one


@pytest.fixture
def link(served: ServedMadeMap) -> Iterator[SlowLink]:
    with slow_link(Plan(served.port, 80.0, 0.005)) as one:
        yield one


def counters(one: DaemonProcess) -> dict[str, int]:
    return dict(read_statistics(one.instance, one.shm_dir).counters)


def go_on(one: DaemonProcess) -> dict[str, int]:
    """Counters after the daemon has beaten for two seconds: long enough for the whole list of cells."""
    end_ns = time.monotonic_ns() + BEATS_NS
    until(lambda: read_statistics(one.instance, one.shm_dir).beat_monotonic_ns > end_ns)
    return counters(one)


def test_pages_that_nothing_needs_come_only_while_a_client_is_there(
    daemon: DaemonFactory, connect: Callable[..., RawClient], link: SlowLink
) -> None:
    one = daemon(link.endpoint, "--poll", "0")
    found = go_on(one)
    assert found["map_pages"] > 16
    assert (found["map_pages_known"], found["link_index_bytes"], found["link_demand_bytes"]) == (0, 0, 0)
    client = connect(one)
    assert not client.area(circle(SHARD_M, SHARD_M, 50.0), wait=60.0).pending
    until(lambda: counters(one)["map_pages_known"] == found["map_pages"])
    found = counters(one)
    assert found["link_demand_bytes"] > 0
    assert found["link_index_bytes"] > 0
    assert found["link_ahead_bytes"] == 0
    assert 0 < found["link_rate_bytes"] < 2 * 80e6 / 8
    code, says = verb(one, "status")
    assert code == 0
    assert " demand, " in says


def test_a_metered_link_is_for_what_clients_ask_for(
    daemon: DaemonFactory, connect: Callable[..., RawClient], link: SlowLink
) -> None:
    one = daemon(link.endpoint, "--poll", "0", "--metered")
    client = connect(one)
    for step in range(10):  # it moves, and others would be fetched ahead of it
        x = SHARD_M + CELL_M * step
        assert not client.area(circle(x, SHARD_M / 2, 30.0), wait=60.0, intent=[x, SHARD_M / 2]).pending
    found = go_on(one)
    assert found["loads_finished"] > 10
    assert (found["prefetch_started"], found["link_ahead_bytes"]) == (0, 0)
    assert 0 < found["map_pages_known"] <= 6


def test_a_limit_of_the_rate_is_kept(
    daemon: DaemonFactory, connect: Callable[..., RawClient], link: SlowLink
) -> None:
    one = daemon(link.endpoint, "--poll", "0", "--metered", "--link-rate", "4")
    client = connect(one)
    area = circle(2 * SHARD_M, 2 * SHARD_M, 60.0)
    client.area(circle(2 * SHARD_M, 2 * SHARD_M, 1.0), wait=60.0)
    before, begin_s = counters(one)["link_demand_bytes"], time.monotonic()
    reply = client.area(area, wait=200.0)
    took_s = time.monotonic() - begin_s
    assert not reply.pending
    until(lambda: counters(one)["loads_finished"] >= len(reply.cells))
    came = counters(one)["link_demand_bytes"] - before
    assert came > 400_000
    assert took_s >= 0.9 * (came - came / len(reply.cells)) / 0.5e6
