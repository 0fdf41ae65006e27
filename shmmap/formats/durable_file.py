# SPDX-License-Identifier: Apache-2.0
"""Files that appear whole and survive a power cut, locks on files, and errors of writing."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
from collections.abc import Iterator
from typing import IO, Final

from shmmap.errors import CannotWrite, ShmmapError

__all__ = ["appearing_file", "flush_directory", "locked_file", "writing_errors"]

_ELSEWHERE: Final = "choose a directory that this user may write to"
_HINTS: Final = {
    errno.ENOSPC: "free some space, or choose another disk",
    errno.EDQUOT: "the quota of this user is used up",
    errno.EACCES: _ELSEWHERE,
    errno.EPERM: _ELSEWHERE,
    errno.EROFS: _ELSEWHERE,
}


@contextlib.contextmanager
def appearing_file(path: str | os.PathLike[str], *, replace: bool = True) -> Iterator[IO[bytes]]:
    """Open a file that gets its name only once it is complete and on the disk.

    Parameters
    ----------
    path
        The name; until then the file has another one in the same directory.
    replace
        Whether it may take the place of what has that name.

    Raises
    ------
    FileExistsError
        It may not.
    OSError
        It cannot be written; nothing is left.
    """
    directory, name = os.path.split(path)
    interim = os.path.join(directory, f".{name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(interim, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if replace:
            os.replace(interim, path)
        else:
            os.link(interim, path)  # unlike a rename this never replaces a file
            os.unlink(interim)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(interim)
        if isinstance(error, OSError) and error.filename == interim:
            error.filename = os.fspath(path)  # the name that the caller knows
        raise
    flush_directory(directory or ".")


@contextlib.contextmanager
def locked_file(path: str, *, mode: int = 0o600) -> Iterator[None]:
    """Hold a file's exclusive lock, waiting for it; the file is made with ``mode`` if it is not there."""
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, mode)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def flush_directory(path: str | os.PathLike[str]) -> None:
    """Force the names in a directory to the disk."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@contextlib.contextmanager
def writing_errors(what: str) -> Iterator[None]:
    """Turn an OSError into `CannotWrite`, with a hint; ``what`` is the thing to be written."""
    try:
        yield
    except ShmmapError:
        raise  # also one that is an OSError: that the daemon did not answer is nothing about a file
    except OSError as error:
        raise CannotWrite(
            f"cannot write {error.filename or what}: {error.strerror or error}",
            hint=_HINTS.get(error.errno or 0, ""),
        ) from error
