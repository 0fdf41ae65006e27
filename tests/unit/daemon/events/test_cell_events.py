# SPDX-License-Identifier: Apache-2.0
"""Prefetch misses are one event a second of each client, and what was evicted to make room is known once."""

from __future__ import annotations

import pytest

from shmmap.daemon.events.cell_events import (
    MAX_EVENTS_PER_TURN,
    MAX_MISSED_CELLS,
    MAX_WAITING_CLIENTS,
    QUIET_S,
    EvictionHistory,
    PrefetchMisses,
)
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.geometry import Circle
from shmmap.protocol.events import PrefetchMiss, decode_event
from shmmap.protocol.messages import Area, CircleMessage, Intent
from tests.support import connections
from tests.support.connections import says
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon


@pytest.fixture
def log() -> EventLog:
    return EventLog(7, clock_ns=lambda: 5)


def clients(count: int) -> list[Session]:
    sessions = Sessions()
    return [sessions.open(connections.of(), f"client {number}", 0.0) for number in range(count)]


def missed(log: EventLog) -> list[PrefetchMiss]:
    events = [decode_event(raw) for _, raw in log._kept]
    return [event for event in events if isinstance(event, PrefetchMiss)]


def test_at_most_once_a_second(log: EventLog) -> None:
    misses, (one,) = PrefetchMisses(log), clients(1)
    assert misses.note(one, "a.pcd", "points")
    assert misses.note(one, "b.pcd", "ndt(leaf=2.0)")
    assert missed(log) == [], "the answer to a request is not held up"
    misses.turn(10.0)
    assert missed(log) == [
        PrefetchMiss(1, 7, 5, one.slot, one.peer.pid, "client 0", 2, "b.pcd", "ndt(leaf=2.0)")
    ]
    misses.note(one, "c.pcd", "points")
    misses.turn(10.0 + 0.9 * QUIET_S)
    assert len(missed(log)) == 1
    misses.turn(10.0 + QUIET_S)
    assert [(event.cells, event.id) for event in missed(log)] == [(2, "b.pcd"), (1, "c.pcd")]
    misses.turn(10.0 + 3 * QUIET_S)
    assert (len(missed(log)), len(misses)) == (2, 0)


def test_many_clients_take_turns(log: EventLog) -> None:
    """However many there are, no turn publishes more than a few events; all of them come."""
    misses, many = PrefetchMisses(log), clients(5 * MAX_EVENTS_PER_TURN)
    for session in many:
        misses.note(session, "a.pcd", "points")
    for number in range(5):
        misses.turn(10.0)
        assert len(missed(log)) == (number + 1) * MAX_EVENTS_PER_TURN
    assert {event.session for event in missed(log)} == {session.slot for session in many}
    for _ in range(5):
        misses.turn(10.0 + QUIET_S)
    assert len(misses) == 0


def test_a_client_that_asks_again_waits_on(log: EventLog) -> None:
    misses, (one, other) = PrefetchMisses(log), clients(2)
    assert misses.note(one, "a.pcd", "points")
    assert not misses.note(one, "a.pcd", "points")
    assert misses.note(one, "a.pcd", "ndt(leaf=2.0)")
    assert misses.note(other, "a.pcd", "points")
    misses.turn(10.0)
    assert not misses.note(one, "a.pcd", "points")
    misses.arrived("a.pcd", "points")
    assert misses.note(one, "a.pcd", "points"), "it has left memory since"
    assert not misses.note(one, "a.pcd", "ndt(leaf=2.0)")
    misses.turn(20.0)
    assert [event.cells for event in missed(log)] == [2, 1, 1]


def test_what_is_remembered_of_cells_that_never_come_is_bounded(log: EventLog) -> None:
    misses, many = PrefetchMisses(log), clients(MAX_WAITING_CLIENTS + 2)
    for session in many:
        misses.note(session, "a.pcd", "points")
    assert sum(map(len, misses._absent.values())) <= MAX_WAITING_CLIENTS
    for number in range(MAX_MISSED_CELLS + 5):
        misses.note(many[0], f"{number}.pcd", "points")
    assert len(misses._absent) == MAX_MISSED_CELLS


def ask(one: InnerDaemon, session: Session, request: int, x: float) -> None:
    """A client says that it is there, and asks for what is around."""
    says(session, Intent(x, 0.0), one.now_s())
    one.ask(session, Area(request, CircleMessage(x, 0.0, 9.0), wait=30.0))
    one.cells_of(request)
    one.run_until(lambda: not one.sessions.moved and not one.scheduler.prefetcher.cold)


def test_a_client_that_moves_on_and_has_to_wait(inner: Inner, small_map: DividedMap) -> None:
    """The first window is no matter of fetching ahead, nor is what is in memory."""
    one = inner(small_map.root)
    session = one.session("driver")
    ask(one, session, 1, -30.0)
    assert one.statistics.values["prefetch_misses"] == 0
    ask(one, session, 2, -10.0)
    assert one.statistics.values["prefetch_misses"] == 2
    ask(one, session, 3, -30.0)
    ask(one, session, 4, -10.0)
    assert one.statistics.values["prefetch_misses"] == 2
    one.events.step(one.now_s())
    (event,) = missed(one.event_log)
    assert (event.session, event.client, event.cells, event.layer) == (session.slot, "driver", 2, "points")
    assert event.id in ("-20_-20.pcd", "-20_0.pcd")
    assert isinstance(session.area, Circle)


def test_what_was_evicted_is_known_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.daemon.events.cell_events.MAX_EVICTED", 3)
    history = EvictionHistory()
    for number in range(5):
        history.evicted(Key(f"{number}", "points"), number)
    assert len(history) == 3
    assert not history.loaded(Key("0", "points"), 0)  # forgotten
    assert history.loaded(Key("3", "points"), 3)
    assert not history.loaded(Key("3", "points"), 3)  # it was just brought back
    assert not history.loaded(Key("4", "points"), 99)  # it changed meanwhile
