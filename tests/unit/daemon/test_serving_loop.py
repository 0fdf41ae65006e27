# SPDX-License-Identifier: Apache-2.0
"""The loop goes on whatever fails in it, serves requests before other work, and measures its turns."""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

import pytest

from shmmap.daemon.events.cell_events import CellEvents
from shmmap.daemon.turns import LONG_TURN_NS, TURN_NS
from shmmap.protocol.events import LongTurn, Recent, decode_event
from tests.support.divided_map import DividedMap
from tests.unit.daemon.whole_daemon import WholeDaemon

TIMEOUT_S = 60.0


@pytest.fixture
def one(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> WholeDaemon:
    return whole(small_map.root)


def compute(nanoseconds: float) -> None:
    end_ns = time.thread_time_ns() + nanoseconds
    while time.thread_time_ns() < end_ns:
        pass


@contextlib.contextmanager
def watched(one: WholeDaemon, callback: Callable[[], object]) -> Iterator[Callable[[], object]]:
    """Have the loop watch a descriptor of the kind of loaders; what is returned makes it readable."""
    fd = os.eventfd(0, os.EFD_CLOEXEC)

    def call() -> None:
        os.eventfd_read(fd)
        callback()

    one.memory.watched.watch(fd, call, "loaders")
    try:
        yield lambda: os.eventfd_write(fd, 1)
    finally:
        one.memory.watched.unwatch(fd)
        os.close(fd)


def test_a_defect_beside_a_request_does_not_starve_its_process(
    one: WholeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What follows a request fails; the process's next request has its turn all the same."""

    def broken(_: CellEvents) -> NoReturn:
        raise RuntimeError("a defect")

    monkeypatch.setattr(CellEvents, "flush", broken)
    for request in (2, 3, 4):
        assert one.ask(Recent(request)).request == request
    assert one.memory.statistics.values["defects"] == 3


def test_turns_are_measured(one: WholeDaemon) -> None:
    """Processor time from one poll to the next, named after what took most of it; a long one is an event."""
    values, before = one.memory.statistics.values, one.memory.event_log.last
    with watched(one, lambda: compute(2 * LONG_TURN_NS)) as wake:
        wake()
        one.turn_until(lambda: values["longest_turn_loaders_ns"] >= 2 * LONG_TURN_NS)
    events = map(decode_event, one.memory.event_log.page(Recent(1, after=before)).events)
    (event,) = [found for found in events if isinstance(found, LongTurn) and found.kind == "loaders"]
    assert event.cpu_ns >= 2 * LONG_TURN_NS


def test_requests_come_before_other_work(one: WholeDaemon) -> None:
    """Of two loaders that are ready each is read in a turn of its own; requests between them are served."""
    (connection,) = one.service._connections
    requests, answered = iter((2, 3, 4)), list[int]()

    def ask() -> None:
        one.send(Recent(next(requests)))
        assert select.select([connection.fd], [], [], TIMEOUT_S)[0]

    def load() -> None:
        answered.append(one.memory.statistics.values["replies"] - before)
        compute(2 * TURN_NS)
        ask()

    before = one.memory.statistics.values["replies"]
    with watched(one, load) as wake_first, watched(one, load) as wake_second:
        wake_first()
        wake_second()
        ask()
        one.turn_until(lambda: len(answered) == 2)
    assert answered == [1, 2]
