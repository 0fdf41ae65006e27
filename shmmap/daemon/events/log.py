# SPDX-License-Identifier: Apache-2.0
"""Numbered events of this run of the daemon: the latest ones are stored, and all are sent to subscribers.

Events are sent over an XPUB socket next to the request socket.  The log waits for no subscriber and keeps
nothing for one: a slow subscriber gets the stored events when it reads again.  Those that are forgotten by
then it loses, and notices by their numbers.
"""

from __future__ import annotations

import itertools
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Final, Protocol

import msgspec

from shmmap.daemon.transport.connection import Connection, Connections, Listener
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.logfmt import log
from shmmap.protocol import events
from shmmap.protocol.events import EventPage, Recent, encode_event
from shmmap.statistics.writer import StatisticsWriter

REMEMBERED: Final = 4096
"""Events stored for later requests and slow subscribers: less than a megabyte."""
PAGE_EVENTS: Final = 500
LOG_S: Final = 60.0
SENT_TOGETHER: Final = 64
"""Events sent to a slow subscriber at once; what it does not read of them is all that is kept for it."""
MAX_SUBSCRIPTION_BYTES: Final = 64
_NAMED: Final = 3
_SUBSCRIBE: Final = b"\x01"  # followed by a prefix


class Subscriber(Protocol):
    """A receiver of all events."""

    def offer(self, bodies: Iterable[bytes], /) -> bool:
        """Send messages, unless earlier ones are unread; return whether these have been taken whole."""


class EventLog:
    """Numbers, stores and sends events.

    Parameters
    ----------
    epoch
        Number of this run of the daemon.
    clock_ns
        Wall clock, nanoseconds.

    Attributes
    ----------
    last : int
        Number of the last event, 0 before the first.
    """

    def __init__(self, epoch: int, *, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self.epoch = epoch
        self.last = 0
        self._clock_ns = clock_ns
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=REMEMBERED)  # (unix_ns, event)
        self._subscribers: dict[Subscriber, None] = {}  # that have read all
        self._slow: dict[Subscriber, int] = {}  # the others, with the number of the event to send next

    def subscribe(self, subscriber: Subscriber) -> None:
        """Send all events to a subscriber from now on, beginning with the number of the last event."""
        self.unsubscribe(subscriber)
        self._send_to([subscriber], self._event(events.Beat))

    def unsubscribe(self, subscriber: Subscriber) -> None:
        """Stop sending events to a subscriber."""
        self._subscribers.pop(subscriber, None)
        self._slow.pop(subscriber, None)

    def resume(self, subscriber: Subscriber) -> bool:
        """Send a slow subscriber, which has read all that was sent, some of the stored events that it lacks.

        Returns whether it lacks more, and has room for them.
        """
        number = self._slow.pop(subscriber, None)
        if number is None:
            return False
        first = self.last - len(self._kept) + 1
        number = max(number, first)
        some = list(itertools.islice(self._kept, number - first, number - first + SENT_TOGETHER))
        number += len(some)
        taken = subscriber.offer(data for _at_ns, data in some)
        if taken and number > self.last:
            self._subscribers[subscriber] = None
            return False
        self._slow[subscriber] = number
        return taken

    def close(self) -> None:
        """Stop sending events."""
        self._subscribers.clear()
        self._slow.clear()

    def publish(self, kind: Callable[..., events.Event], *fields: object) -> None:
        """Send an event made of ``kind`` and its own fields, with the next number, and store it."""
        self.last += 1
        now_ns = self._clock_ns()
        data = encode_event(kind(self.last, self.epoch, now_ns, *fields))
        self._kept.append((now_ns, data))
        self._send_to(list(self._subscribers), data)

    def mention(self, kind: Callable[..., events.Event], *fields: object) -> None:
        """Send an event without a number, which is not stored; slow subscribers do not get it."""
        self._send_to(list(self._subscribers), self._event(kind, *fields))

    def beat(self) -> None:
        """Send the number of the last event."""
        self.mention(events.Beat)

    def _event(self, kind: Callable[..., events.Event], *fields: object) -> bytes:
        return encode_event(kind(self.last, self.epoch, self._clock_ns(), *fields))

    def _send_to(self, subscribers: Iterable[Subscriber], data: bytes) -> None:
        for one in subscribers:
            if one.offer((data,)):
                self._subscribers[one] = None
            else:
                self._subscribers.pop(one, None)
                self._slow[one] = self.last + 1

    def page(self, message: Recent) -> EventPage:
        """Return past events in answer to a request."""
        first = self.last - len(self._kept) + 1
        skip = min(max(0, message.after + 1 - first), len(self._kept))
        limit = max(0, min(message.limit, PAGE_EVENTS))
        kept = itertools.islice(self._kept, skip, None)
        chosen = (msgspec.Raw(data) for at_ns, data in kept if at_ns >= message.since_unix_ns)
        return EventPage(
            message.request, self.epoch, first, self.last + 1, tuple(itertools.islice(chosen, limit))
        )


def events_path(request_path: str) -> str:
    """Return the path of the event socket that belongs to this request socket."""
    return request_path.removesuffix(".sock") + ".events.sock"


def event_listener(
    listening: socket.socket,
    watched: WatchedDescriptors,
    connections: Connections,
    statistics: StatisticsWriter,
    event_log: EventLog,
) -> Listener:
    """Return a listener at the event log's socket: clients subscribe to all events or to none."""

    def on_message(connection: Connection, body: bytes, several: bool) -> None:
        if several or body not in (_SUBSCRIBE, b"\x00"):
            connection.cut("it subscribed to some of the events: only all can be subscribed to")
        elif body == _SUBSCRIBE:
            event_log.subscribe(connection)
        else:
            event_log.unsubscribe(connection)

    return Listener(
        listening,
        watched,
        connections,
        statistics,
        b"XPUB",
        b"SUB",
        MAX_SUBSCRIPTION_BYTES,
        on_message,
        event_log.unsubscribe,
        event_log.resume,
    )


class MinuteLog:
    """Log lines about frequent events: the first at once, then one per minute with the total."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = {}
        self._bytes: Counter[str] = Counter()
        self._due_s: dict[str, float] = {}

    def count(self, event: str, of: str, nbytes: int) -> None:
        """Count an event and its bytes; ``of`` is the client or reason named in the log line."""
        self._counts.setdefault(event, Counter())[of] += 1
        self._bytes[event] += nbytes

    def step(self, now_s: float) -> None:
        """Log the counts that are due."""
        for event in [event for event in self._counts if now_s >= self._due_s.get(event, float("-inf"))]:
            of = self._counts.pop(event)
            most = ", ".join(f"{count} {name}" for name, count in of.most_common(_NAMED))
            more = f" and {len(of) - _NAMED} more" if len(of) > _NAMED else ""
            log.info(event, count=of.total(), bytes=self._bytes.pop(event), of=most + more)
            self._due_s[event] = now_s + LOG_S
