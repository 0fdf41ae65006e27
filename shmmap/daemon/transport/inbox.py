# SPDX-License-Identifier: Apache-2.0
"""Requests that have come, and whose is served next: that of the process that used least of the loop's time.

Start-time fair queueing (Goyal, Vin, Cheng, SIGCOMM 1996) with equal weights: every process has a
clock that runs while its requests are served; the one furthest behind goes first, and who was idle
starts at the time that the service has come to, so that nobody saves up turns.  Within a process its
connections take turns.  What takes longer than one turn goes on in the next ones of its process, before
anything else of it begins.  What is asked for beyond the limits here is refused, not stored.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

from shmmap.daemon.transport.connection import Connection
from shmmap.errors import Busy
from shmmap.protocol.codec import request_number
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MOST_BYTES", "MOST_OF_A_PROCESS", "FairQueue", "Inbox", "Turn"]

Item = TypeVar("Item")

MOST_OF_A_PROCESS: Final = 1024
"""Requests that may wait; of one connection fewer are taken off it at a time."""
MOST_BYTES: Final = 8 << 20
"""Bytes of one process's waiting requests; a single one may always wait."""
WORTH_AN_ANSWER_BYTES: Final = 1 << 16
"""A longer request that is refused unread is dropped: finding its number takes too long."""
MOST_REMEMBERED: Final = 4096
"""Processes whose clocks are remembered; those forgotten when idle lose a debt of milliseconds."""


@dataclass(eq=False, slots=True)
class _Line(Generic[Item]):
    """One process's waiting requests by connection; ``clock_s`` is the time they have been given.

    ``begun`` is the one that goes on in the next turn.
    """

    clock_s: float
    begun: Item | None = None
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
        self._taken: Hashable = None  # whose turn it is

    def __len__(self) -> int:
        return self._waiting

    def add(
        self, process: Hashable, connection: Hashable, item: Item, nbytes: int, *, always: bool = False
    ) -> bool:
        """Let something wait; False if too much of its process does, unless ``always``."""
        line = self._lines.get(process)
        if line is None:
            if len(self._lines) >= MOST_REMEMBERED:
                self._forget_idle()
            line = self._lines[process] = _Line(self._clock_s)
        if not line.count and line.begun is None:
            line.clock_s = max(line.clock_s, self._clock_s)
            if process != self._taken:  # else `served` does it
                self._line_up(process, line)
        elif not always and (line.count >= MOST_OF_A_PROCESS or line.nbytes + nbytes > MOST_BYTES):
            return False
        line.connections.setdefault(connection, deque()).append((item, nbytes))
        line.count += 1
        line.nbytes += nbytes
        self._waiting += 1
        return True

    def take(self) -> tuple[Hashable, Item] | None:
        """Take the request to serve now, and whose it is; None when nothing waits.

        Tell `served` before the next one; meanwhile more may come.
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
            line.connections[connection] = items  # behind the others
        line.count -= 1
        line.nbytes -= nbytes
        return process, item

    def served(self, process: Hashable, seconds: float, begun: Item | None = None) -> None:
        """The turn just taken was this long; ``begun`` goes on in the process's next one."""
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
class Turn:
    """What is served next: a request as it came, or work that has begun or become due.

    Attributes
    ----------
    body, several_frames
        A request's first frame, and whether there were more.
    work
        Does the rest, a bounded step at a time; None for a request that has just come.
    asked
        Whether it is a request that its connection is to be told of when it is over.
    """

    connection: Connection
    body: bytes = b""
    several_frames: bool = False
    work: Iterator[None] | None = None
    asked: bool = True

    @property
    def process(self) -> Hashable:
        """Whose turn it is: the process's; the connection's where the kernel does not tell which."""
        return self.connection.peer.pid or self.connection

    @property
    def over(self) -> bool:
        """Whether nothing is left to do."""
        return self.work is None

    def go_on(self) -> None:
        """Do the next step; `work` is None after the last one, and if nobody waits for it any more."""
        work, self.work = self.work, None
        if work is not None and self.connection.open:
            for _ in work:
                self.work = work
                break


class Inbox:
    """Requests heard and not yet served, and work that is due."""

    def __init__(self, statistics: StatisticsWriter) -> None:
        self._statistics = statistics
        self._queue: FairQueue[Turn] = FairQueue()

    def __len__(self) -> int:
        return len(self._queue)

    def hear(self, connection: Connection, body: bytes, several: bool) -> None:
        """Let a request wait for its turn, or refuse it: its process may have so many waiting."""
        self._statistics.add("requests")
        self._statistics.add("bytes_received", len(body))
        turn = Turn(connection, body, several)
        if self._queue.add(turn.process, connection, turn, len(body)):
            connection.note_waiting(1, len(body))
        elif len(body) <= WORTH_AN_ANSWER_BYTES:
            error = Busy("too many requests of this process wait to be served", hint="wait for the replies")
            connection.refuse(request_number(body), error)

    def due(self, connection: Connection, work: Iterator[None]) -> None:
        """Have ``work`` done, a step a turn, when it is the turn of this connection's process."""
        turn = Turn(connection, work=work, asked=False)
        self._queue.add(turn.process, connection, turn, 0, always=True)

    def take(self) -> Turn | None:
        """Take what is to be served now; tell `served` afterwards."""
        return taken[1] if (taken := self._queue.take()) else None

    def served(self, turn: Turn, seconds: float) -> None:
        """What was taken has been served, or a step of it."""
        if turn.asked and turn.over:
            turn.connection.note_waiting(-1, -len(turn.body))
            turn.connection.reweigh()
        self._queue.served(turn.process, seconds, None if turn.over else turn)
