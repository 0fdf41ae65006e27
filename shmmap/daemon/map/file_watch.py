# SPDX-License-Identifier: Apache-2.0
"""Noticing by inotify(7) that the map's files change, so that nobody has to ask for a reload.

A change is acted upon once the files have been left alone for a moment, for a map is written file by
file; however long that takes, not later than some seconds after it began.  The kernel tells only of
changes made on this machine: on NFS and the like, a reload has to be asked for.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import struct
from collections.abc import Iterable
from typing import Final

from shmmap.errors import ConfigError
from shmmap.origin.catalogue import Catalogue

__all__ = ["MapWatch", "directories_of"]

_log = logging.getLogger(__name__)

SETTLE_S: Final = 0.5
MOST_S: Final = 5.0
LOOK_S: Final = 1.0
"""How often a directory that has vanished is looked for."""

# inotify(7); linux/inotify.h
IN_CLOSE_WRITE: Final = 0x8
IN_MOVED_FROM: Final = 0x40
IN_MOVED_TO: Final = 0x80
IN_CREATE: Final = 0x100
IN_DELETE: Final = 0x200
IN_DELETE_SELF: Final = 0x400
IN_MOVE_SELF: Final = 0x800
IN_IGNORED: Final = 0x8000
IN_ISDIR: Final = 0x40000000
IN_ONLYDIR: Final = 0x1000000
IN_EXCL_UNLINK: Final = 0x4000000
_MASK: Final = (
    IN_CLOSE_WRITE | IN_MOVED_FROM | IN_MOVED_TO | IN_CREATE | IN_DELETE | IN_DELETE_SELF | IN_MOVE_SELF
    | IN_ONLYDIR | IN_EXCL_UNLINK
)  # fmt: skip
_EVENT: Final = struct.Struct("=iIII")
_READ_BYTES: Final = 64 << 10
_REMOTE: Final = frozenset(
    {
        "nfs",
        "nfs4",
        "cifs",
        "smb3",
        "9p",
        "ceph",
        "lustre",
        "glusterfs",
        "fuse.sshfs",
        "fuse.glusterfs",
        "afs",
    }
)


def directories_of(map_path: str, metadata: str, catalogue: Catalogue) -> set[str]:
    """Return the directories whose files make up a map."""
    found = {map_path if os.path.isdir(map_path) else os.path.dirname(map_path)}
    if metadata:
        found.add(os.path.dirname(os.path.abspath(metadata)))
    prefix = os.path.dirname(catalogue.id_prefix)
    if os.path.isdir(prefix):
        found.add(prefix)
    return {directory or "." for directory in found}


class MapWatch:
    """Watches directories for changes of the files in them.

    Parameters
    ----------
    directories
        What to watch; those that vanish are watched again when something is there, which is a change.

    Attributes
    ----------
    fd : int
        Readable when something changed: call `drain` then.

    Raises
    ------
    ConfigError
        The kernel lets this user watch nothing more.
    """

    def __init__(self, directories: Iterable[str]) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self.fd: int = self._libc.inotify_init1(os.O_CLOEXEC | os.O_NONBLOCK)
        if self.fd < 0:
            number = ctypes.get_errno()
            raise _refusal(number)
        self._since_s: float | None = None
        self._last_s = self._look_s = 0.0
        self._paths: dict[int, str] = {}
        self._missing: set[str] = set()
        try:
            for directory in directories:
                if (number := self._add(directory)) not in (0, errno.ENOENT, errno.ENOTDIR):
                    raise _refusal(number)
        except BaseException:
            self.close()
            raise
        for directory in sorted(directories):
            if (kind := _file_system_of(directory)) in _REMOTE:
                _log.warning(
                    "watch: %s is on %s, which does not tell of changes made elsewhere; reload to see them",
                    directory, kind,
                )  # fmt: skip

    def follow(self, directories: Iterable[str]) -> None:
        """Watch these too, from when on that can be; watching one twice is the same as once."""
        for directory in directories:
            self._add(directory)

    def _add(self, directory: str) -> int:
        """Watch a directory; returns why that cannot be (errno), or 0."""
        found = self._libc.inotify_add_watch(self.fd, os.fsencode(directory), _MASK)
        if found < 0:
            self._missing.add(directory)
            return ctypes.get_errno()
        self._paths[found] = directory
        self._missing.discard(directory)
        return 0

    def drain(self, now_s: float) -> None:
        """Take note of what the kernel tells."""
        while data := self._read():
            at = 0
            while at + _EVENT.size <= len(data):
                watch, mask, _, length = _EVENT.unpack_from(data, at)
                at += _EVENT.size + length
                if mask & IN_MOVE_SELF:  # what is followed is a path, not what used to be there
                    self._libc.inotify_rm_watch(self.fd, watch)
                if mask & (IN_MOVE_SELF | IN_IGNORED) and watch in self._paths:
                    self._missing.add(self._paths.pop(watch))
                # a file that is only created has nothing in it yet: its writer closes or renames it
                if mask & IN_IGNORED or (mask & IN_CREATE and not mask & IN_ISDIR):
                    continue
                self._note(now_s)

    def _note(self, now_s: float) -> None:
        if self._since_s is None:
            self._since_s = now_s
        self._last_s = now_s

    def _read(self) -> bytes:
        try:
            return os.read(self.fd, _READ_BYTES)
        except BlockingIOError:
            return b""

    def due(self, now_s: float) -> bool:
        """Whether it is time to read the map again; says so once."""
        if self._missing and now_s >= self._look_s:
            self._look_s = now_s + LOOK_S
            before = len(self._missing)
            self.follow(sorted(self._missing))
            if len(self._missing) < before and self._since_s is None:
                self._note(now_s)
        since_s = self._since_s
        if since_s is None or (now_s - self._last_s < SETTLE_S and now_s - since_s < MOST_S):
            return False
        self._since_s = None
        return True

    def close(self) -> None:
        """Watch no more."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def _refusal(number: int) -> ConfigError:
    limits = "raise fs.inotify.max_user_watches and max_user_instances, or leave out --watch"
    return ConfigError(f"cannot watch the map: {os.strerror(number)}", key="watch", hint=limits)


def _file_system_of(path: str) -> str:
    """Return the type of the file system a path is on, as ``/proc/self/mountinfo`` names it."""
    path = os.path.realpath(path)
    best, kind = "", ""
    try:
        with open("/proc/self/mountinfo", encoding="utf-8", errors="surrogateescape") as file:
            for line in file:
                before, _, after = line.partition(" - ")
                point = before.split()[4].encode().decode("unicode_escape")
                if len(point) >= len(best) and (path + "/").startswith(point.rstrip("/") + "/"):
                    best, kind = point, after.split()[0]
    except (OSError, IndexError, UnicodeError):
        return ""
    return kind
