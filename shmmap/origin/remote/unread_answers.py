# SPDX-License-Identifier: Apache-2.0
"""Answers that obstore would read into memory without end: the text of an error, a page of a listing.

obstore has no limit for what is no object.  So while a request waits, the kernel is asked how much this
process's connections have received (``TCP_INFO``).  What of it was not taken is in memory; a connection with
too much of it is shut down, and its request fails.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import termios
import threading
from contextlib import suppress
from typing import Final

MAX_UNREAD_BYTES: Final = 64 << 20
"""More than a library keeps of 32 objects at once that are read as they come."""
_RECEIVED: Final = struct.Struct("128xQ")
"""``tcpi_bytes_received`` in ``struct tcp_info``, since Linux 4.1."""


class UnreadAnswers:
    """What the connections of this process have received that was not taken; for any thread."""

    def __init__(self) -> None:
        self.ended = 0
        self._taken = 0
        self._taking = threading.Lock()
        self._looking = threading.Lock()
        self._seen: dict[str, tuple[int, int]] = {}  # of each socket: bytes received, of these not taken
        self._taken_seen = 0

    def take(self, nbytes: int) -> None:
        """Note that this much was taken."""
        with self._taking:
            self._taken += nbytes

    def look(self) -> None:
        """Shut down connections that have brought more than `MAX_UNREAD_BYTES` that was not taken."""
        if not self._looking.acquire(blocking=False):
            return
        try:
            taken = self._taken
            seen: dict[str, tuple[int, int]] = {}
            for fd in os.listdir("/proc/self/fd"):
                with suppress(OSError):  # it has been closed meanwhile, or is no socket
                    name = os.readlink(f"/proc/self/fd/{fd}")
                    if name.startswith("socket:"):
                        with socket.socket(fileno=os.dup(int(fd))) as one:
                            if one.family in (socket.AF_INET, socket.AF_INET6):
                                seen[name] = self._look_at(one, name, taken - self._taken_seen)
            self._seen, self._taken_seen = seen, taken
        finally:
            self._looking.release()

    def _look_at(self, one: socket.socket, name: str, taken: int) -> tuple[int, int]:
        info = one.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _RECEIVED.size)
        waiting = struct.unpack("i", fcntl.ioctl(one, termios.FIONREAD, bytes(4)))[0]
        received = _RECEIVED.unpack(info)[0] - waiting if len(info) == _RECEIVED.size else 0
        before, unread = self._seen.get(name, (received, 0))
        unread = max(0, unread + received - before - taken)
        if unread > MAX_UNREAD_BYTES:
            self.ended += 1
            one.shutdown(socket.SHUT_RDWR)
        return received, unread


UNREAD: Final = UnreadAnswers()
"""Those of this process."""
