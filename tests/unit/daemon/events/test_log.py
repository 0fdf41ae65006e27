# SPDX-License-Identifier: Apache-2.0
"""The log of events: numbers, what is remembered, and pressure told at most once a second."""

from __future__ import annotations

from shmmap.daemon.events.log import REMEMBERED, EventLog, PressureEvents
from shmmap.protocol import events as e

MEMORY = (100, 90, 80, 70)


def log_of(sent: list[e.Event], *, epoch: int = 7) -> EventLog:
    """Return a log whose clock ticks once per event."""
    ticks = iter(range(1, 1 << 20))
    log = EventLog(epoch, clock_ns=lambda: next(ticks))
    log.send = lambda data: sent.append(e.decode_event(data))  # type: ignore[arg-type]
    return log


def numbers(page: e.EventPage) -> list[int]:
    return [event.seq for data in page.events if (event := e.decode_event(data)) is not None]


def test_events_are_numbered_sent_and_remembered() -> None:
    sent: list[e.Event] = []
    log = log_of(sent)
    assert numbers(log.page(e.Recent(1))) == []
    for number in range(3):
        log.publish(e.Changed, f"{number}.pcd", number, "changed")
    log.beat()
    assert [event.seq for event in sent] == [1, 2, 3, 3]
    assert isinstance(sent[-1], e.Beat)
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
    log = log_of([])
    for _ in range(REMEMBERED + 10):
        log.publish(e.Changed, "a.pcd", 1, "changed")
    page = log.page(e.Recent(1, limit=1 << 30))
    assert (page.first, page.next) == (11, REMEMBERED + 11)
    assert numbers(page) == list(range(11, 511))  # a page is never longer, whatever is asked for


def test_pressure_is_told_once_a_second() -> None:
    sent: list[e.Event] = []
    pressure = PressureEvents(log_of(sent), lambda: MEMORY)
    for tenth in range(25):
        pressure.refused(f"{tenth}.pcd", "points", "over_budget", tenth / 10)
    pressure.turn(2.5)
    pressure.turn(3.0)
    pressure.turn(9.0)
    told = [(event.id, event.refused) for event in sent if isinstance(event, e.Pressure)]
    assert told == [("0.pcd", 1), ("10.pcd", 10), ("20.pcd", 10), ("24.pcd", 4)]
