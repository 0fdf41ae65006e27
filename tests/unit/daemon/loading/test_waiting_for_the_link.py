# SPDX-License-Identifier: Apache-2.0
"""Loads wait until the link to the origin has room; meanwhile the daemon sleeps."""

from __future__ import annotations

import os
import signal

import pytest

from shmmap.daemon.loading.link import STALLED_S, Link
from shmmap.daemon.map.arrivals import Arrivals
from shmmap.layers.points import LAYER
from shmmap.protocol.messages import Selected
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import FETCHED_BYTES, Inner, InnerDaemon, names

CELL = "0_0.pcd"
OTHER = "other"
WIDE = 1 << 30


@pytest.fixture
def waiting(inner: Inner, small_map: DividedMap) -> InnerDaemon:
    """Return a daemon whose clock stands still, and whose link is full."""
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    one.stop_clock()
    link.begin(OTHER, WIDE, one.now_s(), "demand")
    return one


def sleeps_s(one: InnerDaemon) -> float:
    """How long the loop may sleep."""
    return one.scheduler.next_event_s() - one.now_s()


def test_a_demand_begins_when_the_link_is_silent_or_has_room(waiting: InnerDaemon) -> None:
    one, link = waiting, waiting.scheduler.link
    assert link is not None
    one.ask(one.session(), Selected(1, (CELL,), wait=30.0))
    one.turn()
    assert not any(load.is_running for load in one.loads.by_key.values())
    assert 0.0 < sleeps_s(one) <= STALLED_S
    link.end(OTHER)
    assert names(one.cells_of(1)) == [CELL]
    assert link.under_way_bytes == 0


def test_nothing_is_waited_for_once_the_load_has_gone(waiting: InnerDaemon) -> None:
    one = waiting
    one.ask(one.session(), Selected(1, (CELL,), wait=30.0))
    one.turn()
    (key,) = one.loads.by_key
    one.loads.cancel(key)
    one.offset_s += 2 * STALLED_S
    one.turn()
    assert sleeps_s(one) > STALLED_S


def test_a_wish_waits_for_what_is_under_way(waiting: InnerDaemon) -> None:
    one, link = waiting, waiting.scheduler.link
    assert link is not None
    load = one.loads.prefetch(one.cache.key(0, LAYER), 4096, 5.0, computed=False)
    one.offset_s += 2 * STALLED_S
    one.turn()
    assert not load.is_running
    assert sleeps_s(one) > STALLED_S
    link.end(OTHER)
    one.run_until(lambda: not one.loads.by_key)
    assert len(list(one.ledger.residents())) == 1


def test_a_metered_link_fetches_nothing_for_a_spare_request(inner: Inner, small_map: DividedMap) -> None:
    one = inner(small_map.root, link=Link(Arrivals(), metered=True))
    reply = one.cells_for(Selected(1, (CELL,), wait=30.0, spare=True))
    assert (len(reply.cells), len(reply.pending), reply.failed) == (0, 1, ())
    assert not one.loads.by_key
    assert sleeps_s(one) > STALLED_S
    assert names(one.cells_for(Selected(2, (CELL,), wait=30.0))) == [CELL]


def test_what_is_made_from_memory_waits_for_no_link(inner: Inner, small_map: DividedMap) -> None:
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    session = one.session()
    one.cells_for(Selected(1, (CELL,), wait=30.0), session)
    one.stop_clock()
    link.begin(OTHER, WIDE, one.now_s(), "demand")
    assert names(one.cells_for(Selected(2, (CELL,), ("voxel(leaf=1.0)",), wait=30.0), session)) == [CELL]
    assert link.under_way_bytes == WIDE


def test_a_loader_that_is_killed_leaves_nothing_under_way(inner: Inner, small_map: DividedMap) -> None:
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    one.ask(one.session(), Selected(1, (CELL,), wait=30.0))
    with one.loaders_standing_still() as pids:
        one.run_until(lambda: link.under_way_bytes == FETCHED_BYTES)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
    assert len(one.cells_of(1).failed) == 1
    assert link.under_way_bytes == 0
