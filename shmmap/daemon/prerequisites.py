# SPDX-License-Identifier: Apache-2.0
"""Prerequisites of serving: limits, groups, and a way to detect segments in use."""

from __future__ import annotations

import ctypes
import grp
import os
import pwd
import resource
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.pins.probe import PinSource, probe_pins
from shmmap.daemon.pins.watch import PinWatch
from shmmap.errors import ConfigError
from shmmap.logfmt import log
from shmmap.segment.directory import ShmDirectory
from shmmap.segment.process_limits import file_size_limit

_M_MMAP_THRESHOLD: Final = -3
_LARGE_BYTES: Final = 1 << 20


def raise_descriptor_limit() -> None:
    """Raise the limit of descriptors to its maximum: a session takes two, and the usual limit is 1024."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def give_back_large_tables() -> None:
    """Return large memory blocks to the kernel when they are freed.

    After the first table of a large map, glibc would keep freed memory: 30 MB for a million cells.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def import_ahead() -> None:
    """Import modules that numpy imports at the first `np.unique`, which takes 12 ms, before the loop runs."""
    import numpy.ma  # noqa: F401


def access_of_segments(config: DaemonConfig) -> tuple[int, int]:
    """Return group id and mode of the files that readers open; -1 and owner-only without a group.

    Raises
    ------
    ConfigError
        The group does not exist, or this user may not assign files to it.
    """
    if not config.group:
        return -1, 0o400
    gid = group_id(config.group, "group")
    if os.geteuid() != 0 and gid not in (os.getegid(), *os.getgroups()):
        user = account_name(os.geteuid())
        raise ConfigError(
            f"{user} is no member of the group {config.group}, and cannot let it read",
            key="group",
            hint=f"sudo usermod -aG {config.group} {user}, then log in again (or `newgrp {config.group}`)",
        )
    return gid, 0o440


def check_file_size_limit(budget_bytes: int) -> None:
    """Warn if the file size limit is lower than some segments."""
    limit = file_size_limit()
    if limit is not None and limit < budget_bytes:
        log.warning(
            "files are limited in size",
            RLIMIT_FSIZE=limit,
            budget_bytes=budget_bytes,
            hint="larger segments will be refused: ulimit -f, LimitFSIZE=",
        )


def choose_pins(directory: ShmDirectory) -> PinWatch:
    """Determine how this machine shows which segments are in use, and log it."""
    support = probe_pins(directory)
    if support.source is not PinSource.LEASES:
        log.warning("shm directory grants no leases", shm_dir=directory.path, hint="shmmap doctor")
    log.info("in-use detection", by=support.source.value)
    return PinWatch(
        directory, support.source, events=support.close_events and support.source is not PinSource.SESSIONS
    )


def account_name(uid: int) -> str:
    """Return a user's name, or the number of a user without a name."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def group_id(name: str, key: str) -> int:
    """Return the id of a group given by name or number; ``key`` is the setting that contains it.

    Raises
    ------
    ConfigError
        The group does not exist.
    """
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        if name.isdigit():
            return int(name)
        raise ConfigError(f"there is no group {name!r}", key=key, hint=f"groupadd --system {name}") from None
