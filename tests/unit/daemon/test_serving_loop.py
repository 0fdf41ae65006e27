# SPDX-License-Identifier: Apache-2.0
"""The loop goes on whatever fails in it, and with everybody's requests."""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import Counter, deque
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NoReturn, cast

from shmmap.daemon.host.defects import Defects
from shmmap.daemon.serving_loop import ENOUGH_NS, LONG_TURN_NS, ServingLoop
from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.daemon.transport.inbox import Inbox, Turn
from shmmap.protocol.events import LongTurn, Recent, decode_event
from shmmap.statistics.histogram import Histogram
from shmmap.statistics.writer import StatisticsWriter
from tests.support.divided_map import DividedMap
from tests.unit.daemon.inner_daemon import Inner


class Counts(Counter[str]):
    def add(self, name: str, value: int = 1) -> None:
        self[name] += value

    def add_turn(self, kind: str, nanoseconds: int) -> None:
        self[f"turn of {kind}"] += nanoseconds

    def add_duration(self, name: str, nanoseconds: int) -> None:
        assert nanoseconds >= 0
        self[name] += 1


class Client:
    """A connection that only asks."""

    peer = Peer(0, 0, 1)
    open = True

    def note_waiting(self, more: int, more_bytes: int) -> None:
        pass

    def reweigh(self) -> None:
        pass


def broken() -> NoReturn:
    raise RuntimeError("a defect")


def test_a_defect_beside_a_request_does_not_starve_its_process() -> None:
    """Whatever follows a request fails; the process's next request has its turn all the same."""
    counts = Counts()
    statistics = cast("StatisticsWriter", counts)
    inbox = Inbox(statistics)
    handled: list[bytes] = []

    def handle(turn: Turn) -> Iterator[None]:
        handled.append(turn.body)
        yield from ()

    nothing: Any = SimpleNamespace(poll=lambda _timeout_s: [], callbacks={}, flush=broken, handle=handle)
    loop = ServingLoop(
        nothing, inbox, nothing, nothing, nothing, nothing, nothing, nothing, deque(),
        statistics, Defects(statistics), nothing,
    )  # fmt: skip
    connection = cast("Connection", Client())
    for body in (b"first", b"second", b"third"):
        inbox.hear(connection, body, False)
    while len(inbox):
        loop._serve()
    assert handled == [b"first", b"second", b"third"]
    assert counts["defects"] == 3


def test_turns_are_measured(inner: Inner, small_map: DividedMap) -> None:
    """Processor time from one look at the descriptors to the next, named after what took most of it."""
    one = inner(small_map.root)
    busy_s = 0.02

    def compute() -> None:
        os.read(read, 1)
        end_s = time.thread_time() + busy_s
        while time.thread_time() < end_s:
            pass

    read, write = os.pipe()
    one.watched.watch(read, compute, "loaders")
    nothing: Any = SimpleNamespace(
        free=lambda _now_s: None, pump=lambda _now_s: None, flush=lambda: None,
        end_overdue=lambda _now_s: None, answer_overdue=lambda _now_s: None, answer_finished=lambda: None,
        stop_by_s=math.inf,
        unfinished=False, pending=False,
    )  # fmt: skip
    nothing.lost = nothing
    loop = ServingLoop(
        one.watched, Inbox(one.statistics), nothing, nothing, nothing, nothing, nothing, nothing, deque(),
        one.statistics, Defects(one.statistics), one.event_log,
    )  # fmt: skip
    told = one.event_log.last
    try:
        for _ in range(2):
            os.write(write, b"x")
            loop._turn(loop._poll(0))
        loop._poll(0)
    finally:
        one.watched.unwatch(read)
        os.close(read)
        os.close(write)
    values = one.statistics.values
    assert values["longest_turn_loaders_ns"] >= busy_s * 1e9
    ended = Histogram.of(one.statistics._durations["turn"]).total
    assert ended >= 1 + 2 * 2, "a turn that has taken long begins no other work"
    page = one.event_log.page(Recent(1, after=told))
    event = decode_event(page.events[0])
    assert isinstance(event, LongTurn)
    assert (event.kind, event.cpu_ns >= LONG_TURN_NS) == ("loaders", True)


def test_clients_are_served_before_anything_else_is_heard(inner: Inner, small_map: DividedMap) -> None:
    """Of two loaders that have something to say each is heard in a turn of its own if the first took long."""
    one = inner(small_map.root)
    happened: list[str] = []
    inbox = Inbox(one.statistics)

    def handle(_turn: Turn) -> Iterator[None]:
        happened.append("request")
        yield from ()

    def loader(fd: int) -> None:
        os.read(fd, 1)
        happened.append("loader")
        end_s = time.thread_time() + 2e-9 * ENOUGH_NS
        while time.thread_time() < end_s:
            pass
        os.write(asks, b"x")  # meanwhile somebody asks

    def client() -> None:
        os.read(asked, 1)
        inbox.hear(cast("Connection", Client()), b"ask", False)

    nothing: Any = SimpleNamespace(
        free=lambda _now_s: None, pump=lambda _now_s: None, flush=lambda: None, handle=handle,
        end_overdue=lambda _now_s: None, answer_overdue=lambda _now_s: None, answer_finished=lambda: None,
        stop_by_s=math.inf,
        unfinished=False, pending=False,
    )  # fmt: skip
    nothing.lost = nothing
    loop = ServingLoop(
        one.watched, inbox, nothing, nothing, nothing, nothing, nothing, nothing, deque(),
        one.statistics, Defects(one.statistics), one.event_log,
    )  # fmt: skip
    with contextlib.ExitStack() as stack:

        def pipe() -> tuple[int, int]:
            ends = os.pipe()
            for end in ends:
                stack.callback(os.close, end)
            return ends

        loaders, (asked, asks) = [pipe(), pipe()], pipe()
        for read, write in loaders:
            one.watched.watch(read, lambda fd=read: loader(fd), "loaders")  # type: ignore[misc]
            stack.callback(one.watched.unwatch, read)
            os.write(write, b"x")
        one.watched.watch(asked, client)
        stack.callback(one.watched.unwatch, asked)
        os.write(asks, b"x")
        loop._turn(loop._poll(0))
    assert happened == ["request", "loader", "request", "loader", "request"]
