# SPDX-License-Identifier: Apache-2.0
"""Whose request is served next: that of the process which has used the least of the loop's time.

Start-time fair queueing (Goyal, Vin, Cheng, SIGCOMM 1996) with equal weights: every process has a
clock that runs while its requests are served; the one furthest behind goes first, and who was idle
starts at the time that the service has come to, so that nobody saves up turns.  Within a process its
connections take turns.  What is asked for beyond the limits here is refused, not stored.

Pure: time is what `served` is told.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

__all__ = ["MOST_BYTES", "MOST_OF_A_CONNECTION", "MOST_OF_A_PROCESS", "FairQueue"]

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
    """Requests that were heard and wait to be served."""

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

    def waiting_bytes(self) -> dict[Hashable, int]:
        """Bytes that wait, by process."""
        return {process: line.nbytes for process, line in self._lines.items() if line.count}

    def _line_up(self, process: Hashable, line: _Line[Item]) -> None:
        self._number += 1  # among equals, first come first served
        heapq.heappush(self._ready, (line.clock_s, self._number, process))

    def _forget_idle(self) -> None:
        self._lines = {process: line for process, line in self._lines.items() if line.count}
