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
import secrets
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


def replace_file(folder: Folder, name: str, data: bytes) -> None:
    """Write a file to disk, replacing any file of its name; `sync_names` makes the name durable."""
    interim = f".{name}.{secrets.token_hex(4)}{INTERIM}"
    try:
        folder.write(interim, data)
        folder.sync(interim)
        folder.rename(interim, name)
    except OSError:
        with contextlib.suppress(OSError):
            folder.remove(interim)
        raise


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
        raise OSError(error.errno, f"{name} cannot be read: {error.strerror}") from error


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
    """Files of a directory that another process may be changing: each read returns one consistent version.

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

    def _open(self, name: str, flags: int) -> int:
        # a pipe or a device of that name would block the opener
        flags |= os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
        try:
            return os.open(name, flags, 0o600, dir_fd=self._fd)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise OSError(errno.ELOOP, "it is a symbolic link, not a regular file", name) from error
            raise

    def read(self, name: str, most: int = MAX_BYTES) -> bytes:
        """Return the first ``most`` bytes of a file; raise OSError if it is no regular file."""
        while True:
            fd = self._open(name, os.O_RDONLY)
            try:
                before = os.fstat(fd)
                _require_regular(before.st_mode, name)
                left = min(before.st_size, most)
                parts = []
                while left and (part := os.read(fd, left)):
                    parts.append(part)
                    left -= len(part)
                after = os.fstat(fd)
                if (before.st_mtime_ns, before.st_size) == (after.st_mtime_ns, after.st_size):
                    return b"".join(parts)
            finally:  # otherwise another file has the name now, and this one was overwritten
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

    def write(self, name: str, data: bytes) -> None:
        """Create a file."""
        fd = self._open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        try:
            left = memoryview(data)
            while left:
                left = left[os.write(fd, left) :]
        finally:
            os.close(fd)

    def sync(self, name: str) -> None:
        """Flush a file's content to the disk."""
        fd = self._open(name, os.O_RDONLY)
        try:
            os.fdatasync(fd)
        finally:
            os.close(fd)

    def rename(self, old: str, new: str) -> None:
        """Rename a file, replacing any file that has the new name."""
        os.rename(old, new, src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def remove(self, name: str) -> None:
        """Remove a file."""
        os.unlink(name, dir_fd=self._fd)

    def sync_names(self) -> None:
        """Flush all names to the disk."""
        os.fsync(self._fd)

    def moved(self) -> str:
        """Return what happened to the directory if it is no longer at its path; else an empty string."""
        try:
            status = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return "it was moved or removed"
        except OSError as error:
            return f"it cannot be looked at: {error.strerror}"
        return "" if (status.st_dev, status.st_ino) == self._identity else "another one is in its place"
