# SPDX-License-Identifier: Apache-2.0
"""The log of events, and what is published in it about cells, clients and live maps: each change once."""

from __future__ import annotations

import logging
from typing import Any, cast

import msgspec
import pytest

from shmmap.daemon.events.cell_events import (
    MAX_EVENTS_PER_TURN,
    MAX_MISSED_CELLS,
    MAX_WAITING_CLIENTS,
    QUIET_S,
    EvictionHistory,
    PrefetchMisses,
    PressureEvents,
)
from shmmap.daemon.events.log import REMEMBERED, SENT_TOGETHER, EventLog, MinuteLog
from shmmap.daemon.live_relay import LiveEvents
from shmmap.daemon.records import Key
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.geometry import Circle
from shmmap.protocol import events as e
from shmmap.protocol.events import PrefetchMiss, decode_event
from shmmap.protocol.messages import Area, CircleMessage, Intent
from shmmap.protocol.rows import LiveMapRow
from shmmap.statistics.writer import StatisticsWriter
from tests.support import connections
from tests.support.connections import Subscriber, says
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner, InnerDaemon

MEMORY = (100, 90, 80, 70)


def subscribed(*, epoch: int = 7) -> tuple[EventLog, Subscriber]:
    """Return a log whose clock ticks once per event, and what it sends."""
    ticks = iter(range(1 << 20))
    log, subscriber = EventLog(epoch, clock_ns=lambda: next(ticks)), Subscriber()
    log.subscribe(subscriber)
    (first,) = subscriber.take()
    assert first == e.Beat(0, epoch, 0)
    return log, subscriber


def numbers(page: e.EventPage) -> list[int]:
    return [event.seq for data in page.events if (event := e.decode_event(data)) is not None]


def test_events_are_numbered_sent_and_remembered() -> None:
    log, subscriber = subscribed()
    assert numbers(log.page(e.Recent(1))) == []
    for number in range(3):
        log.publish(e.Changed, f"{number}.pcd", number, "changed")
    log.beat()
    sent = subscriber.take()
    assert [event.seq for event in sent] == [1, 2, 3, 3]
    assert isinstance(sent[-1], e.Beat)
    log.unsubscribe(subscriber)
    log.beat()
    assert subscriber.take() == []
    page = log.page(e.Recent(5))
    assert (page.request, page.epoch, page.first, page.next, numbers(page)) == (5, 7, 1, 4, [1, 2, 3])
    assert numbers(log.page(e.Recent(5, after=1))) == [2, 3]
    assert numbers(log.page(e.Recent(5, after=99))) == []
    assert numbers(log.page(e.Recent(5, after=2**64 - 1))) == []
    assert numbers(log.page(e.Recent(5, since_unix_ns=3))) == [3]
    assert numbers(log.page(e.Recent(5, limit=2))) == [1, 2]
    assert numbers(log.page(e.Recent(5, limit=-1))) == []
    assert numbers(log.page(e.Recent(5, after=-9))) == [1, 2, 3]


def test_the_oldest_are_forgotten() -> None:
    log, _ = subscribed()
    for _ in range(REMEMBERED + 10):
        log.publish(e.Changed, "a.pcd", 1, "changed")
    page = log.page(e.Recent(1, limit=1 << 30))
    assert (page.first, page.next) == (11, REMEMBERED + 11)
    assert numbers(page) == list(range(11, 511))  # a page is never longer, whatever is asked for


