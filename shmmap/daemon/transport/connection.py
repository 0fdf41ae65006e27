# SPDX-License-Identifier: Apache-2.0
"""Connections of clients: how they are accepted and read, and which are closed when there are too many.

No connection is closed while there are enough descriptors and memory.  Otherwise one process is chosen:

- for lack of descriptors: the process with most connections, which keeps as many as an equal share;
- for lack of memory: the process for which most is stored (incomplete messages, waiting requests, unread
  replies); it loses all its connections.

A process that lost a connection wrongly reconnects; segments that it maps are not affected.
"""

from __future__ import annotations

import contextlib
import ctypes
import resource
import socket
import struct
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from shmmap.daemon.transport.zmtp import GREETING, Incoming, framed, framed_in_parts
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import BadRequest, ProtocolMismatch, ShmmapError
from shmmap.failpoints import step
from shmmap.logfmt import log
from shmmap.protocol.codec import encode
from shmmap.protocol.messages import ErrorReply
from shmmap.statistics.writer import StatisticsWriter

Socket: TypeAlias = socket.socket
MAX_UNREAD_BYTES: Final = 16 << 20
"""Limit of unread replies; a client that leaves more does not read them."""
READ_BYTES: Final = 1 << 16
"""Bytes read from a connection per turn of the loop."""
FRAMES_PER_TURN: Final = 4
MAX_WAITING: Final = 48
"""Requests read from a connection that may wait; approximate, since several may arrive at once."""
LIGHT_BYTES: Final = 1 << 12
"""Memory that every client may use and that is not counted."""
ACCEPTED_PER_TURN: Final = 16
ENDED_PER_TURN: Final = 64
MIN_RESERVE: Final = 48
"""Descriptors reserved for the daemon's own work: loaders, segments it checks, the map."""
MIN_SHARE: Final = 8
"""A process with no more connections than this is never chosen."""
MEMORY_ALLOWANCE_BYTES: Final = 32 << 20
"""Memory limit for all clients together."""
_TOO_MUCH: Final = "it made the daemon take too much memory"
_CREDENTIALS: Final = struct.Struct("iII")  # struct ucred: pid, uid, gid


@dataclass(frozen=True, slots=True)
class Peer:
    """Credentials of a connected process; pid 0 if the process is not visible from this one's namespace."""

    uid: int = -1
    gid: int = -1
    pid: int = 0


def peer_of(connected: Socket) -> Peer:
    """Return the process at the other end of a Unix socket, as the kernel reports it."""
    credentials = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, gid = _CREDENTIALS.unpack(credentials)
    return Peer(uid, gid, pid)


