# SPDX-License-Identifier: Apache-2.0
"""Directories of working state and caches: made for this user alone, or refused.

Their names can be guessed, so another account may have made one before, or a link of that name, wherever it
may write.  A directory is therefore opened once, its owner and mode are looked at through the descriptor,
and what is in it is reached through the descriptor, see `within`: exchanging the name afterwards changes
nothing.  No other account can put anything into a directory that was found closed to others.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
from collections.abc import Iterator
from typing import Final

PRIVATE: Final = 0o700
"""Mode of a directory for this user alone."""
UNWRITABLE: Final = 0o022
"""Permissions that others may not have: they may read."""
CLOSED: Final = 0o077
"""Permissions that others may not have: none at all."""

_OPEN: Final = "may be"
_MAX_LINKS: Final = 40  # as in the kernel
DIRECTORY_FLAGS: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


class NotPrivate(PermissionError):
    """A directory is not this user's, or not closed to others.

    ``why`` is the end of a sentence that begins with the path; ``hint`` says what to do.
    """

    def __init__(self, path: str | os.PathLike[str], why: str) -> None:
        super().__init__(errno.EPERM, f"it {why}", os.fspath(path))
        self.why = why
        self.hint = (
            f"remove it; or, if no other account has put anything there, chmod go-w {os.fspath(path)}"
            if why.startswith(_OPEN)
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
    return why_not_own(status, uid, refused=refused, or_root=or_root)


def why_not_own(status: os.stat_result, uid: int, *, refused: int = UNWRITABLE, or_root: bool = False) -> str:
    """Return why a file of any kind is not a user's alone, as `why_not_private`."""
    if status.st_uid != uid and not (or_root and status.st_uid == 0):
        return f"belongs to user {status.st_uid}, not to user {uid}"
    if status.st_mode & refused:
        used = "written" if status.st_mode & UNWRITABLE else "read"
        return f"{_OPEN} {used} by other users (mode {stat.S_IMODE(status.st_mode):04o})"
    return ""


def open_private(
    path: str | os.PathLike[str],
    *,
    make: int = 0,
    refused: int = UNWRITABLE,
    or_root: bool = False,
    own_link: bool = False,
) -> int:
    """Open a directory, and return its descriptor; a symbolic link in its place is not followed.

    Parameters
    ----------
    make
        Make it with this mode if it is missing; the directory above must exist.  0: do not.
    refused, or_root
        As in `why_not_private`.
    own_link
        Follow a link that this user or root has made.

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
            os.mkdir(path, make)
            is_new = True
    try:
        fd = os.open(_followed(path) if own_link else path, DIRECTORY_FLAGS)
    except OSError as error:
        if error.errno not in (errno.ENOTDIR, errno.ELOOP, errno.EACCES):
            raise
        if why := why_not_private(os.lstat(path), os.geteuid(), refused=refused, or_root=or_root):
            raise NotPrivate(path, why) from None
        raise  # or it was exchanged just now
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
    path: str | os.PathLike[str],
    *,
    make: int = 0,
    refused: int = UNWRITABLE,
    or_root: bool = False,
    own_link: bool = False,
) -> Iterator[int]:
    """Open a directory for one operation, as `open_private`: by the next, it may be replaced or gone."""
    fd = open_private(path, make=make, refused=refused, or_root=or_root, own_link=own_link)
    try:
        yield fd
    finally:
        os.close(fd)


def open_own(path: str, flags: int, *, dir_fd: int | None = None) -> int:
    """Open a file of a private directory that this user has made, and return its descriptor.

    A new one is made with mode 0600.  Waits for nothing, such as the writer of a pipe.

    Raises
    ------
    OSError
        It is missing, a link, no regular file, another user's, or has a second name elsewhere.
    """
    fd = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600, dir_fd=dir_fd)
    status = os.fstat(fd)
    if stat.S_ISREG(status.st_mode) and status.st_nlink == 1 and status.st_uid == os.geteuid():
        return fd
    os.close(fd)
    raise OSError(errno.EPERM, "it is not a file that this user has made there", path)


def require_private(path: str | os.PathLike[str], *, make: int = PRIVATE, refused: int = UNWRITABLE) -> None:
    """Look at a directory that is used by its name, and make it first if it is missing.

    All may not be able to exchange it, either: of the directories above, none may be open to all for writing
    unless it is sticky, as /tmp is.

    Raises
    ------
    NotPrivate, OSError
        As `open_private`.
    """
    path = os.path.abspath(path)
    refuse_planted_above(path)
    if make:
        os.makedirs(os.path.dirname(path), mode=0o755, exist_ok=True)
    with opened_private(path, make=make, refused=refused):
        pass
    while (above := os.path.dirname(path)) != path:
        status, path = os.stat(above), above
        if not status.st_mode & stat.S_ISVTX and (
            why := why_not_own(status, status.st_uid, refused=stat.S_IWOTH)
        ):
            raise NotPrivate(above, why)


def open_followed(path: str) -> int:
    """Open a directory, also through a link that this user or root has made; OSError for another's link."""
    return os.open(_followed(path), DIRECTORY_FLAGS)


def _followed(path: str | os.PathLike[str]) -> str:
    """Return where links of this user or of root lead, else the path itself."""
    path = os.fspath(path)
    for _ in range(_MAX_LINKS):
        fd = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            status = os.fstat(fd)
            if not stat.S_ISLNK(status.st_mode) or status.st_uid not in (0, os.geteuid()):
                break
            path = os.path.join(os.path.dirname(path), os.readlink("", dir_fd=fd))
        finally:
            os.close(fd)
    return path


def refuse_planted(path: str | os.PathLike[str]) -> None:
    """Raise `NotPrivate` if another account has made a link, a pipe or a device in place of an output.

    Links and pipes of this user or of root are meant, such as ``/dev/stdout``.
    """
    with contextlib.suppress(FileNotFoundError):
        status = os.lstat(path)
        is_plain = stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)
        if not is_plain and status.st_uid not in (0, os.geteuid()):
            raise NotPrivate(path, f"is a link, a pipe or a device of user {status.st_uid}")


def refuse_planted_above(path: str | os.PathLike[str]) -> None:
    """Raise `NotPrivate` if another account has made a link in place of a directory above a path."""
    path = os.path.abspath(path)
    while (above := os.path.dirname(path)) != path:
        refuse_planted(above)
        path = above


def open_output(path: str | os.PathLike[str]) -> int:
    """Open a file to write, emptied, and return its descriptor.

    Raises
    ------
    NotPrivate
        Another account has made a link, a pipe or a device of that name.
    OSError
        It cannot be opened.
    """
    refuse_planted(path)
    follow = 0 if os.path.islink(path) else os.O_NOFOLLOW
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | follow, 0o666)


def within(fd: int, name: str = "") -> str:
    """Return a path, valid in this process, of a directory held open, or of a name in it.

    Where the directory is, or what has its name now, is of no matter.
    """
    return os.path.join(f"/proc/self/fd/{fd}", name) if name else f"/proc/self/fd/{fd}"
