# SPDX-License-Identifier: Apache-2.0
"""The part of inotify(7) that the daemon needs, which the standard library lacks."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
from typing import Final, NamedTuple

CLOSED: Final = 0x08 | 0x10
"""A file was closed, whether it was open for writing or not: IN_CLOSE."""
NAME_GONE: Final = 0x40 | 0x200
"""A name was removed from the directory or moved away: IN_MOVED_FROM, IN_DELETE."""
CREATED: Final = 0x100
"""A name was created in the directory: IN_CREATE."""
SELF_MOVED: Final = 0x800
"""The watched file or directory was renamed: IN_MOVE_SELF."""
SELF_GONE: Final = 0x400 | SELF_MOVED
"""The watched file or directory was removed or renamed: IN_DELETE_SELF, IN_MOVE_SELF."""
NAMES_CHANGED: Final = NAME_GONE | 0x80 | CREATED
"""A name in the directory was added, removed, or replaced."""
ALSO: Final = 0x20000000
"""Add to the events of an existing watch: IN_MASK_ADD."""
CHANGED: Final = 0x08 | NAME_GONE | 0x80 | CREATED | 0x400 | SELF_MOVED | 0x1000000 | 0x4000000
"""A file in the directory, or the directory itself, was written, added, removed or moved.  Directories only;
no events of unlinked files."""
DIRECTORY: Final = 0x40000000
"""The event concerns a directory: IN_ISDIR."""
OVERFLOW: Final = 0x4000
"""Events were lost: IN_Q_OVERFLOW."""
ENDED: Final = 0x8000
"""The watch has ended because its target is gone or the watch was removed: IN_IGNORED."""
_ONCE: Final = 0x80000000
_EVENT: Final = struct.Struct("@iIII")
_READ_BYTES: Final = 16 << 10

_libc: Final = ctypes.CDLL(None, use_errno=True)


class Event(NamedTuple):
    """An event and its watch; ``name`` is the directory entry, empty for a file's own watch."""

    watch: int
    mask: int
    name: str


class Inotify:
    """An inotify instance: a queue of events.

    Raises
    ------
    OSError
        The kernel's limit for this user is reached (``fs.inotify.max_user_instances``).
    """

    def __init__(self) -> None:
        self.fd = _checked(_libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC))

    def close(self) -> None:
        """End every watch."""
        os.close(self.fd)

    def add(self, path: str, mask: int, *, once: bool = False) -> int:
        """Watch a path, with ``once`` only until its first event; raise OSError if that fails."""
        wanted = ctypes.c_uint32(mask | (_ONCE if once else 0))
        return _checked(_libc.inotify_add_watch(self.fd, os.fsencode(path), wanted))

    def remove(self, watch: int) -> None:
        """End a watch, if it has not ended."""
        _libc.inotify_rm_watch(self.fd, watch)

    def read(self) -> list[Event]:
        """Return pending events, a bounded number of them."""
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