def test_a_slow_subscriber_gets_what_is_stored_when_it_reads_again() -> None:
    """Nothing is kept for it; what is forgotten by then it loses, and the numbers show it."""
    log, slow = subscribed()
    other = Subscriber()
    log.subscribe(other)
    slow.reads = False
    for _ in range(100):
        log.publish(e.Changed, "a.pcd", 1, "changed")
    log.beat()
    assert [event.seq for event in slow.take()] == [1], "what it did not read; then nothing more"
    assert [event.seq for event in other.take()] == [0, *range(1, 101), 100]
    assert not log.resume(slow)
    assert [event.seq for event in slow.take()] == [*range(2, 2 + SENT_TOGETHER)], "and it does not read them"
    for _ in range(REMEMBERED):
        log.publish(e.Changed, "a.pcd", 1, "changed")
    slow.reads = True
    for sent in range(SENT_TOGETHER, REMEMBERED + 1, SENT_TOGETHER):
        assert log.resume(slow) == (sent < REMEMBERED), "some at a time: others wait meanwhile"
    assert [event.seq for event in slow.take()] == [*range(101, REMEMBERED + 101)]
    assert not log.resume(slow)
    log.publish(e.Changed, "a.pcd", 1, "changed")
    assert [event.seq for event in slow.take()] == [REMEMBERED + 101]
    slow.reads = False
    log.beat()
    log.unsubscribe(slow)
    log.resume(slow)
    log.publish(e.Changed, "a.pcd", 1, "changed")
    assert [event.seq for event in slow.take()] == [REMEMBERED + 101]


def test_pressure_is_published_once_a_second() -> None:
    log, subscriber = subscribed()
    pressure = PressureEvents(log, lambda: MEMORY)
    for tenth in range(25):
        pressure.note_refusal(f"{tenth}.pcd", "points", "over_budget", tenth / 10)
    pressure.step(2.5)
    pressure.step(3.0)
    pressure.step(9.0)
    published = [(event.id, event.refused) for event in subscriber.take() if isinstance(event, e.Pressure)]
    assert published == [("0.pcd", 1), ("10.pcd", 10), ("20.pcd", 10), ("24.pcd", 4)]


def test_what_happens_often_is_a_line_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    """The first at once; then what has come since, however much it is."""
    minutes = MinuteLog()
    with caplog.at_level(logging.INFO, "shmmap"):
        minutes.count("cells evicted", "budget", 100)
        minutes.step(5.0)
        for number in range(10_000):
            minutes.count("cells evicted", "budget" if number % 10 else "request", 10)
            minutes.count("clients left", f"client {number % 5}", 1)
            minutes.step(5.0 + number * 0.005)
        assert [line.split(" of=")[0] for line in caplog.messages] == [
            "cells evicted count=1 bytes=100",
            "clients left count=1 bytes=1",
        ]
        minutes.step(65.0)
        minutes.step(66.0)
        assert caplog.messages[2:] == [
            'cells evicted count=10000 bytes=100000 of="9000 budget, 1000 request"',
            'clients left count=9999 bytes=9999 of="2000 client 1, 2000 client 2, 2000 client 3 and 2 more"',
        ]
        minutes.step(1e6)
        assert len(caplog.messages) == 4, "where nothing happens, nothing is said"


@pytest.mark.parametrize(
    ("code", "setting"),
    [("over_budget", "--budget"), ("quota", "--session-quota"), ("no_space", "--shm-dir")],
)
def test_refusals_are_a_line_a_minute_with_holder_and_setting(
    caplog: pytest.LogCaptureFixture, code: str, setting: str
) -> None:
    pressure = PressureEvents(subscribed()[0], lambda: MEMORY, lambda: "planner (pid 7): 3.0 MiB")
    with caplog.at_level(logging.WARNING, "shmmap"):
        for step in range(700):
            pressure.note_refusal(f"{step}.pcd", "points", code, step / 10)
    first, second = caplog.messages
    assert first.startswith(f"cells refused for lack of memory count=1 code={code} last=0.pcd layer=points")
    assert second.startswith(f"cells refused for lack of memory count=600 code={code} last=600.pcd")
    pressure.close()
    assert len(caplog.messages) == 3, "what the next line would have counted is logged at the end"
    assert caplog.messages[2].startswith(
        f"cells refused for lack of memory count=99 code={code} last=699.pcd"
    )
    pressure.close()
    assert len(caplog.messages) == 3
    for line in (first, second):
        assert 'most_is_held_by="planner (pid 7): 3.0 MiB"' in line
        assert setting in line