class Connection:
    """A connected Unix socket on which a client speaks ZMTP.

    Attributes
    ----------
    open : bool
        Whether the connection is open.
    slot : int
        Slot of the session on it; 0 before a hello.
    unsent_bytes : int
        Bytes that the kernel does not accept because the client does not read.
    waiting, waiting_bytes : int
        Number and bytes of requests that wait to be served.
    weight : int
        All memory used for it, bytes.
    """

    def __init__(self, connected: Socket, listener: Listener) -> None:
        self.peer = peer_of(connected)
        self.open = True
        self.slot = 0
        self.unsent_bytes = 0
        self.waiting = self.waiting_bytes = 0
        self.weight = 0
        self._reading = True
        self._socket = connected
        self._listener = listener
        self._watched = listener.watched
        self._incoming = Incoming(listener.kind, listener.peer_kind, listener.max_bytes)
        self._unsent: deque[memoryview] = deque()
        self._behind = False  # whether the listener may have more to send, see its `on_read`
        self._cut = False
        self.fd = connected.fileno()
        self._watched.watch(self.fd, self._ready)
        self._send(GREETING)

    def reply(self, body: bytes) -> None:
        """Send a reply; a client that leaves too much unread loses the connection with the replies."""
        step("daemon.reply")
        for part in framed_in_parts(body):
            self._send(part)
        step("daemon.replied")
        self._listener.statistics.add("replies")
        self._listener.statistics.add("bytes_sent", len(body))
        if self.unsent_bytes > MAX_UNREAD_BYTES:
            self.cut(f"it left {self.unsent_bytes} bytes of replies unread")

    def refuse(self, request: int, error: ShmmapError) -> None:
        """Reply with the reason for refusing a request."""
        self._listener.statistics.add("errors_returned")
        self.reply(encode(ErrorReply(request, error.code, error.message, error.hint)))

    def offer(self, bodies: Iterable[bytes]) -> bool:
        """Send messages unless earlier bytes are unread; return whether the kernel has taken them whole.

        If it has not, the listener's ``on_read`` is called when the client has read what was sent.
        """
        if not self._unsent:
            self._send(b"".join(map(framed, bodies)))
        return not self._unsent

    def cut(self, reason: str = "") -> None:
        """Mark the connection to be closed by the loop, which may be using it; log the reason if given."""
        if not self._cut:
            self._cut = True
            self._incoming.forget()
            self._forget_unsent()
            self.reweigh()
            if reason:
                _log_ended(self.peer.pid, 1, reason)
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)

    def end(self) -> None:
        """Close the connection and notify its owner; call only between two steps of the loop."""
        if self.open:
            self.close()
            self._listener.connections.weigh(-self.weight)
            self._listener.on_disconnect(self)
            self._listener.connections.remove(self)

    def close(self) -> None:
        """Close the socket."""
        self._watched.unwatch(self.fd)
        self._socket.close()
        self.open = False
        self._forget_unsent()

    def deliver(self, seconds: float) -> None:
        """Wait up to this many seconds until the client has read everything."""
        with contextlib.suppress(OSError):
            self._socket.settimeout(seconds)
            for data in self._unsent:
                self._socket.sendall(data)

    def count_waiting(self, more: int, more_bytes: int) -> None:
        """Count waiting requests; beyond a limit no more are read, and the kernel buffers the rest."""
        self.waiting += more
        self.waiting_bytes += more_bytes
        reading = self.waiting < MAX_WAITING if self._reading else self.waiting <= MAX_WAITING // 2
        if self.open and reading != self._reading:
            self._reading = reading
            self._watch()
            if reading and self._incoming.more:
                self._watched.call_again(self.fd)

    def reweigh(self) -> None:
        """Update the memory used for it, here and in the sum over all connections."""
        weight = len(self._incoming) + self.unsent_bytes + self.waiting_bytes
        weight = weight if weight > LIGHT_BYTES else 0
        more, self.weight = weight - self.weight, weight
        if more and self.open:
            self._listener.connections.weigh(more)

    def _watch(self) -> None:
        self._watched.watch_for(self.fd, reading=self._reading, writing=bool(self._unsent))

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
                return  # the peer has closed: the loop will notice
            if taken == len(data):
                return
        self._unsent.append(memoryview(data)[taken:])
        self.unsent_bytes += len(data) - taken
        self._watch()
        self.reweigh()

    def _flush(self) -> bool:
        """Send the bytes that the kernel did not accept before; return whether it has now taken them all."""
        while self._unsent:
            data = self._unsent[0]
            try:
                taken = self._socket.send(data)
            except BlockingIOError:
                return False
            except OSError:  # the peer takes nothing any more
                self.cut()
                return False
            self.unsent_bytes -= taken
            if taken < len(data):
                self._unsent[0] = data[taken:]
                return False
            self._unsent.popleft()
        self._watch()
        return True

    def _ready(self) -> None:
        """Read, or send pending bytes; the descriptor is ready, or the peer has closed."""
        if self._cut:
            self.end()
            return
        if self._unsent:
            self._behind = self._flush()
        if self._behind:
            self._behind = self._listener.on_read(self)
            if self._behind:
                self._watched.call_again(self.fd)
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
            for body, is_multipart in self._incoming.messages(FRAMES_PER_TURN, self._send):
                self._listener.on_message(self, body, is_multipart)
            if self._incoming.more and self._reading:
                self._watched.call_again(self.fd)
        except ProtocolMismatch:
            self.end()  # not a client of shmmap
        except BadRequest as error:
            self.cut(f"{error.message}: {_TOO_MUCH}")

    def _forget_unsent(self) -> None:
        self._unsent.clear()
        self.unsent_bytes = 0


