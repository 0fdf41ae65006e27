# SPDX-License-Identifier: Apache-2.0
"""Basic operations on the files of a live map, one system call each.

A file's content is on disk after `Folder.sync`, its name after `Folder.sync_names`.  Before that, a power cut
may leave the old content or name, or any part of the new content.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from itertools import count
from typing import Final

from shmmap.errors import InstanceBusy

INTERIM: Final = ".tmp"
"""Suffix of a file that does not have its final name yet; its interim name begins with a dot."""
DAMAGED: Final = ".damaged."
"""Infix between the original name of a damaged file that was put aside and a number."""
MAX_BYTES: Final = 1 << 28
"""Most bytes that are read from a file: more than an undamaged file can have."""
_TO_READ: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
"""A pipe or a device would block the opener otherwise."""


def free_name(folder: FolderToRead, start: str) -> str:
    """Return a name that is not taken: ``start`` and a number."""
    taken = set(folder.names())
    return next(one for number in count(1) if (one := f"{start}{number}") not in taken)


@contextlib.contextmanager
def named(name: str) -> Iterator[None]:
    """Add a file's name to errors of the operating system."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, f"{name}: {error.strerror}") from error


_KINDS: Final = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a symbolic link",
}
"""Descriptions of files that are not regular, by type."""


def _require_regular(mode: int, name: str) -> None:
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"it is {kind}, not a regular file", name)


class FolderToRead:
    """Files of a directory that another process may be changing.

    Raises
    ------
    OSError
        It cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._fd = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    def close(self) -> None:
        """Close the directory, and unlock it."""
        os.close(self._fd)

    def names(self) -> list[str]:
        """Return all names."""
        return os.listdir(self._fd)

    def place(self, name: str) -> str:
        """Return a path of a file in the directory, wherever that was moved since it was opened."""
        return f"/proc/self/fd/{self._fd}/{name}"

    def require_regular(self, name: str) -> None:
        """Raise OSError if there is something of this name that is no regular file."""
        with contextlib.suppress(FileNotFoundError):
            _require_regular(os.stat(name, dir_fd=self._fd, follow_symlinks=False).st_mode, name)

    def size(self, name: str) -> int:
        """Return the length of a file, bytes."""
        return os.stat(name, dir_fd=self._fd, follow_symlinks=False).st_size

    def is_in_use(self) -> bool:
        """Return whether a daemon works with the directory at present."""
        try:
            fcntl.flock(self._fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        fcntl.flock(self._fd, fcntl.LOCK_UN)
        return False

    def read(self, name: str, most: int = MAX_BYTES, start: int = 0) -> bytes:
        """Return at most ``most`` bytes of a file; raise OSError if it is no regular file."""
        fd = os.open(name, _TO_READ, dir_fd=self._fd)
        try:
            status = os.fstat(fd)
            _require_regular(status.st_mode, name)
            with open(fd, "rb", closefd=False) as file:
                file.seek(start)
                return file.read(min(most, status.st_size))  # it gets memory for as much at once
        finally:
            os.close(fd)


class Folder(FolderToRead):
    """Files of a directory that is locked against other processes until it is closed.

    Parameters
    ----------
    path
        Path of the directory; created if it is missing, for this user alone.

    Raises
    ------
    InstanceBusy
        Another process has it open.
    OSError
        It cannot be created or opened.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        with contextlib.suppress(FileExistsError):  # if that is no directory, it cannot be opened below
            os.makedirs(path, mode=0o700, exist_ok=True)
        super().__init__(path)
        status = os.fstat(self._fd)
        self._identity = status.st_dev, status.st_ino
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._fd)
            raise InstanceBusy(
                f"another process works with the live map in {self.path}",
                hint="stop it, or choose another directory",
            ) from None

    def is_in_use(self) -> bool:
        """Return False: only this process works with it."""
        return False

    def create(self, name: str) -> None:
        """Create an empty file, for this user alone."""
        os.close(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600, dir_fd=self._fd))

    def sync(self, name: str) -> None:
        """Flush a file's content to the disk."""
        with open(os.open(name, _TO_READ, dir_fd=self._fd), "rb") as file:
            os.fdatasync(file.fileno())

    def rename(self, old: str, new: str) -> None:
        """Rename a file, replacing any file that has the new name."""
        os.rename(old, new, src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._fd)

    def sync_names(self) -> None:
        """Flush all names to the disk."""
        os.fsync(self._fd)

    def identity(self, name: str) -> tuple[int, int] | None:
        """Return the device and the inode of a file; None if there is none of that name."""
        with contextlib.suppress(FileNotFoundError):
            status = os.stat(name, dir_fd=self._fd, follow_symlinks=False)
            return status.st_dev, status.st_ino
        return None

    def moved(self) -> str:
        """Return what happened to the directory if it is no longer at its path; else an empty string."""
        try:
            status = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return "its directory: it was moved or removed"
        except OSError as error:
            return f"its directory: it cannot be looked at: {error.strerror}"
        is_there = (status.st_dev, status.st_ino) == self._identity
        return "" if is_there else "its directory: another one is in its place"
