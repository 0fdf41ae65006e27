# SPDX-License-Identifier: Apache-2.0
"""When descriptors or memory run out, the process that takes most of them loses its connections.

Nothing happens while there is enough of both.  Otherwise the connections are counted, a few per turn
of the serving loop, and one process is chosen:

- no descriptor to spare: the one with most connections, which keeps as many as an equal share;
- too much memory: the one whose requests and unread replies take most, which loses all of them.

A process that lost a connection wrongly connects again; what it maps is not touched.
"""

from __future__ import annotations

import ctypes
import os
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Mapping
from pathlib import Path
from typing import Final

from shmmap.daemon.transport.connections import Census, end_connection
from shmmap.daemon.transport.listen_gate import ListenGate
from shmmap.logfmt import log

__all__ = ["MEMORY_ALLOWANCE_BYTES", "CrowdControl"]

LEAST_SHARE: Final = 8
"""A process with no more connections than this is never the culprit."""
MEMORY_ALLOWANCE_BYTES: Final = 192 << 20
"""What clients may make the daemon take, over what it had when it began to serve."""
TRIM_BYTES: Final = 16 << 20
"""When memory has grown by this much, what is free of it goes back to the kernel."""
TRIM_INTERVAL_S: Final = 2.0
MANY_CONNECTIONS: Final = 64
"""Each connection of a process beyond so many counts as memory."""
LEAST_WEIGHT_BYTES: Final = 1 << 18
"""A process that takes less than this is never the culprit."""
CENSUSES: Final = 8
"""How often the connections are looked at before one is judged by what arrives on it."""
_PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE")


class CrowdControl:
    """Watches descriptors and memory, and frees them from who takes too much.

    Parameters
    ----------
    gate
        Says when descriptors are short.
    waiting_bytes
        Gives the bytes of requests that wait, by process id.
    unread_bytes
        Gives the bytes of replies that were sent and perhaps not read, by process id.
    session_descriptors
        Gives the descriptors of connections that have a session.

    Attributes
    ----------
    ended : int
        Connections ended so far.
    """

    def __init__(
        self,
        gate: ListenGate,
        *,
        waiting_bytes: Callable[[], Mapping[Hashable, int]],
        unread_bytes: Callable[[], Mapping[int, int]],
        session_descriptors: Callable[[], Collection[int]],
    ) -> None:
        self._gate = gate
        self._waiting_bytes = waiting_bytes
        self._unread_bytes = unread_bytes
        self._session_descriptors = session_descriptors
        self._libc = ctypes.CDLL(None)
        self._first_bytes = 0
        self._trimmed_bytes = 0
        self._trim_again_s = 0.0
        self._heavy = False
        self._census: Census | None = None
        self._rounds = 0
        self._weights: Counter[int] = Counter()
        self.ended = 0

    def begin(self) -> None:
        """Serving begins: what is in memory now is the daemon's own."""
        self._first_bytes = self._trimmed_bytes = memory_bytes()

    def beat(self, now_s: float) -> None:
        """Look at memory and descriptors; called a few times a second."""
        self._gate.look_again(now_s)
        used = memory_bytes() or self._trimmed_bytes
        if used - self._trimmed_bytes > TRIM_BYTES and now_s >= self._trim_again_s:
            self._libc.malloc_trim(0)
            used = self._trimmed_bytes = memory_bytes() or used
            self._trim_again_s = now_s + TRIM_INTERVAL_S
        self._trimmed_bytes = min(self._trimmed_bytes, used)
        self._heavy = used - self._first_bytes > MEMORY_ALLOWANCE_BYTES
        if self._census is None and (self._heavy or self._gate.short):
            self._begin_census()

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return self._census is None

    def step(self) -> None:
        """Go on with a census; act on it when it is complete."""
        if self._census is None or not self._census.step():
            return
        census, self._census = self._census, None
        if self._gate.short and not self._heavy:
            self._thin_out(census.connections)
            return
        self._rounds += 1
        self._weights.update(census.arriving)
        if self._rounds < CENSUSES:
            self._census = Census(self._gate.paths)
            return
        self._expel(census.connections)

    def _begin_census(self) -> None:
        self._rounds = 0
        self._weights = Counter()
        self._census = Census(self._gate.paths)

    def _thin_out(self, connections: Mapping[int, list[int]]) -> None:
        """Take connections from the process that has most, those without a session first."""
        if not connections:
            return
        pid, mine = max(connections.items(), key=lambda item: len(item[1]))
        share = max(LEAST_SHARE, sum(map(len, connections.values())) // (2 * len(connections)))
        if len(mine) <= share:
            return  # many processes with a few each: newcomers have to wait
        with_session = set(self._session_descriptors())
        mine.sort(key=lambda fd: fd in with_session)
        self._end(pid, mine[: len(mine) - share], f"it had {len(mine)} connections")

    def _expel(self, connections: Mapping[int, list[int]]) -> None:
        """End all connections of the process that takes most memory."""
        weights = Counter(self._weights)
        for process, nbytes in self._waiting_bytes().items():
            if isinstance(process, int):
                weights[process] += nbytes
        weights.update(self._unread_bytes())
        for pid, fds in connections.items():
            weights[pid] += max(0, len(fds) - MANY_CONNECTIONS) << 16  # half a frame may lie in each
        guilty = [pid for pid in connections if weights[pid] >= LEAST_WEIGHT_BYTES]
        if guilty:
            pid = max(guilty, key=lambda one: weights[one])
            self._end(pid, connections[pid], "it made the daemon take too much memory")
        else:  # no client's doing: the map grew, say
            self._first_bytes = memory_bytes()
        self._libc.malloc_trim(0)

    def _end(self, pid: int, descriptors: Collection[int], why: str) -> None:
        ended = sum(end_connection(fd, pid, self._gate.paths) for fd in descriptors)
        self.ended += ended
        log.warning("connections ended", pid=pid, count=ended, reason=why)


def memory_bytes() -> int:
    """Resident memory of this process, without what it shares; 0 while no descriptor is left to ask with."""
    try:
        fields = Path("/proc/self/statm").read_text().split()
    except OSError:
        return 0
    return (int(fields[1]) - int(fields[2])) * _PAGE_BYTES
