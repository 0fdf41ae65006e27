# SPDX-License-Identifier: Apache-2.0
"""Numbers of events against a simulated daemon: gaps, restarts, and both at once."""

from __future__ import annotations

from collections import deque

import msgspec

from shmmap.client.event_stream import EventStream, MissedEvents
from shmmap.errors import NoAnswer
from shmmap.protocol import events as e


def changed(epoch: int, number: int) -> bytes:
    return e.encode_event(e.Changed(number, epoch, 0, f"{number}.pcd", number, "changed"))


class SimulatedStream(EventStream):
    """A stream whose daemon is in run ``run`` and remembers ``kept``; silent while ``silent``."""

    def __init__(self) -> None:
        self._ready = deque()
        self.epoch, self._expected, self._highest = 1, 1, 0
        self.run = 1
        self.kept: list[int] = []
        self.silent = False

    def _ask(self, message: e.Recent) -> e.EventPage:
        if self.silent:
            raise NoAnswer("silent")
        chosen = [msgspec.Raw(changed(self.run, n)) for n in self.kept if n > message.after]
        first, after = (self.kept[0], self.kept[-1] + 1) if self.kept else (1, 1)
        return e.EventPage(0, self.run, first, after, tuple(chosen[: min(message.limit, 2)]))

    def receive(self, *messages: bytes) -> list[object]:
        """Receive these; returns what `next` would: (epoch, number) of events, and what was missed."""
        for data in messages:
            self._take(data)
        received: list[object] = [h if isinstance(h, MissedEvents) else (h.epoch, h.seq) for h in self._ready]
        self._ready.clear()
        return received


def test_what_is_still_queued_of_a_run_that_ended() -> None:
    """Everything comes once and in order, also when the gap is noticed only in the next run."""
    stream = SimulatedStream()
    assert stream.receive(changed(1, 1)) == [(1, 1)]
    stream.run, stream.kept = 2, [1, 2, 3]
    assert stream.receive(changed(1, 4), changed(1, 5)) == [MissedEvents(1, 2, 3), (1, 4), (1, 5)]
    assert stream.receive(e.encode_event(e.Beat(6, 1, 0))) == [MissedEvents(1, 6, 6)]
    assert stream.receive(changed(2, 2), changed(2, 3)) == [(2, 1), (2, 2), (2, 3)]
    stream.kept.append(4)
    assert stream.receive(changed(2, 4)) == [(2, 4)]


def test_a_gap_while_the_daemon_is_silent() -> None:
    stream = SimulatedStream()
    stream.silent = True
    assert stream.receive(changed(1, 1), changed(1, 3)) == [(1, 1)]
    stream.silent, stream.kept = False, [1, 2, 3, 4]
    assert stream.receive(changed(1, 4)) == [(1, 2), (1, 3), (1, 4)]
    stream.silent = True
    assert stream.receive(changed(1, 7)) == []
    stream.silent, stream.run, stream.kept = False, 2, [1]
    assert stream.receive(changed(2, 1)) == [MissedEvents(1, 5, 7), (2, 1)]


def test_a_beat_names_the_last_number() -> None:
    stream = SimulatedStream()
    stream.kept = [1, 2, 3]
    assert stream.receive(e.encode_event(e.Beat(3, 1, 0))) == [(1, 1), (1, 2), (1, 3)]
    assert stream.receive(e.encode_event(e.Beat(3, 1, 0))) == []
    stream.kept = [9, 10]
    assert stream.receive(changed(1, 10)) == [MissedEvents(1, 4, 8), (1, 9), (1, 10)]


def test_what_takes_no_number_comes_after_all_that_was_before_it() -> None:
    stream = SimulatedStream()
    stream.kept = [1, 2]
    live = e.encode_event(e.LiveChanged(2, 1, 0, "lidar", 7))
    assert stream.receive(live) == [(1, 1), (1, 2), (1, 2)]
    assert stream.receive(live, changed(1, 3), live) == [(1, 2), (1, 3), (1, 2)]
    assert stream.receive(changed(1, 4)) == [(1, 4)]
