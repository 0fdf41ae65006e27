# SPDX-License-Identifier: Apache-2.0
"""The log of events: numbers, what is remembered and sent, and log lines of what happens often."""

from __future__ import annotations

import logging

import pytest

from shmmap.daemon.events.cell_events import PressureEvents
from shmmap.daemon.events.log import REMEMBERED, EventLog, MinuteLog
from shmmap.protocol import events as e
from tests.support.connections import Subscriber

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


def test_pressure_is_published_once_a_second() -> None:
    log, subscriber = subscribed()
    pressure = PressureEvents(log, lambda: MEMORY)
    for tenth in range(25):
        pressure.refused(f"{tenth}.pcd", "points", "over_budget", tenth / 10)
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
            pressure.refused(f"{step}.pcd", "points", code, step / 10)
    first, second = caplog.messages
    assert first.startswith(f"cells refused for lack of memory count=1 code={code} last=0.pcd layer=points")
    assert second.startswith(f"cells refused for lack of memory count=600 code={code} last=600.pcd")
    for line in (first, second):
        assert 'most_is_held_by="planner (pid 7): 3.0 MiB"' in line
        assert setting in line
