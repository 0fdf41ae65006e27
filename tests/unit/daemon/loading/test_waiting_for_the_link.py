# SPDX-License-Identifier: Apache-2.0
"""Loads wait until the link to the origin has room; meanwhile the daemon sleeps."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from shmmap.daemon.loading.link import STALLED_S, Link
from shmmap.daemon.loading.loads import FETCHED, Purpose
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


def test_what_is_made_from_memory_passes_what_waits_for_the_link(inner: Inner, small_map: DividedMap) -> None:
    """Whatever number of cells waits, which are nearest first when the link has room."""
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    *waiting, here = "0_0.pcd", "0_20.pcd", "20_0.pcd", "20_20.pcd"
    one.cells_for(Selected(1, (here,), wait=30.0))
    one.stop_clock()
    link.begin(OTHER, WIDE, one.now_s(), "demand")
    one.ask(one.session(), Selected(2, tuple(waiting), wait=600.0))
    made = Selected(3, (here,), ("voxel(leaf=1.0)",), wait=600.0)
    assert names(one.cells_for(made)) == [here]
    assert not any(load.is_running for load in one.loads.by_key.values())
    assert link.under_way_bytes == WIDE
    assert 0.0 < sleeps_s(one) <= STALLED_S
    one.jobs.clear()
    link.end(OTHER)
    assert names(one.cells_of(2)) == waiting
    assert [Path(job.cell_id).name for job in one.jobs] == waiting


def test_a_job_is_made_once_when_the_link_has_room_for_it(waiting: InnerDaemon) -> None:
    one, link = waiting, waiting.scheduler.link
    assert link is not None
    one.ask(one.session(), Selected(1, (CELL, "0_20.pcd"), wait=30.0))
    for _ in range(3):
        one.turn()
    assert not one.jobs
    link.end(OTHER)
    assert names(one.cells_of(1)) == [CELL, "0_20.pcd"]
    assert len(one.jobs) == 2


def test_a_cell_whose_file_was_mended_waits_for_the_link(inner: Inner, small_map: DividedMap) -> None:
    """The check of its file does not."""
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    one.stop_clock()
    path = small_map.pcd_dir / CELL
    good = path.read_bytes()
    path.write_bytes(b"broken")
    assert [cell.code for cell in one.cells_for(Selected(1, (CELL,), wait=600.0)).failed] == ["load_failed"]
    path.write_bytes(good)
    link.begin(OTHER, WIDE, one.now_s(), "demand")
    one.ask(one.session(), Selected(2, (CELL,), wait=600.0))
    (load,) = one.loads.by_key.values()
    one.run_until(lambda: load.work is Purpose.DEMAND)
    one.turn()
    assert one.loads.by_key[load.key] is load
    assert not load.is_running
    link.end(OTHER)
    assert names(one.cells_of(2)) == [CELL]


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
    load = one.loads.prefetch(one.cache.key(0, LAYER), 4096, 5.0, kind=FETCHED)
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


def test_a_loader_that_is_killed_leaves_nothing_under_way(inner: Inner, small_map: DividedMap) -> None:
    link = Link(Arrivals())
    one = inner(small_map.root, link=link)
    with one.loaders_standing_still() as pids:
        one.ask(one.session(), Selected(1, (CELL,), wait=30.0))
        one.run_until(lambda: link.under_way_bytes == FETCHED_BYTES)
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
    assert len(one.cells_of(1).failed) == 1
    assert link.under_way_bytes == 0