@pytest.fixture
def log() -> EventLog:
    return EventLog(7, clock_ns=lambda: 5)


def clients(count: int) -> list[Session]:
    sessions = Sessions()
    return [sessions.open(connections.of(), f"client {number}", 0.0) for number in range(count)]


def missed(log: EventLog) -> list[PrefetchMiss]:
    events = map(decode_event, log.page(e.Recent(1)).events)
    return [event for event in events if isinstance(event, PrefetchMiss)]


def test_at_most_once_a_second(log: EventLog) -> None:
    misses, (one,) = PrefetchMisses(log), clients(1)
    assert misses.note_wait(one, "a.pcd", "points")
    assert misses.note_wait(one, "b.pcd", "ndt(leaf=2.0)")
    assert missed(log) == [], "the answer to a request is not held up"
    misses.publish_due(10.0)
    assert missed(log) == [
        PrefetchMiss(1, 7, 5, one.slot, one.peer.pid, "client 0", 2, "b.pcd", "ndt(leaf=2.0)")
    ]
    misses.note_wait(one, "c.pcd", "points")
    misses.publish_due(10.0 + 0.9 * QUIET_S)
    assert len(missed(log)) == 1
    misses.publish_due(10.0 + QUIET_S)
    assert [(event.cells, event.id) for event in missed(log)] == [(2, "b.pcd"), (1, "c.pcd")]
    misses.publish_due(10.0 + 3 * QUIET_S)
    assert (len(missed(log)), len(misses._waited)) == (2, 0)


def test_many_clients_take_turns(log: EventLog) -> None:
    """However many there are, no turn publishes more than a few events; all of them come."""
    misses, many = PrefetchMisses(log), clients(5 * MAX_EVENTS_PER_TURN)
    for session in many:
        misses.note_wait(session, "a.pcd", "points")
    for number in range(5):
        misses.publish_due(10.0)
        assert len(missed(log)) == (number + 1) * MAX_EVENTS_PER_TURN
    assert {event.session for event in missed(log)} == {session.slot for session in many}
    for _ in range(5):
        misses.publish_due(10.0 + QUIET_S)
    assert len(misses._waited) == 0


def test_a_client_that_asks_again_waits_on(log: EventLog) -> None:
    misses, (one, other) = PrefetchMisses(log), clients(2)
    assert misses.note_wait(one, "a.pcd", "points")
    assert not misses.note_wait(one, "a.pcd", "points")
    assert misses.note_wait(one, "a.pcd", "ndt(leaf=2.0)")
    assert misses.note_wait(other, "a.pcd", "points")
    misses.publish_due(10.0)
    assert not misses.note_wait(one, "a.pcd", "points")
    misses.note_arrival("a.pcd", "points")
    assert misses.note_wait(one, "a.pcd", "points"), "it has left memory since"
    assert not misses.note_wait(one, "a.pcd", "ndt(leaf=2.0)")
    misses.publish_due(20.0)
    assert [event.cells for event in missed(log)] == [2, 1, 1]


def test_what_is_remembered_of_cells_that_never_come_is_bounded(log: EventLog) -> None:
    misses, many = PrefetchMisses(log), clients(MAX_WAITING_CLIENTS + 2)
    for session in many:
        misses.note_wait(session, "a.pcd", "points")
    assert sum(map(len, misses._absent.values())) <= MAX_WAITING_CLIENTS
    for number in range(MAX_MISSED_CELLS + 5):
        misses.note_wait(many[0], f"{number}.pcd", "points")
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
    one.cache.events.step(one.now_s())
    (event,) = missed(one.event_log)
    assert (event.session, event.client, event.cells, event.layer) == (session.slot, "driver", 2, "points")
    assert event.id in ("-20_-20.pcd", "-20_0.pcd")
    assert isinstance(session.area, Circle)


