# SPDX-License-Identifier: Apache-2.0
"""Find the users of a segment, from the kernel instead of a timer.

A write lease (``F_SETLEASE``) on a file is granted only if no other descriptor or mapping of it exists.  That
holds through renames, client crashes, SIGSTOP and daemon restarts, and costs 6 us.  A process that
takes a lease must ignore SIGIO: an opener makes the kernel send it.

*Which* session uses a segment is known from open-file-description locks: a reader locks the byte at its
session's slot right after opening, and the lock lives as long as its mapping.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
from typing import Final

from shmmap.failpoints import step

MAX_SLOT: Final = (1 << 62) - 1
MAX_RANGES: Final = 32
TIMEOUT_S: Final = 0.02
"""Processor time limit for listing one segment's holders; 100 holders take 0.5 ms."""
LOADER_SLOT: Final = 0
"""Slot that the daemon's own loaders lock while they read a segment; no session has it."""

_FLOCK: Final = struct.Struct("@hhqqi4x")  # struct flock of 64-bit Linux: type, whence, start, len, pid
_OFD_GETLK: Final = 36
_OFD_SETLK: Final = 37


def prepare_process() -> None:
    """Ignore SIGIO; otherwise a process that opens a leased file would kill this process."""
    import signal  # daemons only: clients take no lease

    signal.signal(signal.SIGIO, signal.SIG_IGN)


def lock_slot(fd: int, slot: int) -> None:
    """Take the shared lock that marks a use by session ``slot``; the mapping keeps it."""
    fcntl.fcntl(fd, _OFD_SETLK, _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, slot, 1, 0))


def has_slot(fd: int, slot: int) -> bool:
    """Return whether session ``slot`` holds the file, or a range lock covers that slot."""
    asked = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, slot, 1, 0)
    return bool(_FLOCK.unpack(fcntl.fcntl(fd, _OFD_GETLK, asked))[0] != fcntl.F_UNLCK)


def in_use(fd: int) -> bool:
    """Return whether the file is open or mapped other than by this descriptor.

    The user may be any process; this is unrelated to pins by an operator.  The caller must own the file (or
    be root) and hold no other descriptor or mapping of it.
    """
    if not keep_if_unused(fd):
        return True
    step("daemon.probe")
    fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    return False


def keep_if_unused(fd: int) -> bool:
    """Return whether the file is unused; if it is, opens of the file block until ``fd`` is closed."""
    try:
        fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_WRLCK)
    except BlockingIOError:
        return False
    return True


def holders(fd: int, *, limit: int = 1024) -> list[int]:
    """Return the slots of the sessions that hold the file, ascending, at most ``limit`` of them.

    Users without a lock are not listed.  The kernel returns *some* conflicting lock of the queried range, so
    the range is split around each result.  A reader may hold any number of locks, and queries slow down with
    their number.  So the search ends after `TIMEOUT_S`, or after `MAX_RANGES` locks that belong to no
    session, and returns the slots found so far.
    """
    found: list[int] = []
    ranges = [(0, MAX_SLOT)]
    end_s = time.thread_time() + TIMEOUT_S  # processor time: a busy machine does not shorten the result
    asked_times = strange = 0
    while ranges and len(found) < limit and strange < MAX_RANGES:
        asked_times += 1
        if asked_times % 16 == 0 and time.thread_time() > end_s:
            break
        first, last = ranges.pop()
        asked = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, first, last - first + 1, 0)
        kind, _whence, at, length, _pid = _FLOCK.unpack(fcntl.fcntl(fd, _OFD_GETLK, asked))
        if kind == fcntl.F_UNLCK:
            continue
        end = at + length - 1 if length else MAX_SLOT
        if length == 1:
            found.append(at)
        else:
            strange += 1  # a lock of several bytes is no session's slot
        if at > first:
            ranges.append((first, at - 1))
        if end < last:
            ranges.append((end + 1, last))
    return sorted(found)
