# SPDX-License-Identifier: Apache-2.0
"""What hinders the daemon from having a name: what lies there, whose it is, and what to do.

In /dev/shm and /tmp everybody may make files, and only who made one (or root) can remove it.
"""

from __future__ import annotations

import os
import pwd
import shlex
import stat
from typing import Final

from shmmap.errors import CannotStart

__all__ = ["name_taken"]

_KINDS: Final = {
    stat.S_IFREG: "file",
    stat.S_IFDIR: "directory",
    stat.S_IFLNK: "symbolic link",
    stat.S_IFIFO: "pipe",
    stat.S_IFSOCK: "socket",
}


def name_taken(what: str, path: str, error: OSError | None, *, otherwise: str) -> CannotStart:
    """Return the error that says why ``path`` cannot be ours.

    Parameters
    ----------
    what
        What should have been there: "the lock file".
    error
        What the kernel said; None where it let us, but what lies there is not ours.
    otherwise
        What else can be done than removing it: "choose another --instance".
    """
    try:
        status = os.lstat(path)
    except OSError:  # nothing is there: it is the place itself
        return CannotStart(f"{what} cannot be {path}: {_reason(error)}", hint=otherwise)
    kind = _KINDS.get(stat.S_IFMT(status.st_mode), "device")
    why = f" ({_reason(error)})" if error is not None else ""
    remove = "rm -r" if kind == "directory" else "rm"
    return CannotStart(
        f"{what} cannot be {path}: there is a {kind} of {_account(status.st_uid)}{why}",
        hint=f"see whose it is and remove it: `sudo {remove} {shlex.quote(path)}`; or {otherwise}",
    )


def _reason(error: OSError | None) -> str:
    return (error.strerror or str(error)) if error is not None else "unknown"


def _account(uid: int) -> str:
    try:
        return f"user {pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"uid {uid}"
