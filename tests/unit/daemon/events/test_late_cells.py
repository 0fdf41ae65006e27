# SPDX-License-Identifier: Apache-2.0
"""Cells that moving clients had to wait for: told at most once a second of each client."""

from __future__ import annotations

import pytest

from shmmap.daemon.events.late_cells import (
    LATE_S,
    MOST_AT_ONCE,
    MOST_CELLS,
    MOST_CLIENTS,
    LateCells,
)
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.geometry import Circle
from shmmap.protocol.events import Late, decode_event
from shmmap.protocol.messages import Area, CircleMessage, Intent
from tests.support import connections
from tests.support.divided_map import DividedMap
from tests.support.moving import says
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon


@pytest.fixture
def log() -> EventLog:
    return EventLog(7, clock_ns=lambda: 5)


def clients(count: int) -> list[Session]:
    sessions = Sessions()
    return [sessions.open(connections.of(), f"client {number}", 0.0) for number in range(count)]


def told(log: EventLog) -> list[Late]:
    events = [decode_event(raw) for _, raw in log._kept]
    return [event for event in events if isinstance(event, Late)]


def test_at_most_once_a_second(log: EventLog) -> None:
    late, (one,) = LateCells(log), clients(1)
    assert late.note(one, "a.pcd", "points")
    assert late.note(one, "b.pcd", "ndt(leaf=2.0)")
    assert told(log) == [], "the answer to a request is not held up"
    late.turn(10.0)
    assert told(log) == [Late(1, 7, 5, one.slot, one.peer.pid, "client 0", 2, "b.pcd", "ndt(leaf=2.0)")]
    late.note(one, "c.pcd", "points")
    late.turn(10.0 + 0.9 * LATE_S)
    assert len(told(log)) == 1
    late.turn(10.0 + LATE_S)
    assert [(event.cells, event.id) for event in told(log)] == [(2, "b.pcd"), (1, "c.pcd")]
    late.turn(10.0 + 3 * LATE_S)
    assert (len(told(log)), len(late)) == (2, 0)


def test_many_clients_take_turns(log: EventLog) -> None:
    """However many there are, no turn tells of more than a few; all of them come."""
    late, many = LateCells(log), clients(5 * MOST_AT_ONCE)
    for number in range(5):
        for session in many:
            late.note(session, f"{number}.pcd", "points")
        late.turn(10.0)
        assert len(told(log)) == (number + 1) * MOST_AT_ONCE
    assert {event.session for event in told(log)} == {session.slot for session in many}
    for _ in range(20):
        late.turn(10.0 + LATE_S)
    for _ in range(20):
        late.turn(10.0 + 3 * LATE_S)
    assert len(late) == 0
    assert sum(event.cells for event in told(log)) == 5 * len(many)


def test_who_asks_again_waits_on(log: EventLog) -> None:
    late, (one, other) = LateCells(log), clients(2)
    assert late.note(one, "a.pcd", "points")
    assert not late.note(one, "a.pcd", "points")
    assert late.note(one, "a.pcd", "ndt(leaf=2.0)")
    assert late.note(other, "a.pcd", "points")
    late.turn(10.0)
    assert not late.note(one, "a.pcd", "points")
    late.arrived("a.pcd", "points")
    assert late.note(one, "a.pcd", "points"), "it has left memory since"
    assert not late.note(one, "a.pcd", "ndt(leaf=2.0)")
    late.turn(20.0)
    assert [event.cells for event in told(log)] == [2, 1, 1]


def test_what_is_remembered_of_cells_that_never_come_is_bounded(log: EventLog) -> None:
    late, many = LateCells(log), clients(MOST_CLIENTS + 2)
    for session in many:
        late.note(session, "a.pcd", "points")
    assert sum(map(len, late._absent.values())) <= MOST_CLIENTS
    for number in range(MOST_CELLS + 5):
        late.note(many[0], f"{number}.pcd", "points")
    assert len(late._absent) == MOST_CELLS


def ask(one: InnerDaemon, session: Session, request: int, x: float) -> None:
    """A client says that it is there, and asks for what is around."""
    says(session, Intent(x, 0.0), one.now_s())
    one.ask(session, Area(request, CircleMessage(x, 0.0, 9.0), wait=30.0))
    one.cells_of(request)
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)


def test_who_moves_on_and_has_to_wait(inner: Inner, small_map: DividedMap) -> None:
    """The first window is no matter of fetching ahead, nor is what is in memory."""
    one = inner(small_map.root)
    session = one.session("driver")
    ask(one, session, 1, -30.0)
    assert (one.statistics.values["cells_late"], len(one.cache.events.late)) == (0, 0)
    ask(one, session, 2, -10.0)
    assert one.statistics.values["cells_late"] == 2
    ask(one, session, 3, -30.0)
    ask(one, session, 4, -10.0)
    assert one.statistics.values["cells_late"] == 2
    one.cache.events.late.turn(one.now_s())
    (event,) = told(one.event_log)
    assert (event.session, event.client, event.cells, event.layer) == (session.slot, "driver", 2, "points")
    assert event.id in ("-20_-20.pcd", "-20_0.pcd")
    assert isinstance(session.area, Circle)
