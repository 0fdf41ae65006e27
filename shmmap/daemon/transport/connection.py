# SPDX-License-Identifier: Apache-2.0
"""One connection: whose it is, what comes on it, and what was sent and is not read."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from shmmap.daemon.transport.zmtp import GREETING, Incoming, framed
from shmmap.errors import BadRequest, ProtocolMismatch, ShmmapError
from shmmap.failpoints import step
from shmmap.logfmt import log
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import ErrorReply

if TYPE_CHECKING:
    from shmmap.daemon.transport.listener import Listener
    from shmmap.daemon.transport.sessions import Session

__all__ = ["Connection", "Peer"]

MOST_UNREAD_BYTES: Final = 16 << 20
"""Of replies; whoever leaves more does not read them."""
READ_BYTES: Final = 1 << 16
"""Taken off a connection per turn of the loop."""
FRAMES_AT_ONCE: Final = 4
MOST_WAITING: Final = 48
"""Requests of a connection that are taken off it and wait; about, for some come at once."""
LIGHT_BYTES: Final = 1 << 12
"""What is kept for every client, and does not count."""
TOO_MUCH: Final = "it made the daemon take too much memory"
_CREDENTIALS: Final = struct.Struct("iII")  # struct ucred: pid, uid, gid


@dataclass(frozen=True, slots=True)
class Peer:
    """Credentials of a connected process; pid 0 where it is not visible from here."""

    uid: int = -1
    gid: int = -1
    pid: int = 0


class Connection:
    """A connected Unix socket on which a client speaks ZMTP.

    Attributes
    ----------
    open : bool
        Whether it is not closed yet.
    session : Session or None
        Who has said hello on it.
    unsent_bytes : int
        What the kernel does not take, because the client does not read.
    waiting, waiting_bytes : int
        Requests that wait to be served.
    weight : int
        All memory that is kept for it, bytes.
    """

    def __init__(self, connected: socket.socket, listener: Listener) -> None:
        # according to the kernel
        credentials = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        pid, uid, gid = _CREDENTIALS.unpack(credentials)
        self.peer = Peer(uid, gid, pid)
        self.open = True
        self.session: Session | None = None
        self.unsent_bytes = 0
        self.waiting = self.waiting_bytes = 0
        self.weight = 0
        self._reading = True
        self._socket = connected
        self._listener = listener
        self._watched = listener.watched
        self._incoming = Incoming(listener.kind, listener.other, listener.most_bytes)
        self._unsent: deque[memoryview] = deque()
        self._cut = False
        self.fd = connected.fileno()
        self._watched.watch(self.fd, self._ready)
        self._send(GREETING)

    def reply(self, body: bytes) -> None:
        """Send a reply; whoever leaves too much unread loses the connection, and the replies with it."""
        step("daemon.reply")
        self._send(framed(body))
        step("daemon.replied")
        self._listener.statistics.add("replies")
        self._listener.statistics.add("bytes_sent", len(body))
        if self.unsent_bytes > MOST_UNREAD_BYTES:
            self.cut(f"it left {self.unsent_bytes} bytes of replies unread")

    def refuse(self, request: int, error: ShmmapError) -> None:
        """Say why a request is refused."""
        self._listener.statistics.add("errors_returned")
        self.reply(encode(ErrorReply(request, error.code, error.message, error.hint)))

    def tell(self, body: bytes, most_unread_bytes: int) -> None:
        """Send a message; it is lost if that much is unread already."""
        if self.unsent_bytes <= most_unread_bytes:
            self._send(framed(body))

    def cut(self, reason: str = "") -> None:
        """Have the loop end it, which may be in the middle of something now; logged if there is a reason."""
        if not self._cut:
            self._cut = True
            self._incoming.forget()
            self._forget_unsent()
            self.reweigh()
            if reason:
                log.warning("connections ended", pid=self.peer.pid, count=1, reason=reason)
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def end(self) -> None:
        """Close it now and tell its owner; only the loop itself may, between one thing and the next."""
        if self.open:
            self.close()
            self._listener.connections.weigh(-self.weight)
            self._listener.on_ended(self)
            self._listener.connections.remove(self)

    def close(self) -> None:
        """Close it."""
        self._watched.unwatch(self.fd)
        self._socket.close()
        self.open = False
        self._forget_unsent()

    def deliver(self, seconds: float) -> None:
        """Wait at most so long until what was sent is read."""
        with contextlib.suppress(OSError):
            self._socket.settimeout(seconds)
            for data in self._unsent:
                self._socket.sendall(data)

    def _flush(self) -> None:
        """Send what was not taken at once."""
        while self._unsent:
            data = self._unsent[0]
            try:
                taken = self._socket.send(data)
            except BlockingIOError:
                return
            except OSError:  # the other end is closed: the loop is about to hear of it
                self._forget_unsent()
                break
            self.unsent_bytes -= taken
            if taken < len(data):
                self._unsent[0] = data[taken:]
                return
            self._unsent.popleft()
        self._watch()

    def note_waiting(self, more: int, more_bytes: int) -> None:
        """So many more of its requests wait: of too many, the kernel keeps the rest."""
        self.waiting += more
        self.waiting_bytes += more_bytes
        reading = self.waiting < MOST_WAITING if self._reading else self.waiting <= MOST_WAITING // 2
        if self.open and reading != self._reading:
            self._reading = reading
            self._watch()
            if reading and self._incoming.more:
                self._watched.call_again(self.fd)

    def _watch(self) -> None:
        self._watched.watch_for(self.fd, reading=self._reading, writing=bool(self._unsent))

    def reweigh(self) -> None:
        """Tell the owner when more or less is kept than before."""
        weight = len(self._incoming) + self.unsent_bytes + self.waiting_bytes
        weight = weight if weight > LIGHT_BYTES else 0
        more, self.weight = weight - self.weight, weight
        if more and self.open:
            self._listener.connections.weigh(more)

    def _send(self, data: bytes) -> None:
        if self._cut or not self.open:
            return
        taken = 0
        if not self._unsent:
            try:
                taken = self._socket.send(data)
            except BlockingIOError:
                pass
            except OSError:
                return  # the other end is closed: the loop is about to hear of it
            if taken == len(data):
                return
        self._unsent.append(memoryview(data)[taken:])
        self.unsent_bytes += len(data) - taken
        self._watch()
        self.reweigh()

    def _ready(self) -> None:
        """Something came, the client reads again, or the other end is closed."""
        if self._cut:
            self.end()
            return
        if self._unsent:
            self._flush()
        if not self._reading or not self._incoming.more:
            try:
                data = self._socket.recv(READ_BYTES, 0 if self._reading else socket.MSG_PEEK)
            except BlockingIOError:
                data = None
            except OSError:
                data = b""
            if data == b"":
                self.end()
                return
            if data and self._reading:
                self._incoming.add(data)
        if self._reading:
            self._take_messages()
        self.reweigh()

    def _take_messages(self) -> None:
        try:
            for body, several in self._incoming.messages(FRAMES_AT_ONCE, self._send):
                self._listener.hear(self, body, several)
            if self._incoming.more and self._reading:
                self._watched.call_again(self.fd)
        except ProtocolMismatch:
            self.end()  # not one of our clients
        except BadRequest as error:
            self.cut(f"{error.message}: {TOO_MUCH}")

    def _forget_unsent(self) -> None:
        self._unsent.clear()
        self.unsent_bytes = 0
