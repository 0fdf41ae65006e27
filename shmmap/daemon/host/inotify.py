# SPDX-License-Identifier: Apache-2.0
"""inotify(7), as little of it as the daemon needs: there is nothing for it in the standard library."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
from typing import Final, NamedTuple

__all__ = [
    "ALSO",
    "CHANGED",
    "CLOSED",
    "CREATED",
    "DIRECTORY",
    "ENDED",
    "NAMES_CHANGED",
    "NAME_GONE",
    "OVERFLOW",
    "SELF_GONE",
    "SELF_MOVED",
    "Event",
    "Inotify",
]

CLOSED: Final = 0x08 | 0x10
"""A descriptor that could write, or could not, is closed for the last time: IN_CLOSE."""
NAME_GONE: Final = 0x40 | 0x200
"""A name in the directory was removed or is another now: IN_MOVED_FROM, IN_DELETE."""
CREATED: Final = 0x100
"""A name in the directory is new: IN_CREATE."""
SELF_MOVED: Final = 0x800
"""What is watched has another name now: IN_MOVE_SELF."""
SELF_GONE: Final = 0x400 | SELF_MOVED
"""What is watched was removed, or has another name now: IN_DELETE_SELF."""
NAMES_CHANGED: Final = NAME_GONE | 0x80 | CREATED
"""A name in the directory came, went, or means something else now."""
ALSO: Final = 0x20000000
"""To be watched for beside what is watched for already: IN_MASK_ADD."""
CHANGED: Final = 0x08 | NAME_GONE | 0x80 | CREATED | 0x400 | SELF_MOVED | 0x1000000 | 0x4000000
"""A file in the directory was written, came or went, or the directory itself did; directories only, and
nothing of files that have no name any more."""
DIRECTORY: Final = 0x40000000
"""The event is about a directory: IN_ISDIR."""
OVERFLOW: Final = 0x4000
"""Events were lost: IN_Q_OVERFLOW."""
ENDED: Final = 0x8000
"""The watch has ended; what was watched is gone, or the watch was removed: IN_IGNORED."""
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
        self.fd = _checked(_libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))

    def close(self) -> None:
        """End every watch."""
        os.close(self.fd)

    def add(self, path: str, mask: int, *, once: bool = False) -> int:
        """Watch a file or directory, until its first event or until `remove`; OSError if that cannot be."""
        wanted = ctypes.c_uint32(mask | (_ONCE if once else 0))
        return _checked(_libc.inotify_add_watch(self.fd, os.fsencode(path), wanted))

    def remove(self, watch: int) -> None:
        """End a watch; nothing if it has ended."""
        _libc.inotify_rm_watch(self.fd, watch)

    def read(self) -> list[Event]:
        """Return events that are there, a bounded number of them."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self.fd, _READ_BYTES)
        found, at = [], 0
        while at < len(data):
            watch, mask, _cookie, length = _EVENT.unpack_from(data, at)
            at += _EVENT.size + length
            found.append(Event(watch, mask, os.fsdecode(data[at - length : at].rstrip(b"\0"))))
        return found


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
