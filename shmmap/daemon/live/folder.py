# SPDX-License-Identifier: Apache-2.0
"""The few things that are done with the files of a live map, one system call each.

What is written is on the disk after `Folder.sync`, and a file's name after `Folder.sync_names`; before that
a power cut may leave either as it was, or, of a file, any part of it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import secrets
import stat
from itertools import count
from typing import Final, Protocol

from shmmap.errors import InstanceBusy

__all__ = [
    "DAMAGED",
    "INTERIM",
    "Files",
    "FilesToRead",
    "Folder",
    "FolderToRead",
    "is_aside",
    "keep_aside",
    "replace_file",
    "write_beside",
]

INTERIM: Final = ".tmp"
"""How the name of a file ends that has not got its own yet; it begins with a dot."""
DAMAGED: Final = ".damaged."
"""What stands between the name that a file had and a number when it was put aside."""
MOST_BYTES: Final = 1 << 28
"""That are read of any file: more than one can have that is not damaged."""


_libc: Final = ctypes.CDLL(None, use_errno=True)
_RENAME_EXCHANGE: Final = 2


class FilesToRead(Protocol):
    """Files in one directory, by name."""

    def names(self) -> list[str]:
        """All names."""

    def size(self, name: str) -> int:
        """Bytes of a file."""

    def read(self, name: str, most: int = MOST_BYTES) -> bytes:
        """The first ``most`` bytes of a file; OSError of what is no regular file."""


class Files(FilesToRead, Protocol):
    """Files that may be changed, too."""

    def write(self, name: str, data: bytes) -> None:
        """Make a file of a new name."""

    def overwrite(self, name: str, data: bytes) -> None:
        """Write over a file that nobody needs; if that fails it has some of both."""

    def sync(self, name: str) -> None:
        """Have what was written on the disk."""

    def exchange(self, one: str, other: str) -> None:
        """Have two files each get the other's name, at once; OSError where the file system cannot."""

    def rename(self, old: str, new: str) -> None:
        """Give a file another name, in the place of what has it."""

    def remove(self, name: str) -> None:
        """Remove a file."""

    def sync_names(self) -> None:
        """Have all names on the disk as they are now."""

    def moved(self) -> str:
        """What has become of the directory, if it is not where it was opened; empty if it is there."""


def write_beside(files: Files, name: str, data: bytes) -> str:
    """Write what is to get this name under another one, which is returned."""
    interim = f".{name}.{secrets.token_hex(4)}{INTERIM}"
    try:
        files.write(interim, data)
    except OSError:
        with contextlib.suppress(OSError):
            files.remove(interim)
        raise
    return interim


def replace_file(files: Files, name: str, data: bytes) -> None:
    """Put a file, which is on the disk, in the place of what has its name; `sync_names` makes that last."""
    interim = write_beside(files, name, data)
    try:
        files.sync(interim)
        files.rename(interim, name)
    except OSError:
        with contextlib.suppress(OSError):
            files.remove(interim)
        raise


def is_aside(name: str) -> bool:
    """Whether a file was put aside, because it was damaged or could not be read."""
    return DAMAGED in name and name.rpartition(".")[2].isdecimal()


def keep_aside(files: Files, name: str) -> str:
    """Give a damaged file another name, which is on the disk when this returns it."""
    taken = set(files.names())
    aside = next(one for number in count(1) if (one := f"{name}{DAMAGED}{number}") not in taken)
    files.rename(name, aside)
    files.sync_names()
    return aside


def _kind(mode: int) -> str:
    """What a file is that is no regular one."""
    kinds = {
        stat.S_IFDIR: "a directory", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    }  # fmt: skip
    return kinds.get(stat.S_IFMT(mode), "something else")


class FolderToRead:
    """Files of a directory with which somebody else may be working: each is whole, as it was at a moment.

    Parameters
    ----------
    path
        The directory.

    Raises
    ------
    OSError
        It cannot be opened.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._fd = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    def close(self) -> None:
        """Let others have it."""
        os.close(self._fd)

    def names(self) -> list[str]:
        """All names."""
        return os.listdir(self._fd)

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return os.stat(name, dir_fd=self._fd, follow_symlinks=False).st_size

    def _open(self, name: str, flags: int) -> int:
        # a pipe or a device of that name would keep the opener waiting
        flags |= os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
        try:
            return os.open(name, flags, 0o600, dir_fd=self._fd)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise OSError(errno.ELOOP, "it is a symbolic link, not a regular file", name) from error
            raise

    def read(self, name: str, most: int = MOST_BYTES) -> bytes:
        """The first ``most`` bytes of a file; OSError of what is no regular file."""
        while True:
            fd = self._open(name, os.O_RDONLY)
            try:
                before = os.fstat(fd)
                if not stat.S_ISREG(before.st_mode):
                    raise OSError(errno.EINVAL, f"it is {_kind(before.st_mode)}, not a regular file", name)
                left = min(before.st_size, most)
                parts = []
                while left and (part := os.read(fd, left)):
                    parts.append(part)
                    left -= len(part)
                after = os.fstat(fd)
                if (before.st_mtime_ns, before.st_size) == (after.st_mtime_ns, after.st_size):
                    return b"".join(parts)
            finally:  # else another file has the name by now, and this one was written over
                os.close(fd)


class Folder(FolderToRead):
    """Files of a directory that nobody else works with: there is a lock on it while this lives.

    Parameters
    ----------
    path
        Made if it is missing, for this user alone.

    Raises
    ------
    InstanceBusy
        Somebody else has it open.
    OSError
        It cannot be made or opened.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        with contextlib.suppress(FileExistsError):  # which may be something else: it cannot be opened then
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
        """Make a file of a new name."""
        self._write(self._open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL), data)

    def overwrite(self, name: str, data: bytes) -> None:
        """Write over a file that nobody needs; if that fails it has some of both."""
        self._write(self._open(name, os.O_WRONLY), data)

    def _write(self, fd: int, data: bytes) -> None:
        try:
            before = os.fstat(fd).st_size
            left = memoryview(data)
            while left:
                left = left[os.write(fd, left) :]
            if before > len(data):
                os.ftruncate(fd, len(data))
        finally:
            os.close(fd)

    def sync(self, name: str) -> None:
        """Have what was written on the disk."""
        fd = self._open(name, os.O_RDONLY)
        try:
            os.fdatasync(fd)
        finally:
            os.close(fd)

    def exchange(self, one: str, other: str) -> None:
        """Have two files each get the other's name, at once; OSError where the file system cannot."""
        swap = getattr(_libc, "renameat2", None)
        if swap is None:
            raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
        if swap(self._fd, os.fsencode(one), self._fd, os.fsencode(other), _RENAME_EXCHANGE):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), one)

    def rename(self, old: str, new: str) -> None:
        """Give a file another name, in the place of what has it."""
        os.rename(old, new, src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def remove(self, name: str) -> None:
        """Remove a file."""
        os.unlink(name, dir_fd=self._fd)

    def sync_names(self) -> None:
        """Have all names on the disk as they are now."""
        os.fsync(self._fd)

    def moved(self) -> str:
        """What has become of the directory, if it is not where it was opened; empty if it is there."""
        try:
            status = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return "it was moved or removed"
        except OSError as error:
            return f"it cannot be looked at: {error.strerror}"
        return "" if (status.st_dev, status.st_ino) == self._identity else "another one is in its place"
