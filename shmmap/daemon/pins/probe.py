# SPDX-License-Identifier: Apache-2.0
"""Checks by experiment which queries show on this machine which processes use a segment.

The first of three sources that works is used: leases (they miss no process), the locks that the client
library takes (they miss processes that open segments in another way), and the clients' own reports (they also
miss clients that do not report).  A process that is missed always keeps the bytes it maps; the daemon merely
believes that it has more memory left than it has.
"""

from __future__ import annotations

import contextlib
import enum
import mmap
import os
from collections.abc import Callable
from typing import Final, NamedTuple

from shmmap.daemon.host.inotify import CLOSED, Inotify
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import holders, in_use, lock_slot

_SLOT: Final = 12345


class PinSource(enum.Enum):
    """Source that shows which processes use a segment, best first; the value is a text for people."""

    LEASES = "leases"
    LOCKS = "locks of clients"
    SESSIONS = "what sessions say"


class PinSupport(NamedTuple):
    """Mechanisms that work in a directory of segments.

    Attributes
    ----------
    leases
        Whether a lease is granted exactly while no other process has a file open or mapped.
    locks
        Whether a lock on an open file lasts as long as its mapping, and can be queried.
    close_events
        Whether inotify reports when a process closes a file.
    """

    leases: bool
    locks: bool
    close_events: bool

    @property
    def source(self) -> PinSource:
        """The best source that works."""
        return PinSource.LEASES if self.leases else PinSource.LOCKS if self.locks else PinSource.SESSIONS


def probe_pins(directory: ShmDirectory) -> PinSupport:
    """Try all mechanisms with an unnamed file in the directory; takes well under a millisecond.

    ``SHMMAP_TEST_PINS`` (``locks``, ``sessions``) hides better sources.
    """
    less = os.environ.get("SHMMAP_TEST_PINS", "")
    fd = directory.create()
    try:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, mmap.PAGESIZE)
        path = f"/proc/self/fd/{fd}"
        leases = less not in ("locks", "sessions") and _works(_leases_work, fd, path)
        locks = less != "sessions" and _works(_locks_work, fd, path)
        events = _works(_close_events_work, path)
    finally:
        os.close(fd)
    return PinSupport(leases, locks, events)


def _works(attempt: Callable[..., bool], *arguments: object) -> bool:
    try:
        return attempt(*arguments)
    except (OSError, ValueError):  # not supported here
        return False


def _leases_work(fd: int, path: str) -> bool:
    before = in_use(fd)
    with _mapped(path):
        during = in_use(fd)
    return (before, during, in_use(fd)) == (False, True, False)


def _locks_work(fd: int, path: str) -> bool:
    with _mapped(path, _SLOT):
        during = holders(fd)
    return (during, holders(fd)) == ([_SLOT], [])


def _mapped(path: str, slot: int | None = None) -> mmap.mmap:
    """Map a file as a reader does (Python's mapping duplicates the descriptor: the same open file)."""
    other = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if slot is not None:
            lock_slot(other, slot)
        return mmap.mmap(other, mmap.PAGESIZE, prot=mmap.PROT_READ)
    finally:
        os.close(other)


def _close_events_work(path: str) -> bool:
    with contextlib.closing(Inotify()) as events:
        events.add(path, CLOSED)
        os.close(os.open(path, os.O_RDONLY | os.O_CLOEXEC))
        return any(event.mask & CLOSED for event in events.read())
