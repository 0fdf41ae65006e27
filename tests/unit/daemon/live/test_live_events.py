# SPDX-License-Identifier: Apache-2.0
"""Events about live maps: each change once, and none before the daemon's own first one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import msgspec

from shmmap.daemon.events.log import EventLog
from shmmap.daemon.live.relay import LiveEvents
from shmmap.protocol import events as e
from shmmap.protocol.rows import LiveMapRow
from shmmap.statistics.writer import StatisticsWriter
from tests.support.connections import Subscriber

ROW = LiveMapRow(
    "lidar", "/maps/lidar", 0.1, "map", chunks=5, active=100, bytes=4096, loading=1, dirty=2, saving=1,
    waiting_bytes=9, files=3, file_bytes=777, scans=11, durable=7,
    budget_bytes=1 << 20, mappers=("0/front", "0/rear"), change=40,
)  # fmt: skip


class Shown:
    """Keeps what would stand in the statistics."""

    def __init__(self) -> None:
        self.rows: Sequence[LiveMapRow] = ()
        self.values: dict[str, int] = {}

    def show_live_maps(self, rows: Sequence[LiveMapRow]) -> None:
        self.rows = rows

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
    one.events.begin(1)
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
    one.events.begin(1)
    one.events.update((changed(damaged=("a",)),))
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
    one.events.update((changed(problem="chunk 0_0_0 cannot be loaded: torn", damaged=("a",)),))
    assert one.take() == []
    one.events.begin(1)
    assert one.take() == [
        (e.LiveStarted, 1, 3), (e.LiveDamaged, "lidar", "a"),
        (e.LiveProblem, "lidar", "chunk 0_0_0 cannot be loaded: torn"),
    ]  # fmt: skip


def test_the_statistics_show_them() -> None:
    one = Published()
    one.events.update(
        (ROW, changed(name="radar", damaged=("a", "b"), problem="chunk 0_0_0 cannot be loaded: torn"))
    )
    lidar, radar = one.shown.rows
    assert (lidar, radar.name, radar.damaged) == (ROW, "radar", ("a", "b"))
