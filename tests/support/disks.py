# SPDX-License-Identifier: Apache-2.0
"""Disks that fail: one that loses at a power cut whatever it may lose, and one that never answers."""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from shmmap.daemon.live.disk.folder import Folder


class PowerCut(BaseException):
    """The machine is off."""


@dataclass
class _File:
    data: bytes
    synced: bool = False
    was: bytes = b""


@dataclass
class CutDisk(Folder):
    """Files of one directory that is only in memory; it fails after ``operations`` of them.

    What is written is safe after `sync`, a name after `sync_names`.  After a cut, `after` gives the disk as
    it may be found: of the names that were changed since the last `sync_names` any are as before, and of a
    file that was not synced there is what it was before, a part, or zeros in the place of the rest.
    """

    operations: int = 10**9
    exchanges: bool = True
    _names: dict[str, _File] = field(default_factory=dict)
    _safe: dict[str, _File] = field(default_factory=dict)
    _changes: list[dict[str, _File | None]] = field(default_factory=list)  # each as a whole

    def _count(self) -> None:
        if self.operations == 0:
            raise PowerCut
        self.operations -= 1

    def _change(self, change: dict[str, _File | None]) -> None:
        self._changes.append(change)
        _apply(change, self._names)

    def names(self) -> list[str]:
        """All names."""
        return list(self._names)

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return len(self._names[name].data)

    def read(self, name: str, most: int = -1) -> bytes:
        """The first bytes of a file, or all."""
        if name not in self._names:
            raise FileNotFoundError(name)
        data = self._names[name].data
        return data if most < 0 else data[:most]

    def write(self, name: str, data: bytes) -> None:
        """Make a file."""
        assert name not in self._names
        self._count()
        self._change({name: _File(data)})

    def overwrite(self, name: str, data: bytes) -> None:
        """Write over what a file has, whatever its names are on the disk."""
        self._count()
        file = self._names[name]
        file.data, file.was, file.synced = data, file.data, False

    def exchange(self, one: str, other: str) -> None:
        """Each gets the other's name, at once."""
        if one not in self._names or other not in self._names:
            raise FileNotFoundError(other)
        if not self.exchanges:
            raise OSError(errno.EINVAL, "the file system cannot")
        self._count()
        self._change({one: self._names[other], other: self._names[one]})

    def sync(self, name: str) -> None:
        """Its content is safe."""
        self._count()
        self._names[name].synced = True

    def rename(self, old: str, new: str) -> None:
        """Another name, at once: never both, never none."""
        self._count()
        self._change({old: None, new: self._names[old]})

    def remove(self, name: str) -> None:
        """Remove a file."""
        if name not in self._names:
            raise FileNotFoundError(name)
        self._count()
        self._change({name: None})

    def sync_names(self) -> None:
        """All names are safe."""
        self._count()
        self._safe, self._changes = dict(self._names), []

    def moved(self) -> str:
        """Never."""
        return ""

    def after(self, keeps: Callable[[], bool], part: Callable[[int], int]) -> CutDisk:
        """The disk as it is found when the power is back.

        Parameters
        ----------
        keeps
            Whether one change of a name was kept.
        part
            How many of that many bytes are there; a negative number: zeros follow.
        """
        found = dict(self._safe)
        for change in self._changes:
            if keeps():
                _apply(change, found)
        disk = CutDisk()
        for name, file in found.items():
            data = file.data
            if not file.synced:
                size = part(len(data))
                rest = file.was[size:] if size >= 0 else bytes(len(data) + size)
                data = data[: abs(size)] + rest
            disk._names[name] = disk._safe[name] = _File(data, synced=True)
        return disk


def _apply(change: dict[str, _File | None], names: dict[str, _File]) -> None:
    for name, file in change.items():
        if file is None:
            names.pop(name, None)
        else:
            names[name] = file


# A file system that never answers, as of a server that is away: FUSE without a program behind it


_DETACH = 2
_libc = ctypes.CDLL(None, use_errno=True)


class HangingDirectory:
    """Hangs over a directory until `end`: then that is as it was.

    Raises
    ------
    OSError
        This process may not mount, or the kernel has no FUSE.
    """

    def __init__(self, path: Path) -> None:
        self._path = os.fsencode(path)
        self._fd = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
        options = b"fd=%d,rootmode=40000,user_id=%d,group_id=%d,allow_other" % (
            self._fd,
            os.geteuid(),
            os.getegid(),
        )
        if _libc.mount(b"hangs", self._path, b"fuse", 0, options):
            number = ctypes.get_errno()
            os.close(self._fd)
            raise OSError(number, os.strerror(number))

    def end(self) -> None:
        """Unmount it: waiting processes get an error."""
        if self._fd >= 0:
            _libc.umount2(self._path, _DETACH)
            os.close(self._fd)
            self._fd = -1
