# SPDX-License-Identifier: Apache-2.0
"""Names in the shared-memory directory, and the error if another file has such a name.

``/shmmap.<instance>.<unique>`` is a published segment; ``<unique>`` is 64 random bits, chosen by the daemon
and never used again.  ``/shmmap.<instance>.<unique>.zombie`` is the same segment after it was retired: new
readers cannot find it, present readers keep it.  ``/shmmap.<instance>.statistics`` is the only name that
follows from the instance alone.

In /dev/shm and /tmp any account may create files, and only a file's owner (or root) can remove it.
"""

from __future__ import annotations

import os
import re
import stat
from typing import Final

from shmmap.errors import CannotStart, ConfigError

DEFAULT_SHM_DIR: Final = "/dev/shm"  # noqa: S108
"""Where ``shm_open`` puts segments on Linux."""
HUGE_PAGES_DIR: Final = "/run/shmmap_huge"
"""Where ``shmmap unit install --huge-pages`` mounts a tmpfs."""

_INSTANCE: Final = re.compile(r"[A-Za-z0-9_-]{1,64}")
_RETIRED: Final = ".zombie"


def check_instance(instance: str) -> str:
    """Return ``instance``, or raise `ConfigError` if it cannot be part of a name."""
    if not _INSTANCE.fullmatch(instance):
        raise ConfigError(
            f"instance name {instance!r} is not usable",
            key="instance",
            hint="use 1 to 64 letters, digits, '-' or '_'",
        )
    return instance


def segment_prefix(instance: str) -> str:
    """Return the prefix of all names of this instance, slash included."""
    return f"/shmmap.{instance}."


def statistics_name(instance: str) -> str:
    """Return the name of the instance's statistics segment."""
    return f"/shmmap.{instance}.statistics"


def usual_directory(instance: str, places: tuple[str, str] = (DEFAULT_SHM_DIR, HUGE_PAGES_DIR)) -> str:
    """Return the instance's default directory: /dev/shm, or the one on huge pages."""
    plain, huge = places
    if os.path.exists(plain + statistics_name(instance)) or not os.path.ismount(huge):
        return plain
    return huge


def new_segment_name(instance: str) -> str:
    """Return a name that was never used before."""
    return f"/shmmap.{instance}.{os.urandom(8).hex()}"


def another_name(name: str) -> str:
    """Return a name of the same instance as ``name`` that was never used before."""
    return f"{name.rpartition('.')[0]}.{os.urandom(8).hex()}"


def retired_name(name: str) -> str:
    """Return the name a segment gets when it is retired."""
    return name + _RETIRED


def is_retired(name: str) -> bool:
    """Return whether ``name`` is that of a retired segment."""
    return name.endswith(_RETIRED)


_KINDS: Final = {
    stat.S_IFREG: "file",
    stat.S_IFDIR: "directory",
    stat.S_IFLNK: "symbolic link",
    stat.S_IFIFO: "pipe",
    stat.S_IFSOCK: "socket",
}


def name_taken(what: str, path: str, error: OSError | None, *, otherwise: str) -> CannotStart:
    """Return the error for a ``path`` that the daemon cannot use.

    Parameters
    ----------
    what
        Purpose of the path: "the lock file".
    error
        The kernel's error; None if there was none, but the existing file is not the daemon's.
    otherwise
        Alternative to removing the file: "choose another --instance".
    """
    import shlex  # clients create no names

    try:
        status = os.lstat(path)
    except OSError:  # the file does not exist: the directory is the problem
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
    import pwd

    try:
        return f"user {pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"uid {uid}"
