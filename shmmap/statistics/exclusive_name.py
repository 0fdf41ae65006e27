# SPDX-License-Identifier: Apache-2.0
"""Ensure one daemon per instance name, whatever its runtime directory, by a lock on the statistics segment.

The writer of the statistics holds an open-file-description lock on its segment as long as it runs.  It is a
write lock, which a process with read access cannot get: so a client can neither hold the name nor block a
daemon.  A second daemon checks only write locks, on files of its own user or root.
"""

from __future__ import annotations

import errno
import fcntl
import os
import stat
import struct
from typing import Final

from shmmap.errors import CannotStart, InstanceBusy, ShmmapError
from shmmap.segment.directory import ShmDirectory, is_full
from shmmap.segment.names import name_taken, new_segment_name, statistics_name
from shmmap.statistics.reader import read_statistics

_FLOCK: Final = struct.Struct("@hhqqi4x")  # struct flock of 64-bit Linux: type, whence, start, len, pid
_OFD_GETLK: Final = 36
_OFD_SETLK: Final = 37
_ATTEMPTS: Final = 16


def hold(fd: int) -> None:
    """Lock a segment without a name for this process, until its descriptor is closed."""
    fcntl.fcntl(fd, _OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 1, 0))


def has_writer(directory: ShmDirectory, name: str) -> bool:
    """Return whether a process writes the statistics ``name``; another user's file does not count."""
    try:
        with directory.opened(name) as fd:
            status = os.fstat(fd)
            if not stat.S_ISREG(status.st_mode) or status.st_uid not in (os.geteuid(), 0):
                return False
            asked = _FLOCK.pack(fcntl.F_RDLCK, os.SEEK_SET, 0, 1, 0)  # a read lock does not conflict with it
            return bool(_FLOCK.unpack(fcntl.fcntl(fd, _OFD_GETLK, asked))[0] == fcntl.F_WRLCK)
    except OSError:
        return False


def refuse_second(directory: ShmDirectory, instance: str) -> None:
    """Raise `InstanceBusy` if a daemon uses the names of ``instance`` in this directory."""
    if has_writer(directory, statistics_name(instance)):
        raise _busy(directory, instance)


def take_name(directory: ShmDirectory, instance: str, fd: int) -> None:
    """Give the finished segment its name, replacing a segment that a dead daemon left.

    If several daemons try at the same time, one succeeds.

    Raises
    ------
    InstanceBusy
        Another daemon has the name.
    CannotStart
        An existing file cannot be removed.
    OSError
        The directory is full.
    """
    name = statistics_name(instance)
    for _ in range(_ATTEMPTS):
        refuse_second(directory, instance)
        try:
            directory.link(fd, name)
            return
        except FileExistsError:
            pass
        except OSError as error:
            if is_full(error):
                raise
            raise _taken(directory, name, error) from error
        aside = new_segment_name(instance)
        try:
            if stat.S_ISDIR(os.lstat(directory.path + name).st_mode):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            directory.rename(name, aside)  # an unlink by name might remove a newer segment
        except FileNotFoundError:
            continue
        except OSError as error:
            raise _taken(directory, name, error) from error
        if has_writer(directory, aside):  # another daemon took the name since the check
            os.rename(directory.path + aside, directory.path + name)
            raise _busy(directory, instance)
        directory.unlink(aside)
    raise _taken(directory, name, None)


def _taken(directory: ShmDirectory, name: str, error: OSError | None) -> CannotStart:
    return name_taken(
        "the statistics", directory.path + name, error, otherwise="choose another --instance or --shm-dir"
    )


def _busy(directory: ShmDirectory, instance: str) -> InstanceBusy:
    try:
        holder = read_statistics(instance, directory.path).identity
    except (ShmmapError, OSError):
        holder = None
    named = f" (pid {holder.pid}, listening at {holder.endpoint})" if holder is not None else ""
    return InstanceBusy(
        f"another daemon{named} has instance {instance} in {directory.path}",
        hint="stop it, or choose another --instance or --shm-dir",
    )
