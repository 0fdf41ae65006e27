# SPDX-License-Identifier: Apache-2.0
"""Taking requests off the socket at once, and serving them in fair turns.

Inbox goes on whatever waits to be served, so that a request of a quiet process never stands in a
socket's queue behind those of a loud one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Final

import zmq

from shmmap.daemon.transport.fair_queue import FairQueue
from shmmap.daemon.transport.sessions import Peer, Sessions
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Heard", "Inbox", "peer_of"]

HEARD_AT_ONCE: Final = 16


@dataclass(eq=False, slots=True)
class Heard:
    """One request as it came: who sent it, its first frame, and whether there were more."""

    identity: bytes
    frame: zmq.Frame
    process: Hashable
    several_frames: bool


def peer_of(frame: zmq.Frame) -> Peer:
    """Return who sent a message, according to the kernel."""
    try:
        address = frame.get("Peer-Address")
    except zmq.ZMQError:
        return Peer()
    return Peer.parse(str(address))


class Inbox:
    """Requests heard and not yet served.

    Parameters
    ----------
    refuse
        Called with a request that was heard beyond what one process may have waiting.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        sessions: Sessions,
        statistics: StatisticsWriter,
        refuse: Callable[[Heard], None],
    ) -> None:
        self._socket = socket
        self._sessions = sessions
        self._statistics = statistics
        self._refuse = refuse
        self._queue: FairQueue[Heard] = FairQueue()

    def __len__(self) -> int:
        return len(self._queue)

    def hear(self) -> bool:
        """Take what is on the socket, a bounded number at once; False when there is no more."""
        for _ in range(HEARD_AT_ONCE):
            try:
                identity = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return False
            frame = self._socket.recv(copy=False)
            several = extra = frame.more
            while extra:  # no request has more than one frame: read and drop what is left of it
                extra = self._socket.recv(copy=False).more
            nbytes = len(frame.buffer)
            self._statistics.add("requests")
            self._statistics.add("bytes_received", nbytes)
            process = self._process(identity, frame)
            heard = Heard(identity, frame, process, several)
            if not self._queue.add(process, identity, heard, nbytes):
                self._refuse(heard)
        return True

    def _process(self, identity: bytes, frame: zmq.Frame) -> Hashable:
        """Whose turn it is: the process's; the connection's where the kernel does not tell which."""
        session = self._sessions.by_identity.get(identity)
        pid = session.peer.pid if session is not None else peer_of(frame).pid
        return pid if pid > 0 else identity

    def take(self) -> Heard | None:
        """Take the request whose turn it is; tell `served` afterwards."""
        turn = self._queue.take()
        return None if turn is None else turn[1]

    def served(self, heard: Heard, seconds: float) -> None:
        """A request taken has been served."""
        self._queue.served(heard.process, seconds)

    def waiting_bytes(self) -> dict[Hashable, int]:
        """Bytes of requests that wait, by process id (by identity where it is not known)."""
        return self._queue.waiting_bytes()