def test_what_was_evicted_is_known_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.daemon.events.cell_events.MAX_EVICTED", 3)
    history = EvictionHistory()
    for number in range(5):
        history.note_eviction(Key(f"{number}", "points"), number)
    assert len(history._versions) == 3
    assert not history.take_eviction(Key("0", "points"), 0)  # forgotten
    assert history.take_eviction(Key("3", "points"), 3)
    assert not history.take_eviction(Key("3", "points"), 3)  # it was just brought back
    assert not history.take_eviction(Key("4", "points"), 99)  # it changed meanwhile


ROW = LiveMapRow(
    "lidar", "/maps/lidar", 0.1, "map", chunks=5, active=100, bytes=4096, loading=1, dirty=2, saving=1,
    waiting_bytes=9, files=3, file_bytes=777, scans=11, durable=7,
    budget_bytes=1 << 20, mappers=("0/front", "0/rear"), change=40,
)  # fmt: skip


class Shown:
    """Keeps what would stand in the statistics."""

    def __init__(self) -> None:
        self.values: dict[str, int] = {}

    def set(self, name: str, value: int) -> None:
        self.values[name] = value


class Published:
    """A log, and what it has published since the last look."""

    def __init__(self) -> None:
        self.shown, self.log, self._subscriber = Shown(), EventLog(epoch=5, clock_ns=lambda: 0), Subscriber()
        self.log.subscribe(self._subscriber)
        self._subscriber.take()
        self.events = LiveEvents(self.log, cast("StatisticsWriter", self.shown))

    def take(self) -> list[tuple[Any, ...]]:
        return [(type(one), *msgspec.structs.astuple(one)[3:]) for one in self._subscriber.take()]


def changed(**what: Any) -> LiveMapRow:
    return msgspec.structs.replace(ROW, **what)


def test_each_change_is_published_once() -> None:
    one = Published()
    one.events.begin(1, ())
    assert one.take() == [(e.LiveStarted, 1, 0)]
    one.events.update((ROW,))
    one.events.update((changed(scans=12),))
    assert one.take() == []  # how it was at first, and what is in no event
    last = one.log.last
    one.events.update((changed(change=41),))
    one.events.update((changed(change=41),))
    assert one.take() == [(e.LiveChanged, "lidar", 41)]
    assert one.log.last == last, "it takes no number: it would push out what happened to cells"
    full = changed(change=41, problem="chunk 0_0_0 cannot be saved: disk full")
    one.events.update((full,))
    one.events.update((changed(change=41, problem="chunk 1_0_0 cannot be saved: disk full"),))
    one.events.update((changed(change=41),))
    assert one.take() == [(e.LiveProblem, "lidar", full.problem), (e.LiveProblem, "lidar", "")]
    one.events.update((changed(change=41, damaged=("a",)),))
    one.events.update((changed(change=41, damaged=("a", "b")),))
    assert one.take() == [(e.LiveDamaged, "lidar", "a"), (e.LiveDamaged, "lidar", "b")]


def test_a_worker_that_ends_and_the_next_one() -> None:
    one = Published()
    one.events.begin(1, (changed(damaged=("a",)),))
    one.take()
    one.events.ended(1)
    one.events.started(1, 5)
    one.events.update((changed(damaged=("a",), change=99),))
    assert one.take() == [(e.LiveEnded, 1), (e.LiveStarted, 1, 5), (e.LiveChanged, "lidar", 99)]
    assert one.shown.values == {"live_restarts": 1}


def test_nothing_is_published_before_the_start() -> None:
    """What was found by then is published after it."""
    one = Published()
    one.events.started(1, 3)
    found = changed(problem="chunk 0_0_0 cannot be loaded: torn", damaged=("a",))
    one.events.update((found,))
    assert one.take() == []
    one.events.begin(1, (found,))
    assert one.take() == [
        (e.LiveStarted, 1, 3), (e.LiveDamaged, "lidar", "a"),
        (e.LiveProblem, "lidar", "chunk 0_0_0 cannot be loaded: torn"),
    ]  # fmt: skip
