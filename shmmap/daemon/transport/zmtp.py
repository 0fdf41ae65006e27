# SPDX-License-Identifier: Apache-2.0
"""The bytes of a connection: ZMTP 3.0 with the NULL mechanism (rfc.zeromq.org/spec/23), the daemon's side.

Clients use libzmq or any other ZeroMQ library.  The daemon does not: libzmq accepts connections in a thread
of its own without bound, ends the process when descriptors run out, keeps all that is sent, and shows
neither the process of a connection nor that it has ended.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap.errors import BadRequest, ProtocolMismatch

__all__ = ["GREETING", "Incoming", "framed"]

GREETING: Final = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""Signature, version 3.0, mechanism, and 32 bytes that mean nothing to NULL."""

_MORE: Final = 1
_LONG: Final = 2
_COMMAND: Final = 4


def framed(body: bytes, flags: int = 0) -> bytes:
    """Return one frame: a message, unless ``flags`` say otherwise."""
    if len(body) < 256:
        return bytes((flags, len(body))) + body
    return bytes((flags | _LONG,)) + len(body).to_bytes(8, "big") + body


class Incoming:
    """What has come on one connection and is not a whole message yet.

    Parameters
    ----------
    kind
        The daemon's socket type, ``ROUTER`` or ``XPUB``.
    peer
        The only socket type that may be at the other end, ``DEALER`` or ``SUB``.
    max_bytes
        The longest message, all its frames and their headers together.

    Attributes
    ----------
    more : bool
        Whether something that came was not looked at yet.
    """

    def __init__(self, kind: bytes, peer: bytes, max_bytes: int) -> None:
        self._kind = kind
        self._peer = peer
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._next = 0  # where the next frame begins; before it are whole frames of a message
        self._first: tuple[int, int] | None = None  # that message's first frame, from and to
        self.more = False
        self._greeted = False
        self._ready = False

    def __len__(self) -> int:
        return len(self._buffer)

    def forget(self) -> None:
        """Drop what has come."""
        self._buffer.clear()
        self.more = False

    def add(self, data: bytes) -> None:
        """Take received bytes."""
        self._buffer += data

    def messages(self, max_frames: int, send: Callable[[bytes], None]) -> list[tuple[bytes, bool]]:
        """Return messages that are whole now: of each its first frame, and whether there were more.

        At most ``max_frames`` are looked at; ``more`` then says that others may be there.  ``send``
        sends what the protocol itself requires.

        Raises
        ------
        ProtocolMismatch
            This is no ZMTP 3 with NULL, or the wrong type of socket.
        BadRequest
            A message is longer than may be.
        """
        self.more = False
        if not self._greeted and not self._greet(send):
            return []
        messages: list[tuple[bytes, bool]] = []
        start = 0  # of the message under way
        for _ in range(max_frames):
            frame = self._frame(start)
            if frame is None:
                break
            flags, begin, end = frame
            if flags & _COMMAND:
                if self._next != start:
                    raise ProtocolMismatch("a command within a message")
                self._command(bytes(self._buffer[begin:end]), send)
                start = end
            elif not self._ready:
                raise ProtocolMismatch("a message before the handshake")
            else:
                first = self._first or (begin, end)
                self._first = first
                if not flags & _MORE:
                    messages.append((bytes(self._buffer[first[0] : first[1]]), first[0] != begin))
                    self._first, start = None, end
            self._next = end
        else:
            self.more = True
        if start:
            del self._buffer[:start]
            self._next -= start
            if self._first is not None:
                self._first = (self._first[0] - start, self._first[1] - start)
        return messages

    def _greet(self, send: Callable[[bytes], None]) -> bool:
        if len(self._buffer) < len(GREETING):
            return False
        greeting = self._buffer[: len(GREETING)]
        if greeting[0] != 0xFF or greeting[10] < 3 or greeting[12:32] != GREETING[12:32]:
            raise ProtocolMismatch("no ZMTP 3 with the NULL mechanism")
        del self._buffer[: len(GREETING)]
        self._greeted = True
        ready = b"\x05READY" + _property(b"Socket-Type", self._kind) + _property(b"Identity", b"")
        send(framed(ready, _COMMAND))
        return True

    def _frame(self, start: int) -> tuple[int, int, int] | None:
        """Return flags, begin and end of the frame that comes next; None while it is not all there."""
        buffer, at = self._buffer, self._next
        if len(buffer) < at + 2:
            return None
        flags, size, begin = buffer[at], buffer[at + 1], at + 2
        if flags & _LONG:
            begin = at + 9
            if len(buffer) < begin:
                return None
            size = int.from_bytes(buffer[at + 1 : begin], "big")
        end = begin + size
        if end - start > self._max_bytes:
            raise BadRequest(f"a message of more than {self._max_bytes} bytes")
        return None if len(buffer) < end else (flags, begin, end)

    def _command(self, body: bytes, send: Callable[[bytes], None]) -> None:
        name, rest = body[1 : 1 + body[0]] if body else b"", body[1:]
        if name == b"READY":
            if _property(b"Socket-Type", self._peer) not in rest:
                raise ProtocolMismatch(f"the other end is no {self._peer.decode()}")
            self._ready = True
        elif name == b"PING":
            send(framed(b"\x04PONG" + body[7:23], _COMMAND))


def _property(name: bytes, value: bytes) -> bytes:
    return bytes((len(name),)) + name + len(value).to_bytes(4, "big") + value
