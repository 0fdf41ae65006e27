# SPDX-License-Identifier: Apache-2.0
"""What has to be in place before the daemon can serve."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import resource
from pathlib import Path
from typing import Final

from shmmap.daemon.config import DaemonConfig
from shmmap.daemon.host.groups import account_name, group_id
from shmmap.daemon.pins.probe import PinSource, probe_pins
from shmmap.daemon.pins.watch import PinWatch
from shmmap.errors import CannotStart, ConfigError
from shmmap.logfmt import log
from shmmap.processes.limits import file_size_limit
from shmmap.protocol.endpoint import fallback_runtime_dir, why_not_private
from shmmap.segment.directory import ShmDirectory

__all__ = [
    "access_of_segments",
    "check_file_size_limit",
    "choose_pins",
    "give_back_large_tables",
    "import_ahead",
    "make_runtime_dir",
    "raise_descriptor_limit",
]

_M_MMAP_THRESHOLD: Final = -3
_LARGE_BYTES: Final = 1 << 20


def raise_descriptor_limit() -> None:
    """A session takes two descriptors; the customary limit of 1024 would end at 500 clients."""
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def give_back_large_tables() -> None:
    """Let large memory go back to the kernel when it is freed.

    After the first table of a large map, glibc would keep what others leave: 30 MB of a million cells.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BYTES)


def import_ahead() -> None:
    """Import what numpy would import when `np.unique` is first called: 12 ms, in the serving loop."""
    importlib.import_module("numpy.ma")


def access_of_segments(config: DaemonConfig) -> tuple[int, int]:
    """Group id and mode of what readers open; -1 and owner-only without a group.

    Raises
    ------
    ConfigError
        There is no such group, or this user may give it nothing.
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
    """Say which segments a limit on the size of files will refuse."""
    limit = file_size_limit()
    if limit is not None and limit < budget_bytes:
        log.warning(
            "files are limited in size", RLIMIT_FSIZE=limit, budget_bytes=budget_bytes,
            hint="larger segments will be refused: ulimit -f, LimitFSIZE=",
        )  # fmt: skip


def make_runtime_dir(path: Path, gid: int) -> None:
    """Make the directory of the socket, for the owner and, where there is one, the group.

    Raises
    ------
    CannotStart
        It cannot be made, or in /tmp somebody else has made it.
    """
    if str(path) == fallback_runtime_dir():
        _make_private(path)
        return
    if path.is_dir():
        return
    try:
        path.mkdir(mode=0o750 if gid >= 0 else 0o700, parents=True, exist_ok=True)
        if gid >= 0:
            os.chown(path, -1, gid)
    except OSError as error:
        raise CannotStart(
            f"runtime directory {path}: {error.strerror}", hint="make it, or give another --runtime-dir"
        ) from error


def _make_private(path: Path) -> None:
    """Make the directory in /tmp that is used without ``XDG_RUNTIME_DIR``, for the owner alone."""
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    if why := why_not_private(str(path)):
        raise CannotStart(
            f"runtime directory {path}: {why}",
            hint="see whose it is and remove it, or set XDG_RUNTIME_DIR, or give --runtime-dir",
        )
    log.info("runtime directory", path=path, reason="XDG_RUNTIME_DIR is not set")


def choose_pins(directory: ShmDirectory) -> PinWatch:
    """Find out how well this machine tells who uses a segment, and say so."""
    support = probe_pins(directory)
    if support.source is not PinSource.LEASES:
        log.warning("shm directory grants no leases", shm_dir=directory.path, hint="shmmap doctor")
    log.info("use of segments is detected", by=support.source.value)
    return PinWatch(
        directory, support.source, events=support.close_events and support.source is not PinSource.SESSIONS
    )
