# SPDX-License-Identifier: Apache-2.0
"""What happened in this life of the daemon, numbered; the last of it is remembered.

Publishing costs some microseconds whoever listens: the log neither waits nor knows for whom.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

import msgspec

from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.protocol.events import EventPage, Recent, encode_event

__all__ = ["EventLog", "MinuteLog", "PressureEvents", "nowhere"]

REMEMBERED: Final = 4096
"""Events kept for who asks later: under a megabyte."""
PAGE_EVENTS: Final = 500
PRESSURE_S: Final = 1.0
LOG_S: Final = 60.0
_NAMED: Final = 3
_SETTINGS: Final = {
    "over_budget": "budget (--budget): raise it, or have clients hold less",
    "quota": "session_quota (--session-quota): raise it, or have this client hold less",
    "no_space": "shm_dir (--shm-dir): its file system is full, or smaller than the budget",
}
"""What an operator can change, by the code of a refusal."""


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


class MinuteLog:
    """Log lines about what happens often: the first at once, then one a minute with the sum."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = {}
        self._bytes: Counter[str] = Counter()
        self._due_s: dict[str, float] = {}

    def count(self, event: str, of: str, nbytes: int) -> None:
        """Add one of an event, of a client or for a reason, and its bytes."""
        self._counts.setdefault(event, Counter())[of] += 1
        self._bytes[event] += nbytes

    def step(self, now_s: float) -> None:
        """Log what has been counted and is due."""
        for event in [event for event in self._counts if now_s >= self._due_s.get(event, float("-inf"))]:
            of = self._counts.pop(event)
            most = ", ".join(f"{count} {name}" for name, count in of.most_common(_NAMED))
            more = f" and {len(of) - _NAMED} more" if len(of) > _NAMED else ""
            log.info(event, count=of.total(), bytes=self._bytes.pop(event), of=most + more)
            self._due_s[event] = now_s + LOG_S


class PressureEvents:
    """Cells refused for lack of memory: an event a second and a log line a minute, however many there are.

    Parameters
    ----------
    memory
        Gives budget, used, pinned and zombie bytes.
    holder
        Says who has most of the memory.
    """

    def __init__(
        self,
        event_log: EventLog,
        memory: Callable[[], tuple[int, int, int, int]],
        holder: Callable[[], str] = str,
    ) -> None:
        self._event_log = event_log
        self._memory = memory
        self._holder = holder
        self._refused = 0
        self._unlogged = 0
        self._last: tuple[str, str, str] = ("", "", "")
        self._told_s = self._logged_s = float("-inf")

    def refused(self, cell_id: str, layer: str, code: str, now_s: float) -> None:
        """Note that a cell was refused."""
        self._refused += 1
        self._unlogged += 1
        self._last = (cell_id, layer, code)
        self.step(now_s)

    def step(self, now_s: float) -> None:
        """Publish and log what has not been, if the last time is long enough ago."""
        if self._refused and now_s - self._told_s >= PRESSURE_S:
            self._event_log.publish(events.Pressure, *self._last, self._refused, *self._memory())
            self._refused, self._told_s = 0, now_s
        if self._unlogged and now_s - self._logged_s >= LOG_S:
            cell, layer, code = self._last
            budget, used, pinned, _ = self._memory()
            log.warning(
                "cells refused for lack of memory", count=self._unlogged, code=code, last=cell, layer=layer,
                budget_bytes=budget, used_bytes=used, in_use_bytes=pinned,
                most_is_held_by=self._holder() or None,
                setting=_SETTINGS.get(code),
            )  # fmt: skip
            self._unlogged, self._logged_s = 0, now_s
