# SPDX-License-Identifier: Apache-2.0
"""The daemon's side of ZMTP 3.0 with the NULL mechanism (rfc.zeromq.org/spec/23), as bytes of a connection.

Clients use libzmq or any other ZeroMQ library.  The daemon does not: libzmq accepts connections without bound
in a thread of its own, aborts the process when descriptors run out, stores everything that is sent, and does
not report the end of a connection (its process it does, as ``Peer-Address``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from shmmap.errors import BadRequest, ProtocolMismatch

GREETING: Final = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""Signature, version 3.0, mechanism, and 32 bytes that NULL ignores."""

MAX_COPIED_BYTES: Final = 1 << 16
"""Longest body that is copied to follow its head in one call of the kernel."""

_MORE: Final = 1
_LONG: Final = 2
_COMMAND: Final = 4


def framed(body: bytes, flags: int = 0) -> bytes:
    """Return one frame: a complete message, unless ``flags`` mark it otherwise."""
    return _head(body, flags) + body


def framed_in_parts(body: bytes) -> tuple[bytes, ...]:
    """Return a complete message, in two parts if its body is long: to copy it would take long."""
    return (framed(body),) if len(body) <= MAX_COPIED_BYTES else (_head(body, 0), body)


def _head(body: bytes, flags: int) -> bytes:
    if len(body) < 256:
        return bytes((flags, len(body)))
    return bytes((flags | _LONG,)) + len(body).to_bytes(8, "big")


class Incoming:
    """Received bytes of one connection that do not form a complete message yet.

    Parameters
    ----------
    kind
        The daemon's socket type, ``ROUTER`` or ``XPUB``.
    peer
        The only socket type accepted at the other end, ``DEALER`` or ``SUB``.
    max_bytes
        Length limit of a message, with all its frames and their headers.

    Attributes
    ----------
    more : bool
        Whether some received bytes have not been examined yet.
    """

    def __init__(self, kind: bytes, peer: bytes, max_bytes: int) -> None:
        self._kind = kind
        self._peer = peer
        self._max_bytes = max_bytes
        self._buffer = bytearray()
        self._next = 0  # start of the next frame; before it are complete frames of a message
        self._first: tuple[int, int] | None = None  # first frame of that message, from and to
        self.more = False
        self._greeted = False
        self._ready = False

    def __len__(self) -> int:
        return len(self._buffer)

    def forget(self) -> None:
        """Drop all received bytes."""
        self._buffer.clear()
        self.more = False

    def add(self, data: bytes) -> None:
        """Append received bytes."""
        self._buffer += data

    def messages(self, max_frames: int, send: Callable[[bytes], None]) -> list[tuple[bytes, bool]]:
        """Return complete messages, each as its first frame and whether there were more frames.

        At most ``max_frames`` frames are examined; ``more`` is True if others may follow.  ``send`` sends
        replies that the protocol itself requires.

        Raises
        ------
        ProtocolMismatch
            The peer does not speak ZMTP 3 with NULL, or has the wrong type of socket.
        BadRequest
            A message is too long.
        """
        self.more = False
        if not self._greeted and not self._greet(send):
            return []
        messages: list[tuple[bytes, bool]] = []
        start = 0  # start of the current message
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
        """Return flags, begin and end of the next frame; None while it is incomplete."""
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
