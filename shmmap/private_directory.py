# SPDX-License-Identifier: Apache-2.0
"""Directories of working state and caches: made for this user alone, or refused.

Their names can be guessed, so another account may have made one before, or a link of that name, wherever it
may write.  A directory is therefore opened once, its owner and mode are looked at through the descriptor,
and what is in it is reached through the descriptor, see `within`: exchanging the name afterwards changes
nothing.  Nobody else can put anything into a directory that was found closed to others.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from typing import Final

__all__ = [
    "CLOSED",
    "DIRECTORY_FLAGS",
    "UNWRITABLE",
    "NotPrivate",
    "open_private",
    "opened_private",
    "require_private",
    "why_not_private",
    "within",
]

UNWRITABLE: Final = 0o022
"""Permissions that others may not have: they may read."""
CLOSED: Final = 0o077
"""Permissions that others may not have: none at all."""

DIRECTORY_FLAGS: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class NotPrivate(PermissionError):
    """A directory is not this user's, or not closed to others; ``hint`` says what to do."""

    def __init__(self, path: str | os.PathLike[str], why: str) -> None:
        super().__init__(errno.EPERM, f"it {why}", os.fspath(path))
        self.hint = (
            "close it (chmod go-w), or remove it"
            if why.startswith("may be")
            else "see who made it and remove it, or use another directory"
        )


def why_not_private(
    status: os.stat_result, uid: int, *, refused: int = UNWRITABLE, or_root: bool = False
) -> str:
    """Return why a directory is not private to a user, as the end of a sentence; empty if it is.

    Parameters
    ----------
    refused
        Permissions that others may not have, `UNWRITABLE` or `CLOSED`.
    or_root
        It may belong to root, too.
    """
    if stat.S_ISLNK(status.st_mode):
        return "is a symbolic link"
    if not stat.S_ISDIR(status.st_mode):
        return "is no directory"
    if status.st_uid != uid and not (or_root and status.st_uid == 0):
        return f"belongs to user {status.st_uid}, not to user {uid}"
    if status.st_mode & refused:
        used = "written" if status.st_mode & UNWRITABLE else "read"
        return f"may be {used} by other users (mode {stat.S_IMODE(status.st_mode):04o})"
    return ""


def open_private(
    path: str | os.PathLike[str],
    *,
    make: bool = False,
    refused: int = UNWRITABLE,
    or_root: bool = False,
    dir_fd: int | None = None,
) -> int:
    """Open a directory, and return its descriptor; a symbolic link in its place is not followed.

    Parameters
    ----------
    make
        Make it with mode 0700 if it is missing; the directory above must exist.
    refused, or_root
        As in `why_not_private`.
    dir_fd
        Descriptor of the directory to which ``path`` is relative.

    Raises
    ------
    NotPrivate
        It is no directory of this user's that is closed to others.
    OSError
        It does not exist, or cannot be made or opened.
    """
    is_new = False
    if make:
        with contextlib.suppress(FileExistsError):
            os.mkdir(path, 0o700, dir_fd=dir_fd)
            is_new = True
    try:
        fd = os.open(path, DIRECTORY_FLAGS, dir_fd=dir_fd)
    except OSError as error:
        if error.errno not in (errno.ENOTDIR, errno.ELOOP):
            raise
        found = os.stat(path, dir_fd=dir_fd, follow_symlinks=False)
        raise NotPrivate(path, why_not_private(found, found.st_uid) or "was exchanged just now") from None
    try:
        status, uid = os.fstat(fd), os.geteuid()
        why = why_not_private(status, uid, refused=refused, or_root=or_root)
        if is_new and status.st_uid == uid and status.st_mode & refused:
            # a file system without permissions, unless it is another directory that got the name meanwhile
            why = "was exchanged just now" if os.listdir(fd) else ""
        if why:
            raise NotPrivate(path, why)
    except BaseException:
        os.close(fd)
        raise
    return fd


@contextlib.contextmanager
def opened_private(
    path: str | os.PathLike[str], *, make: bool = False, refused: int = UNWRITABLE, or_root: bool = False
) -> Iterator[int]:
    """Open a directory for one operation, as `open_private`: by the next, it may be replaced or gone."""
    fd = open_private(path, make=make, refused=refused, or_root=or_root)
    try:
        yield fd
    finally:
        os.close(fd)


def require_private(path: str | os.PathLike[str], *, or_root: bool = False) -> None:
    """Make a directory if it is missing, and look at it, for what can be reached by name only.

    Others may not be able to exchange it, either: the directory above must be closed to their writing, or be
    sticky, as /tmp is.

    Raises
    ------
    NotPrivate, OSError
        As `open_private`.
    """
    above = os.path.dirname(os.path.abspath(path))
    os.makedirs(above, mode=0o755, exist_ok=True)
    with opened_private(path, make=True, or_root=or_root):
        pass
    status = os.stat(above)
    if status.st_mode & UNWRITABLE and not status.st_mode & stat.S_ISVTX:
        raise NotPrivate(above, f"may be written by other users (mode {stat.S_IMODE(status.st_mode):04o})")


def within(fd: int, name: str = "") -> str:
    """Return a path, valid in this process, of a directory held open, or of a name in it.

    Where the directory is, or what has its name now, is of no matter.
    """
    return os.path.join(f"/proc/self/fd/{fd}", name) if name else f"/proc/self/fd/{fd}"