class Connections:
    """All connections of the daemon, by process.

    Attributes
    ----------
    nbytes : int
        Memory used for all connections, bytes.
    short : bool
        Whether the daemon is out of descriptors.
    """

    def __init__(self) -> None:
        self.nbytes = 0
        self._of: defaultdict[int, dict[Connection, None]] = defaultdict(dict)
        self.short = False
        self._waiting: list[Callable[[], None]] = []

    def __iter__(self) -> Iterator[Connection]:
        return (one for mine in self._of.values() for one in mine)

    def add(self, connection: Connection) -> None:
        """Add an accepted connection."""
        self._of[connection.peer.pid][connection] = None
        # the kernel assigns the lowest free number: all below are in use
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        self.short = connection.fd >= limit - max(MIN_RESERVE, limit // 16)

    def remove(self, connection: Connection) -> None:
        """Remove a closed connection."""
        mine = self._of[connection.peer.pid]
        del mine[connection]
        if not mine:
            del self._of[connection.peer.pid]
        self.try_again()

    def try_again(self) -> None:
        """Let listeners that wait for room check again."""
        self.short = False
        waiting, self._waiting = self._waiting, []
        for go_on in waiting:
            go_on()

    def has_room(self, go_on: Callable[[], None]) -> bool:
        """Whether another connection may be accepted; if not, ``go_on`` is called when one has ended.

        Connections are taken from the process with most of them, those without a session first.
        """
        if not self.short:
            return True
        pid, mine = max(self._of.items(), key=lambda item: len(item[1]), default=(0, {}))
        share = max(MIN_SHARE, sum(map(len, self._of.values())) // (2 * len(self._of) or 1))
        if len(mine) <= share:
            self._waiting.append(go_on)  # many processes with few connections each: new ones wait
            return False
        count = min(len(mine) - share, ENDED_PER_TURN)
        _log_ended(pid, count, f"it had {len(mine)} connections")
        for one in sorted(mine, key=lambda one: one.slot != 0)[:count]:
            one.end()
        return True

    def weigh(self, more_bytes: int) -> None:
        """Add to the memory used; at the limit, the process that uses most loses its connections."""
        self.nbytes += more_bytes
        if more_bytes > 0 and self.nbytes > MEMORY_ALLOWANCE_BYTES:
            pid, mine = max(self._of.items(), key=lambda item: sum(one.weight for one in item[1]))
            _log_ended(pid, len(mine), _TOO_MUCH)
            for one in mine:
                one.cut()
            ctypes.CDLL(None).malloc_trim(0)

    def deliver(self, seconds: float) -> None:
        """Wait up to this many seconds for clients to read what was sent, and close all connections."""
        end_s = time.monotonic() + seconds
        for one in self:
            one.deliver(max(0.0, end_s - time.monotonic()))
            one.close()


@dataclass(eq=False, slots=True)
class Listener:
    """A listening Unix socket, and the common settings of its connections.

    Parameters
    ----------
    kind, peer_kind
        ZeroMQ socket types of the daemon and of its clients.
    max_bytes
        Length limit of a message from a client.
    on_message
        Called with a message's connection, its first frame, and whether it had more frames.
    on_disconnect
        Called with a connection that was closed.
    on_read
        Called with a connection whose client had left something unread, and has read it all; returns whether
        there is more for it, for which it is called again in a later turn.
    """

    socket: Socket
    watched: WatchedDescriptors
    connections: Connections
    statistics: StatisticsWriter
    kind: bytes
    peer_kind: bytes
    max_bytes: int
    on_message: Callable[[Connection, bytes, bool], None]
    on_disconnect: Callable[[Connection], None]
    on_read: Callable[[Connection], bool] = field(default=lambda _connection: False)

    def move_to(self, other: Socket) -> None:
        """Listen at another socket; connections stay, and pending ones are accepted."""
        for _ in range(0, socket.SOMAXCONN, ACCEPTED_PER_TURN):
            self._accept()
        self.watched.unwatch(self.socket.fileno())
        self.socket.close()
        self.socket = other
        self.begin()

    def begin(self) -> None:
        """Accept connections from now on."""
        self.watched.watch(self.socket.fileno(), self._accept)

    def _accept(self) -> None:
        for _ in range(ACCEPTED_PER_TURN):
            if not self.connections.has_room(self.begin):
                self.watched.unwatch(self.socket.fileno())
                return
            try:
                connected, _address = self.socket.accept()
            except BlockingIOError:
                return
            except OSError:  # the system has no descriptor left
                self.connections.short = True
                return
            connected.setblocking(False)
            self.connections.add(Connection(connected, self))


def _log_ended(pid: int, count: int, reason: str) -> None:
    log.warning("connections ended", pid=pid, count=count, reason=reason)
