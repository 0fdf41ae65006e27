# SPDX-License-Identifier: Apache-2.0
"""Limits of the daemon's memory: shared for cells, private per loader, restricted by the control group.

Shared memory is charged to the control group of the process that wrote it first, even after that process has
ended.  Exceeding the limit raises no error: the kernel kills a process.  So the limit has to be known before.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from shmmap.errors import CannotStart, ConfigError
from shmmap.mounts import control_groups, group_values
from shmmap.segment.directory import ShmDirectory

DEFAULT_CEILING_BYTES: Final = 4 << 30
RESERVE_BYTES: Final = 256 << 20
SMALLEST_BYTES: Final = 1 << 20
LARGEST: Final = 1 << 62
LOADER_BYTES: Final = (2 << 30, 8 << 30)
"""Lower and upper bound of a loader's memory limit: a layer of the largest cell takes some 3 GiB."""


def _memory_bytes(which: str) -> int:
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith(f"{which}:"):
            return int(line.split()[1]) * 1024
    return DEFAULT_CEILING_BYTES


def loader_bytes(limit_bytes: int | None) -> int:
    """Return each loader's limit of private memory: a quarter of the machine's, from 2 to 8 GiB.

    Parameters
    ----------
    limit_bytes
        Memory limit of the control group; None for none.
    """
    total = _memory_bytes("MemTotal")
    least, most = LOADER_BYTES
    return min(max(least, min(total, limit_bytes or total) // 4), most)


def room_in_group(limit_bytes: int) -> int:
    """Return how much of a control group's memory segments may take: all but half, at most 256 MiB."""
    return limit_bytes - min(limit_bytes // 2, RESERVE_BYTES)


def usable_bytes(ours_bytes: int = 0) -> int:
    """Return the most bytes that are used by default: a quarter of the available memory.

    ``ours_bytes`` are those that a previous run of the daemon left in shared memory.
    """
    return (_memory_bytes("MemAvailable") + ours_bytes) // 4


def room_bytes(directory: ShmDirectory, ours_bytes: int = 0, limit_bytes: int | None = None) -> int:
    """Return the bytes of a file system that are used by default; arguments as of `choose_budget`."""
    size, free = directory.size_bytes(), directory.free_bytes() + ours_bytes
    group_room = room_in_group(limit_bytes) if limit_bytes is not None else LARGEST
    return min(free - min(size // 20, RESERVE_BYTES), group_room)


def choose_budget(
    asked_bytes: int,
    directory: ShmDirectory,
    *,
    ours_bytes: int = 0,
    beside_bytes: int = 0,
    limit_bytes: int | None = None,
) -> int:
    """Return the budget in bytes.

    An explicit budget that does not fit the file system or the control group is refused.  The default is a
    quarter of the available memory, at most 4 GiB.  It is less if the file system is small (5 % of it, at
    most 256 MiB, stay free) or the control group is (half of it, at most 256 MiB, is left to the processes
    themselves).

    Parameters
    ----------
    asked_bytes
        The explicit budget; 0 for the default.
    ours_bytes
        Bytes that a previous run of the daemon left in the directory: the daemon may keep or free them.
    beside_bytes
        Bytes of the file system that the default budget leaves to live maps.
    limit_bytes
        Memory limit of the control group; None for none.

    Raises
    ------
    ConfigError
        The explicit budget is larger than the file system or exceeds the control group's limit, or it is too
        small to be useful.
    CannotStart
        Too little memory is free.
    """
    size, free = directory.size_bytes(), directory.free_bytes() + ours_bytes
    if asked_bytes:
        if asked_bytes > size:
            raise ConfigError(
                f"a budget of {asked_bytes >> 20:,} MiB does not fit {directory.path}, which has"
                f" {size >> 20:,} MiB",
                key="budget",
                hint="lower --budget, or enlarge the tmpfs (docker: --shm-size)",
            )
        if asked_bytes > free:
            raise CannotStart(
                f"a budget of {asked_bytes >> 20:,} MiB does not fit {directory.path}, which has"
                f" {free >> 20:,} MiB free",
                hint="free some, lower --budget, or enlarge the tmpfs (docker: --shm-size)",
            )
        if limit_bytes is not None and asked_bytes > (group_room := room_in_group(limit_bytes)):
            raise ConfigError(
                f"a budget of {asked_bytes >> 20:,} MiB does not fit the control group's memory limit of"
                f" {limit_bytes >> 20:,} MiB, of which {limit_bytes - group_room >> 20:,} MiB are left to the"
                " processes",
                key="budget",
                hint="lower --budget, or raise the limit (systemd: MemoryMax=, docker: --memory)",
            )
        if asked_bytes < SMALLEST_BYTES:
            raise ConfigError(
                f"a budget of {asked_bytes} bytes is too small", key="budget", hint="use at least 1M"
            )
        return asked_bytes
    room = room_bytes(directory, ours_bytes, limit_bytes)
    budget = min(usable_bytes(ours_bytes), DEFAULT_CEILING_BYTES, room - beside_bytes)
    if budget < SMALLEST_BYTES:
        raise CannotStart(
            f"{directory.path} has only {free} bytes free",
            hint="free some, enlarge the tmpfs (docker: --shm-size), or name another --shm-dir",
        )
    return budget


_NO_LIMIT: Final = 1 << 60
"""Version 1 of control groups expresses "no limit" as the largest possible number of pages."""


def memory_limit_bytes(process: int | str = "self", root: str = "/") -> int | None:
    """Return the lowest memory limit of a process's control groups and their ancestors; None for none."""
    limits = [
        limit
        for groups in control_groups("memory", process, root)
        for name in ("memory.max", "memory.limit_in_bytes")
        for limit in group_values(groups, name)
    ]
    return min((limit for limit in limits if limit < _NO_LIMIT), default=None)


def out_of_memory_kills(vmstat: str = "/proc/vmstat") -> int:
    """Return how many processes the kernel has killed because memory ran out, anywhere on the machine."""
    with contextlib.suppress(OSError), open(vmstat, encoding="ascii") as file:
        return next((int(line.split()[1]) for line in file if line.startswith("oom_kill ")), 0)
    return 0
