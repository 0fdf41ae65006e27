# SPDX-License-Identifier: Apache-2.0
"""What happened in this life of the daemon, numbered; the last of it is remembered.

Publishing costs some microseconds whoever listens: the log neither waits nor knows for whom.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable
from typing import Final

import msgspec

from shmmap.protocol import events
from shmmap.protocol.events import EventPage, Recent, encode_event

__all__ = ["EventLog", "PressureEvents", "nowhere"]

REMEMBERED: Final = 4096
"""Events kept for who asks later: under a megabyte."""
PAGE_EVENTS: Final = 500
PRESSURE_S: Final = 1.0


def nowhere(data: bytes) -> None:
    """Take an event's bytes when nobody can listen."""
    del data


class EventLog:
    """Numbers, remembers and sends events.

    Parameters
    ----------
    epoch
        This life of the daemon.
    clock_ns
        Wall clock, nanoseconds.

    Attributes
    ----------
    send : callable
        Given each event's bytes.
    last : int
        Number of the last event, 0 before the first.
    """

    def __init__(self, epoch: int, *, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self.epoch = epoch
        self.send: Callable[[bytes], None] = nowhere
        self.last = 0
        self._clock_ns = clock_ns
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=REMEMBERED)  # (unix_ns, event)

    def publish(self, kind: Callable[..., events.Event], *fields: object) -> None:
        """Number, remember and send an event made of ``kind`` and its own fields."""
        self.last += 1
        now_ns = self._clock_ns()
        data = encode_event(kind(self.last, self.epoch, now_ns, *fields))
        self._kept.append((now_ns, data))
        self.send(data)

    def mention(self, kind: Callable[..., events.Event], *fields: object) -> None:
        """Send an event that takes no number to those who listen now."""
        self.send(encode_event(kind(self.last, self.epoch, self._clock_ns(), *fields)))

    def standing(self) -> bytes:
        """Return the number of the last event, as an event."""
        return encode_event(events.Beat(self.last, self.epoch, self._clock_ns()))

    def beat(self) -> None:
        """Send the number of the last event."""
        self.mention(events.Beat)

    def page(self, message: Recent) -> EventPage:
        """Answer who asks for events again."""
        first = self.last - len(self._kept) + 1
        skip = min(max(0, message.after + 1 - first), len(self._kept))
        limit = max(0, min(message.limit, PAGE_EVENTS))
        kept = itertools.islice(self._kept, skip, None)
        chosen = (msgspec.Raw(data) for at_ns, data in kept if at_ns >= message.since_unix_ns)
        return EventPage(
            message.request, self.epoch, first, self.last + 1, tuple(itertools.islice(chosen, limit))
        )


class PressureEvents:
    """Tells of cells refused for lack of memory, at most once a second however many there are.

    Parameters
    ----------
    memory
        Gives budget, used, pinned and zombie bytes.
    """

    def __init__(self, log: EventLog, memory: Callable[[], tuple[int, int, int, int]]) -> None:
        self._log = log
        self._memory = memory
        self._refused = 0
        self._last: tuple[str, str, str] = ("", "", "")
        self._told_s = float("-inf")

    def refused(self, cell_id: str, layer: str, code: str, now_s: float) -> None:
        """Note that a cell was refused."""
        self._refused += 1
        self._last = (cell_id, layer, code)
        self.turn(now_s)

    def turn(self, now_s: float) -> None:
        """Tell what has not been told, if the last telling is long enough ago."""
        if self._refused and now_s - self._told_s >= PRESSURE_S:
            self._log.publish(events.Pressure, *self._last, self._refused, *self._memory())
            self._refused, self._told_s = 0, now_s
