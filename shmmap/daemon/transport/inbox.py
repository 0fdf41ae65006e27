# SPDX-License-Identifier: Apache-2.0
"""Received requests, and the choice of the next one: from the process that has used least of the loop's time.

Start-time fair queueing (Goyal, Vin, Cheng, SIGCOMM 1996) with equal weights: every process has a clock that
runs while its requests are served, and the process furthest behind is next.  A process that was idle starts
at the current time of the service, so that idling saves nothing up.  Connections of one process take turns.
Work that takes longer than a step continues in the next turns of its process, before any other of its
requests.  Requests beyond the limits below are refused, not stored.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.turns import STEP_S
from shmmap.errors import Busy
from shmmap.protocol.codec import request_number
from shmmap.statistics.writer import StatisticsWriter

Item = TypeVar("Item")

MAX_PER_PROCESS: Final = 1024
"""Requests of one process that may wait; fewer are read from one connection at a time."""
MAX_PROCESS_BYTES: Final = 8 << 20
"""Bytes of one process's waiting requests; a single request may always wait."""
WORTH_AN_ANSWER_BYTES: Final = 1 << 16
"""A longer request that is refused unread is dropped without an answer: finding its number takes too long."""
MAX_REMEMBERED: Final = 4096
"""Processes whose clocks are remembered; an idle process that is forgotten loses a debt of milliseconds."""


@dataclass(eq=False, slots=True)
class _Line(Generic[Item]):
    """One process's waiting requests by connection; ``clock_s`` is the loop time it has been given.

    ``begun`` is the work that continues in its next turn.
    """

    clock_s: float
    begun: Item | None = None
    connections: dict[Hashable, deque[tuple[Item, int]]] = field(default_factory=dict)
    count: int = 0
    nbytes: int = 0


class FairQueue(Generic[Item]):
    """Requests that wait to be served; the class measures no time: the caller of `served` does."""

    def __init__(self) -> None:
        self._lines: dict[Hashable, _Line[Item]] = {}
        self._ready: list[tuple[float, int, Hashable]] = []
        self._clock_s = 0.0
        self._number = 0
        self._waiting = 0
        self._taken: Hashable = None  # the process being served

    def __len__(self) -> int:
        return self._waiting

    def add(
        self, process: Hashable, connection: Hashable, item: Item, nbytes: int, *, always: bool = False
    ) -> bool:
        """Queue an item; return False if too many of its process wait, unless ``always``."""
        line = self._lines.get(process)
        if line is None:
            if len(self._lines) >= MAX_REMEMBERED:
                self._forget_idle()
            line = self._lines[process] = _Line(self._clock_s)
        if not line.count and line.begun is None:
            line.clock_s = max(line.clock_s, self._clock_s)
            if process != self._taken:  # else `served` does it
                self._line_up(process, line)
        elif not always and (line.count >= MAX_PER_PROCESS or line.nbytes + nbytes > MAX_PROCESS_BYTES):
            return False
        line.connections.setdefault(connection, deque()).append((item, nbytes))
        line.count += 1
        line.nbytes += nbytes
        self._waiting += 1
        return True

    def take(self) -> tuple[Hashable, Item] | None:
        """Take the item to serve next, with its process; None if nothing waits.

        Call `served` before the next `take`; items may be added in between.
        """
        if not self._ready:
            return None
        self._clock_s, _, process = heapq.heappop(self._ready)
        self._taken = process
        line = self._lines[process]
        self._waiting -= 1
        if line.begun is not None:
            item, line.begun = line.begun, None
            return process, item
        connection, items = next(iter(line.connections.items()))
        item, nbytes = items.popleft()
        del line.connections[connection]
        if items:
            line.connections[connection] = items  # behind the other connections
        line.count -= 1
        line.nbytes -= nbytes
        return process, item

    def served(self, process: Hashable, seconds: float, begun: Item | None = None) -> None:
        """Charge the turn just taken to its process; ``begun`` continues in the process's next turn."""
        line, self._taken = self._lines[process], None
        line.clock_s += seconds
        if begun is not None:
            line.begun = begun
            self._waiting += 1
        if line.count or begun is not None:
            self._line_up(process, line)

    def _line_up(self, process: Hashable, line: _Line[Item]) -> None:
        self._number += 1  # among equals, first come first served
        heapq.heappush(self._ready, (line.clock_s, self._number, process))

    def _forget_idle(self) -> None:
        self._lines = {
            process: line
            for process, line in self._lines.items()
            if line.count or line.begun is not None or process == self._taken
        }


@dataclass(eq=False, slots=True)
class WorkItem:
    """Item served in a turn: a new request, or work that has begun or become due.

    Attributes
    ----------
    body, is_multipart
        A request's first frame, and whether it had more.
    work
        Remaining work, which may pause at each ``yield``; None before a request is dispatched, and after the
        last step.
    is_request
        Whether the item came over the connection, which counts its waiting requests, or from the daemon
        itself.
    """

    connection: Connection
    body: bytes = b""
    is_multipart: bool = False
    work: Iterator[None] | None = None
    is_request: bool = True
    is_done: bool = False

    @property
    def process(self) -> Hashable:
        """The process it is for; the connection if the kernel does not report the process."""
        return self.connection.peer.pid or self.connection

    @property
    def is_new(self) -> bool:
        """Whether it is a request that has not been dispatched yet."""
        return self.work is None and not self.is_done

    def run_step(self) -> None:
        """Run the next step; the work is done after its last step, or if the connection has ended."""
        work, self.work, self.is_done = self.work, None, True
        if work is not None and self.connection.open:
            end_s = time.monotonic() + STEP_S
            for _ in work:
                if time.monotonic() >= end_s:
                    self.work, self.is_done = work, False
                    break


class Inbox:
    """Requests received and not served yet, and work that is due."""

    def __init__(self, statistics: StatisticsWriter) -> None:
        self._statistics = statistics
        self._queue: FairQueue[WorkItem] = FairQueue()

    def __len__(self) -> int:
        return len(self._queue)

    def receive(self, connection: Connection, body: bytes, is_multipart: bool) -> None:
        """Queue a request, or refuse it if too many of its process wait."""
        self._statistics.add("requests")
        self._statistics.add("bytes_received", len(body))
        item = WorkItem(connection, body, is_multipart)
        if self._queue.add(item.process, connection, item, len(body)):
            connection.count_waiting(1, len(body))
        elif len(body) <= WORTH_AN_ANSWER_BYTES:
            error = Busy("too many requests of this process wait to be served", hint="wait for the replies")
            connection.refuse(request_number(body), error)

    def add_work(self, connection: Connection, work: Iterator[None]) -> None:
        """Queue ``work``; one step of it runs in each turn of this connection's process."""
        item = WorkItem(connection, work=work, is_request=False)
        self._queue.add(item.process, connection, item, 0, always=True)

    def take(self) -> WorkItem | None:
        """Take the next item to serve; call `served` afterwards."""
        return taken[1] if (taken := self._queue.take()) else None

    def served(self, item: WorkItem, seconds: float) -> None:
        """Record that a step of an item has run; queue the item again unless it was the last step."""
        if item.is_request and item.is_done:
            item.connection.count_waiting(-1, -len(item.body))
            item.connection.reweigh()
        self._queue.served(item.process, seconds, None if item.is_done else item)
