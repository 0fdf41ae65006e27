# SPDX-License-Identifier: Apache-2.0
"""Accepting connections, and ending those of a process that takes more than there is.

Nothing happens while there are descriptors and memory enough.  Otherwise one process is chosen:

- no descriptor to spare: the one with most connections, which keeps as many as an equal share;
- too much memory: the one for which most is kept (half messages, waiting requests, unread replies); it
  loses all its connections.

A process that lost a connection wrongly connects again; what it maps is not touched.
"""

from __future__ import annotations

import ctypes
import resource
import socket
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

from shmmap.daemon.transport.connection import TOO_MUCH, Connection
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.logfmt import log
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["MEMORY_ALLOWANCE_BYTES", "Connections", "Listener"]

Socket: TypeAlias = socket.socket
ACCEPTED_AT_ONCE: Final = 16
ENDED_AT_ONCE: Final = 64
LEAST_RESERVE: Final = 48
"""Descriptors kept for the daemon's own work: loaders, segments it looks at, the map."""
LEAST_SHARE: Final = 8
"""A process with no more connections than this is never the culprit."""
MEMORY_ALLOWANCE_BYTES: Final = 32 << 20
"""What may be kept for all clients together."""


class Connections:
    """All connections of the daemon, by process.

    Attributes
    ----------
    nbytes : int
        What is kept for them.
    short : bool
        There is no descriptor to spare.
    """

    def __init__(self) -> None:
        self.nbytes = 0
        self._of: defaultdict[int, dict[Connection, None]] = defaultdict(dict)
        self.short = False
        self._waiting: list[Callable[[], None]] = []

    def __iter__(self) -> Iterator[Connection]:
        return (one for mine in self._of.values() for one in mine)

    def add(self, connection: Connection) -> None:
        """A connection was accepted."""
        self._of[connection.peer.pid][connection] = None
        # the kernel gives the lowest number that is free: all below are taken
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self.short = connection.fd >= limit - max(LEAST_RESERVE, limit // 16)

    def remove(self, connection: Connection) -> None:
        """A connection is closed."""
        mine = self._of[connection.peer.pid]
        del mine[connection]
        if not mine:
            del self._of[connection.peer.pid]
        self.try_again()

    def try_again(self) -> None:
        """Let whoever waits for room see whether there is some."""
        self.short = False
        waiting, self._waiting = self._waiting, []
        for go_on in waiting:
            go_on()

    def room(self, go_on: Callable[[], None]) -> bool:
        """Whether one more may be accepted; if not, ``go_on`` is called when a connection has ended.

        Connections are taken from the process that has most, those without a session first.
        """
        if not self.short:
            return True
        pid, mine = max(self._of.items(), key=lambda item: len(item[1]), default=(0, {}))
        share = max(LEAST_SHARE, sum(map(len, self._of.values())) // (2 * len(self._of) or 1))
        if len(mine) <= share:
            self._waiting.append(go_on)  # many processes with a few each: newcomers have to wait
            return False
        count = min(len(mine) - share, ENDED_AT_ONCE)
        _tell(pid, count, f"it had {len(mine)} connections")
        for one in sorted(mine, key=lambda one: one.session is not None)[:count]:
            one.end()
        return True

    def weigh(self, more_bytes: int) -> None:
        """Note that so much more is kept; too much costs the process that takes most its connections."""
        self.nbytes += more_bytes
        if more_bytes > 0 and self.nbytes > MEMORY_ALLOWANCE_BYTES:
            pid, mine = max(self._of.items(), key=lambda item: sum(one.weight for one in item[1]))
            _tell(pid, len(mine), TOO_MUCH)
            for one in mine:
                one.cut()
            ctypes.CDLL(None).malloc_trim(0)

    def deliver(self, seconds: float) -> None:
        """Wait at most so long for clients to read what was sent to them, and close all connections."""
        end_s = time.monotonic() + seconds
        for one in self:
            one.deliver(max(0.0, end_s - time.monotonic()))
            one.close()


@dataclass(eq=False, slots=True)
class Listener:
    """A listening Unix socket and what its connections have in common.

    Parameters
    ----------
    kind, other
        Types of ZeroMQ socket here and at the clients.
    most_bytes
        The longest message that a client may send.
    hear
        Called with a message's connection, its first frame, and whether it had more.
    on_ended
        Called with a connection that is closed.
    """

    socket: socket.socket
    watched: WatchedDescriptors
    connections: Connections
    statistics: StatisticsWriter
    kind: bytes
    other: bytes
    most_bytes: int
    hear: Callable[[Connection, bytes, bool], None]
    on_ended: Callable[[Connection], None]

    def move_to(self, other: Socket) -> None:
        """Listen at another socket; the connections there are stay, and those that wait are accepted."""
        for _ in range(0, socket.SOMAXCONN, ACCEPTED_AT_ONCE):
            self._accept()
        self.watched.unwatch(self.socket.fileno())
        self.socket.close()
        self.socket = other
        self.begin()

    def begin(self) -> None:
        """Accept connections from now on."""
        self.watched.watch(self.socket.fileno(), self._accept)

    def _accept(self) -> None:
        for _ in range(ACCEPTED_AT_ONCE):
            if not self.connections.room(self.begin):
                self.watched.unwatch(self.socket.fileno())
                return
            try:
                connected, _address = self.socket.accept()
            except BlockingIOError:
                return
            except OSError:  # the machine has no descriptor left
                self.connections.short = True
                return
            connected.setblocking(False)
            self.connections.add(Connection(connected, self))


def _tell(pid: int, count: int, reason: str) -> None:
    log.warning("connections ended", pid=pid, count=count, reason=reason)
