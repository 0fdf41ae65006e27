# SPDX-License-Identifier: Apache-2.0
"""How well this machine tells who uses a segment: tried out, not guessed from versions.

Three ways, the first that works is taken: leases (nobody is overlooked), the locks that the client
library takes (who opens segments in another way is overlooked), and what sessions say they hold
(who does not say is overlooked, too).  Whoever is overlooked keeps the bytes it maps, always; the
daemon then only believes to have more memory left than it has.
"""

from __future__ import annotations

import enum
import mmap
import os
from typing import Final, NamedTuple

from shmmap.daemon.host.inotify import CLOSED, Inotify
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.pins import holders, is_pinned, lock_slot

__all__ = ["PinSupport", "Rung", "probe_pins"]

_SLOT: Final = 12345


class Rung(enum.Enum):
    """Where the word on who uses a segment comes from, best first; the value is for people."""

    LEASES = "leases"
    LOCKS = "locks of clients"
    SESSIONS = "what sessions say"


class PinSupport(NamedTuple):
    """What works in a directory of segments.

    Attributes
    ----------
    leases
        A lease is granted exactly while nobody else has a file open or mapped.
    locks
        A lock on an open file lasts as long as its mapping, and shows.
    close_events
        inotify tells when somebody let go of a file.
    process_ends
        Processes can be watched for their end (pidfd).
    """

    leases: bool
    locks: bool
    close_events: bool
    process_ends: bool

    @property
    def rung(self) -> Rung:
        """The best way that works."""
        return Rung.LEASES if self.leases else Rung.LOCKS if self.locks else Rung.SESSIONS


def probe_pins(directory: ShmDirectory) -> PinSupport:
    """Try out everything, with an unnamed file in the directory; takes well under a millisecond.

    ``SHMMAP_TEST_PINS`` (``locks``, ``sessions``) makes it find less than there is.
    """
    less = os.environ.get("SHMMAP_TEST_PINS", "")
    leases = locks = events = False
    fd = directory.create()
    try:
        os.ftruncate(fd, mmap.PAGESIZE)
        path = f"/proc/self/fd/{fd}"
        if less not in ("locks", "sessions"):
            leases = _leases_tell(fd, path)
        if less != "sessions":
            locks = _locks_tell(fd, path)
        events = _closing_tells(path)
    except OSError:  # whatever was not reached does not work
        pass
    finally:
        os.close(fd)
    return PinSupport(leases, locks, events, _processes_can_be_watched())


def _leases_tell(fd: int, path: str) -> bool:
    try:
        if is_pinned(fd):
            return False
        with _mapped(path):
            if not is_pinned(fd):
                return False
        return not is_pinned(fd)
    except OSError:
        return False


def _locks_tell(fd: int, path: str) -> bool:
    try:
        with _mapped(path, _SLOT):
            if holders(fd) != [_SLOT]:
                return False
        return holders(fd) == []
    except OSError:
        return False


def _mapped(path: str, slot: int | None = None) -> mmap.mmap:
    """Map a file anew, as a reader does (Python's mapping keeps a descriptor: the same open file)."""
    other = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        if slot is not None:
            lock_slot(other, slot)
        return mmap.mmap(other, mmap.PAGESIZE, prot=mmap.PROT_READ)
    finally:
        os.close(other)


def _closing_tells(path: str) -> bool:
    try:
        events = Inotify()
    except OSError:
        return False
    try:
        events.add(path, CLOSED)
        os.close(os.open(path, os.O_RDONLY | os.O_CLOEXEC))
        return any(event.mask & CLOSED for event in events.read())
    except OSError:
        return False
    finally:
        events.close()


def _processes_can_be_watched() -> bool:
    try:
        os.close(os.pidfd_open(os.getpid()))
    except OSError:
        return False
    return True
