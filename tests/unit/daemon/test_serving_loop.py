# SPDX-License-Identifier: Apache-2.0
"""The loop goes on whatever fails in it, and with everybody's requests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, NoReturn, cast

from shmmap.daemon.host.defects import Defects
from shmmap.daemon.serving_loop import ServingLoop
from shmmap.daemon.transport.connection import Connection, Peer
from shmmap.daemon.transport.inbox import Inbox, Turn
from shmmap.statistics.writer import StatisticsWriter


class Counts(Counter[str]):
    def add(self, name: str, value: int = 1) -> None:
        self[name] += value

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

    nothing: Any = SimpleNamespace(poll=lambda _timeout_s: [], callbacks={}, tell_all=broken, handle=handle)
    loop = ServingLoop(
        nothing, inbox, nothing, nothing, nothing, nothing, nothing, nothing, statistics, Defects(statistics)
    )
    connection = cast("Connection", Client())
    for body in (b"first", b"second", b"third"):
        inbox.hear(connection, body, False)
    while len(inbox):
        loop._serve()
    assert handled == [b"first", b"second", b"third"]
    assert counts["defects"] == 3
