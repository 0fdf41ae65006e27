# SPDX-License-Identifier: Apache-2.0
"""Sending replies, and noticing who does not read them.

libzmq keeps what a client does not read, up to `SEND_QUEUE` replies of any size each.  The loop never
waits for a reader: beyond that, replies are dropped; and a client that has left `MOST_UNREAD_BYTES`
unread loses its connection, and its replies with it.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import zmq

from shmmap.daemon.transport.connections import end_connection, unread_bytes
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import ShmmapError
from shmmap.failpoints import step
from shmmap.logfmt import log
from shmmap.protocol import messages
from shmmap.protocol.codec import encode
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["SEND_QUEUE", "Outbox"]

SEND_QUEUE: Final = 256
"""Outbox kept for a client that does not read them; further ones are dropped."""
DOUBTFUL_BYTES: Final = 1 << 20
"""When a session was sent this much, the kernel is asked whether it reads."""
MOST_UNREAD_BYTES: Final = 16 << 20


class Outbox:
    """The daemon's voice on one ROUTER socket.

    Attributes
    ----------
    paths
        Where the daemon listens; connections elsewhere are not looked at.
    """

    def __init__(self, socket: zmq.Socket[bytes], statistics: StatisticsWriter) -> None:
        self._socket = socket
        self._statistics = statistics
        self.paths: Collection[str] = ()

    def send(self, session: Session, reply: bytes) -> None:
        """Send a session one reply."""
        if session.unread_bytes > DOUBTFUL_BYTES and not self._reads(session):
            return
        session.unread_bytes += len(reply)
        self._send_to(session.identity, reply)

    def refuse(self, identity: bytes, request: int, error: ShmmapError) -> None:
        """Tell a connection, with a session or not, why its request is refused."""
        self._statistics.add("errors_returned")
        self._send_to(identity, encode(messages.ErrorReply(request, error.code, error.message, error.hint)))

    def _send_to(self, identity: bytes, reply: bytes) -> None:
        step("daemon.reply")
        try:
            self._socket.send(identity, zmq.SNDMORE | zmq.NOBLOCK)
            self._socket.send(reply, zmq.NOBLOCK)
            step("daemon.replied")
        except zmq.ZMQError as error:
            log.warning("reply dropped", error=error)
            return
        self._statistics.add("replies")
        self._statistics.add("bytes_sent", len(reply))

    def _reads(self, session: Session) -> bool:
        """Whether a session that was sent much continues to get replies.

        Who asks again has read the last reply as a rule: then nothing is left in the kernel, nor in
        libzmq, which keeps only what the kernel does not take.
        """
        left = unread_bytes(session.fd, session.peer.pid, self.paths)
        if not left:
            session.unread_bytes = 0
        elif session.unread_bytes > MOST_UNREAD_BYTES:
            if end_connection(session.fd, session.peer.pid, self.paths):
                why = f"it left {session.unread_bytes} bytes of replies unread"
                log.warning("connections ended", pid=session.peer.pid, count=1, reason=why)
            session.unread_bytes = 0
            return False
        return True

    def unread(self, sessions: Collection[Session]) -> dict[int, int]:
        """Bytes sent and, according to the kernel, not read, by process."""
        found: dict[int, int] = {}
        for session in sessions:
            pid = session.peer.pid
            if session.unread_bytes > DOUBTFUL_BYTES and unread_bytes(session.fd, pid, self.paths):
                found[pid] = found.get(pid, 0) + session.unread_bytes
        return found
