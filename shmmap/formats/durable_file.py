# SPDX-License-Identifier: Apache-2.0
"""Write files that appear complete and survive power loss; lock files; convert errors of writing."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import secrets
from collections.abc import Iterator
from typing import IO, Final

from shmmap.errors import CannotWrite, ShmmapError
from shmmap.private_directory import refuse_planted

_LOCK_FLAGS: Final = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
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
    """Open a file that gets its name only when it is complete and on the disk.

    Parameters
    ----------
    path
        Final name.  Until the end the file has none, so a kill leaves nothing; or a temporary one in the same
        directory, where the file system (NFS) needs that.
    replace
        Whether the file may replace an existing one.

    Raises
    ------
    FileExistsError
        A file of that name exists, and ``replace`` is False.
    OSError
        The file cannot be written, or another account has made a link in place of the directory; nothing is
        left behind.
    """
    directory, name = os.path.split(path)
    refuse_planted(directory or ".")
    interim = os.path.join(directory, f".{name}.{secrets.token_hex(4)}.tmp")
    try:
        with _opened(directory or ".", interim) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if not os.fstat(file.fileno()).st_nlink:  # no call gives it a name and replaces another's at once
                # with a descriptor, though none is needed, Python has the path in /proc followed
                os.link(f"/proc/self/fd/{file.fileno()}", interim, src_dir_fd=file.fileno())
        if replace:
            os.replace(interim, path)
        else:
            os.link(interim, path)  # unlike a rename, a link never replaces a file
            os.unlink(interim)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(interim)
        if isinstance(error, OSError) and interim in (error.filename, error.filename2):
            error.filename = os.fspath(path)  # the name that the caller knows
        raise
    flush_directory(directory or ".")


def _opened(directory: str, interim: str) -> IO[bytes]:
    """Open a new file without a name, or with this one where files must have one."""
    with contextlib.suppress(OSError):
        return open(os.open(directory, os.O_TMPFILE | os.O_WRONLY | os.O_CLOEXEC, 0o666), "wb")
    return open(interim, "xb")


@contextlib.contextmanager
def locked_file(path: str, *, mode: int = 0o600) -> Iterator[None]:
    """Wait for a file's exclusive lock and hold it; a missing file is created with ``mode``."""
    fd = os.open(path, _LOCK_FLAGS, mode)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def locked_entry(directory: str, name: str, kind: int, *, mode: int = 0o777) -> int:
    """Lock a file of a directory, and return its descriptor; both are created if missing.

    Its holder may remove the directory; a process that waited meanwhile then locks a new file.

    Parameters
    ----------
    kind
        As in `fcntl.flock`.
    mode
        Permissions of a new directory.

    Raises
    ------
    BlockingIOError
        The lock is held, and ``kind`` includes ``LOCK_NB``.
    """
    path = os.path.join(directory, name)
    while True:
        os.makedirs(directory, mode=mode, exist_ok=True)
        fd = os.open(path, _LOCK_FLAGS, 0o600)
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, fd)
            fcntl.flock(fd, kind)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(fd), os.stat(path)):
                    undo.pop_all()
                    return fd


def flush_directory(path: str | os.PathLike[str]) -> None:
    """Flush a directory's entries to the disk."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@contextlib.contextmanager
def writing_errors(what: str) -> Iterator[None]:
    """Convert OSError to `CannotWrite` with a hint; ``what`` names the thing to be written."""
    try:
        yield
    except ShmmapError:
        raise  # some errors of shmmap are OSErrors, too, but are not about a file
    except OSError as error:
        raise CannotWrite(
            f"cannot write {error.filename or what}: {error.strerror or error}",
            hint=getattr(error, "hint", "") or _HINTS.get(error.errno or 0, ""),
        ) from None
