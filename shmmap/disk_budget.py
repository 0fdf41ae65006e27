# SPDX-License-Identifier: Apache-2.0
"""Disk budget of a cache directory with computed layers and objects of published maps.

::

    DIRECTORY/layers/...                   entries of shmmap.layers.disk_cache, named *.layer
    DIRECTORY/objects/cells/ab/<sha256>    objects of shmmap.origin.remote.object_tier
    DIRECTORY/objects/index/ab/<sha256>    its index pages

Any number of processes may use the directory, without a coordinator.  Each process counts the bytes that it
adds, and scans the directory at intervals.  If the budget is exceeded, it removes the least recently used
files until a sixteenth of the budget is free.  Index pages are removed last, as long as they are at most a
quarter of the budget: without them no cached cell can be found.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from shmmap.failpoints import step
from shmmap.private_directory import why_not_private

LAYERS: Final = "layers"
OBJECTS: Final = "objects"
CELLS: Final = "cells"
INDEX: Final = "index"
INTERIM: Final = ".new-"
"""Prefix of a file's name until the file is complete."""

_KEPT: Final = re.compile(r".+\.layer|[0-9a-f]{64}")
_BLOCK_BYTES: Final = 4096  # of most file systems
_SPARE_SHARE: Final = 0.05  # share of the file system that is left free
_FREED_SHARE: Final = 1 / 16
_STEPS: Final = 64  # parts of the budget; a process scans again after adding one part
_PROCESSES: Final = 8  # assumed number of processes that add at the same rate
_INDEX_SHARE: Final = 1 / 4
_USED_AGAIN_S: Final = 600.0
_STALE_INTERIM_S: Final = 3600.0


@dataclass(slots=True)
class _Kept:
    """A file, which may have several names."""

    used_s: float
    nbytes: int
    is_index: bool
    paths: list[str] = field(default_factory=list)


class DiskBudget:
    """Keeps the files of one cache directory within a budget; thread-safe.

    Parameters
    ----------
    directory
        The cache directory.
    limit_bytes
        Maximum total size of the files, bytes.
    owner
        User id that owns the files; None: this process's user.
    """

    def __init__(self, directory: str, limit_bytes: int, *, owner: int | None = None) -> None:
        self.directory = directory
        self.limit_bytes = limit_bytes
        self._owner = owner
        self._lock = threading.Lock()
        self._added_bytes = 0
        self._left_bytes = limit_bytes

    def has_room(self, nbytes: int) -> bool:
        """Return whether a file of this size may be added, leaving some of the file system free.

        Raises
        ------
        OSError
            The directory cannot be examined.
        """
        room = os.statvfs(self.directory)
        spare = int(room.f_blocks * room.f_frsize * _SPARE_SHARE)
        return nbytes <= min(self.limit_bytes, room.f_bavail * room.f_frsize - spare)

    def added(self, nbytes: int) -> bool:
        """Count an added file; return True when it is time to `trim`."""
        with self._lock:
            self._added_bytes += -(-nbytes // _BLOCK_BYTES) * _BLOCK_BYTES
            free_bytes = self.limit_bytes - self._left_bytes
            if self._added_bytes <= max(self.limit_bytes // _STEPS, free_bytes // _PROCESSES):
                return False
            self._added_bytes = 0
        return True

    def used_bytes(self) -> int:
        """Return the bytes that the files take on the disk at present."""
        return sum(kept.nbytes for kept in self._kept(remove_stale=False))

    def trim(self) -> int:
        """Remove files if they exceed the budget; return the size of the remaining files, bytes.

        A hundred thousand files take a second.  Incomplete files of killed processes are removed after an
        hour.
        """
        found = self._kept(remove_stale=True)
        total = sum(kept.nbytes for kept in found)
        if total > self.limit_bytes:
            enough = int(self.limit_bytes * (1 - _FREED_SHARE))
            for kept in _order_of_removal(found, self.limit_bytes):
                if total <= enough:
                    break
                for path in kept.paths:
                    step("trim.file")
                    with contextlib.suppress(OSError):
                        os.unlink(path)
                total -= kept.nbytes
        self._left_bytes = total
        return total

    def _kept(self, *, remove_stale: bool) -> list[_Kept]:
        found: dict[tuple[int, int], _Kept] = {}
        now_s = time.time()

        def is_old(status: os.stat_result) -> bool:
            return abs(now_s - status.st_mtime) > _STALE_INTERIM_S

        for place, is_index in self._places():
            for entry in _files(place):
                with contextlib.suppress(OSError):  # another process has removed it
                    status = entry.stat(follow_symlinks=False)
                    if _KEPT.fullmatch(entry.name):
                        key = status.st_dev, status.st_ino
                        kept = found.get(key)
                        if kept is None:
                            kept = found[key] = _Kept(status.st_mtime, _bytes_on_disk(status), is_index)
                        kept.paths.append(entry.path)
                    elif remove_stale and entry.name.startswith(INTERIM) and is_old(status):
                        os.unlink(entry.path)
        return list(found.values())

    def _places(self) -> list[tuple[str, bool]]:
        """Return the directories with files, and whether each contains index pages."""
        layers, objects = (os.path.join(self.directory, name) for name in (LAYERS, OBJECTS))
        owner = os.geteuid() if self._owner is None else self._owner
        places: list[tuple[str, bool]] = []
        with contextlib.suppress(OSError):
            if not why_not_private(os.lstat(layers), owner, or_root=True):
                places.append((layers, False))
        with contextlib.suppress(OSError):
            if not why_not_private(os.lstat(objects), owner):
                places += [(os.path.join(objects, CELLS), False), (os.path.join(objects, INDEX), True)]
        return places


def _bytes_on_disk(status: os.stat_result) -> int:
    """Return what a file takes on the disk; blocks of a file just written may not be counted yet."""
    return max(status.st_blocks * 512, status.st_size)


def _files(place: str) -> Iterator[os.DirEntry[str]]:
    """Yield all files below a directory, which may be missing; links are not followed."""
    with contextlib.suppress(OSError):
        if not stat.S_ISDIR(os.lstat(place).st_mode):
            return
        with os.scandir(place) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    yield from _files(entry.path)
                else:
                    yield entry


def _order_of_removal(found: list[_Kept], limit_bytes: int) -> list[_Kept]:
    """Sort files for removal: least recently used first, protected index pages last."""
    found.sort(key=lambda kept: kept.used_s)
    index_bytes = 0
    last: set[int] = set()
    for kept in reversed(found):
        if kept.is_index and index_bytes + kept.nbytes <= limit_bytes * _INDEX_SHARE:
            index_bytes += kept.nbytes
            last.add(id(kept))
    return sorted(found, key=lambda kept: id(kept) in last)


def mark_used(fd: int, status: os.stat_result) -> None:
    """Mark a file as used now; does nothing if it was marked within the last minutes."""
    # a clock that was a day fast leaves stamps in the future
    if abs(time.time() - status.st_mtime) > _USED_AGAIN_S:
        with contextlib.suppress(OSError):
            os.utime(fd)
