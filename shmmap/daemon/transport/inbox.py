# SPDX-License-Identifier: Apache-2.0
"""Requests that have come, and whose is served next: that of the process that used least of the loop's time.

Start-time fair queueing (Goyal, Vin, Cheng, SIGCOMM 1996) with equal weights: every process has a
clock that runs while its requests are served; the one furthest behind goes first, and who was idle
starts at the time that the service has come to, so that nobody saves up turns.  Within a process its
connections take turns.  What is asked for beyond the limits here is refused, not stored.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from shmmap.daemon.transport.connection import Connection
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MOST_BYTES", "MOST_OF_A_CONNECTION", "MOST_OF_A_PROCESS", "FairQueue", "Heard", "Inbox"]

Item = TypeVar("Item")

MOST_OF_A_CONNECTION: Final = 64
"""Requests of one connection that may wait; the client library has one under way at a time."""
MOST_OF_A_PROCESS: Final = 1024
MOST_BYTES: Final = 8 << 20
"""Bytes of one process's waiting requests; a single one may always wait."""
MOST_REMEMBERED: Final = 4096
"""Processes whose clocks are remembered; those forgotten when idle lose a debt of milliseconds."""


@dataclass(eq=False, slots=True)
class _Line(Generic[Item]):
    """One process's waiting requests by connection; ``clock_s`` is the time they have been given."""

    clock_s: float
    connections: dict[Hashable, deque[tuple[Item, int]]] = field(default_factory=dict)
    count: int = 0
    nbytes: int = 0


class FairQueue(Generic[Item]):
    """Requests that wait to be served; pure: time is what `served` is told."""

    def __init__(self) -> None:
        self._lines: dict[Hashable, _Line[Item]] = {}
        self._ready: list[tuple[float, int, Hashable]] = []
        self._clock_s = 0.0
        self._number = 0
        self._waiting = 0

    def __len__(self) -> int:
        return self._waiting

    def add(self, process: Hashable, connection: Hashable, item: Item, nbytes: int) -> bool:
        """Let a request wait; False if too many of its connection or process do already."""
        line = self._lines.get(process)
        if line is None:
            if len(self._lines) >= MOST_REMEMBERED:
                self._forget_idle()
            line = self._lines[process] = _Line(self._clock_s)
        if not line.count:
            line.clock_s = max(line.clock_s, self._clock_s)
            self._line_up(process, line)
        elif line.count >= MOST_OF_A_PROCESS or line.nbytes + nbytes > MOST_BYTES:
            return False
        items = line.connections.get(connection)
        if items is None:
            items = line.connections[connection] = deque()
        elif len(items) >= MOST_OF_A_CONNECTION:
            return False
        items.append((item, nbytes))
        line.count += 1
        line.nbytes += nbytes
        self._waiting += 1
        return True

    def take(self) -> tuple[Hashable, Item] | None:
        """Take the request to serve now, and whose it is; None when nothing waits.

        Tell `served` before anything else.
        """
        if not self._ready:
            return None
        self._clock_s, _, process = heapq.heappop(self._ready)
        line = self._lines[process]
        connection, items = next(iter(line.connections.items()))
        item, nbytes = items.popleft()
        del line.connections[connection]
        if items:
            line.connections[connection] = items  # behind the others
        line.count -= 1
        line.nbytes -= nbytes
        self._waiting -= 1
        return process, item

    def served(self, process: Hashable, seconds: float) -> None:
        """Serving the request just taken took this long."""
        line = self._lines[process]
        line.clock_s += seconds
        if line.count:
            self._line_up(process, line)

    def _line_up(self, process: Hashable, line: _Line[Item]) -> None:
        self._number += 1  # among equals, first come first served
        heapq.heappush(self._ready, (line.clock_s, self._number, process))

    def _forget_idle(self) -> None:
        self._lines = {process: line for process, line in self._lines.items() if line.count}


@dataclass(eq=False, slots=True)
class Heard:
    """One request as it came: on which connection, its first frame, and whether there were more."""

    connection: Connection
    body: bytes
    several_frames: bool

    @property
    def process(self) -> Hashable:
        """Whose turn it is: the process's; the connection's where the kernel does not tell which."""
        return self.connection.peer.pid or self.connection


class Inbox:
    """Requests heard and not yet served.

    Parameters
    ----------
    refuse
        Called with a request that was heard beyond what one process may have waiting.
    """

    def __init__(self, statistics: StatisticsWriter, refuse: Callable[[Heard], None]) -> None:
        self._statistics = statistics
        self._refuse = refuse
        self._queue: FairQueue[Heard] = FairQueue()

    def __len__(self) -> int:
        return len(self._queue)

    def hear(self, connection: Connection, body: bytes, several: bool) -> None:
        """Let a request wait for its turn."""
        self._statistics.add("requests")
        self._statistics.add("bytes_received", len(body))
        heard = Heard(connection, body, several)
        if self._queue.add(heard.process, connection, heard, len(body)):
            connection.waiting_bytes += len(body)
        else:
            self._refuse(heard)

    def take(self) -> Heard | None:
        """Take the request whose turn it is; tell `served` afterwards."""
        turn = self._queue.take()
        return None if turn is None else turn[1]

    def served(self, heard: Heard, seconds: float) -> None:
        """A request taken has been served."""
        heard.connection.waiting_bytes -= len(heard.body)
        heard.connection.reweigh()
        self._queue.served(heard.process, seconds)
