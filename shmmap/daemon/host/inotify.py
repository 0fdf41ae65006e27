# SPDX-License-Identifier: Apache-2.0
"""inotify(7), as little of it as the daemon needs: there is nothing for it in the standard library."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
from typing import Final, NamedTuple

__all__ = ["CLOSED", "NAME_GONE", "OVERFLOW", "Event", "Inotify"]

CLOSED: Final = 0x08 | 0x10
"""A descriptor that could write, or could not, is closed for the last time: IN_CLOSE."""
NAME_GONE: Final = 0x40 | 0x200
"""A name in the directory was removed or is another now: IN_MOVED_FROM, IN_DELETE."""
OVERFLOW: Final = 0x4000
"""Events were lost: IN_Q_OVERFLOW."""
_IGNORED: Final = 0x8000
_ONCE: Final = 0x80000000
_EVENT: Final = struct.Struct("@iIII")
_READ_BYTES: Final = 16 << 10

_libc: Final = ctypes.CDLL(None, use_errno=True)


class Event(NamedTuple):
    """What happened to which watch; ``name`` is the directory entry, empty for a file's own watch."""

    watch: int
    mask: int
    name: str


class Inotify:
    """One queue of events.

    Raises
    ------
    OSError
        The kernel has none left for this user (``fs.inotify.max_user_instances``).
    """

    def __init__(self) -> None:
        self.fd = int(_libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))
        if self.fd < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))

    def close(self) -> None:
        """End every watch."""
        os.close(self.fd)

    def add(self, path: str, mask: int, *, once: bool = False) -> int:
        """Watch a file or directory, until its first event or until `remove`; OSError if that cannot be."""
        wanted = ctypes.c_uint32(mask | (_ONCE if once else 0))
        watch = int(_libc.inotify_add_watch(self.fd, os.fsencode(path), wanted))
        if watch < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), path)
        return watch

    def remove(self, watch: int) -> None:
        """End a watch; nothing if it has ended."""
        _libc.inotify_rm_watch(self.fd, watch)

    def read(self) -> list[Event]:
        """Events that are there, a bounded number of them; ends of watches are not among them."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self.fd, _READ_BYTES)
        found, at = [], 0
        while at < len(data):
            watch, mask, _cookie, length = _EVENT.unpack_from(data, at)
            at += _EVENT.size
            name = data[at : at + length].rstrip(b"\0")
            at += length
            if not mask & _IGNORED:
                found.append(Event(watch, mask, os.fsdecode(name)))
        return found
