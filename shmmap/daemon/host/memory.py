# SPDX-License-Identifier: Apache-2.0
"""Limits of the daemon's memory: shared for cells, private per loader, restricted by the control group.

Mounts (proc_pid_mountinfo(5)) show where control groups are, and which file system a path is on.

Shared memory is charged to the control group of the process that wrote it first, even after that process has
ended.  Exceeding the limit raises no error: the kernel kills a process.  So the limit has to be known before.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from shmmap.errors import CannotStart, ConfigError
from shmmap.segment.directory import ShmDirectory

__all__ = [
    "Mount",
    "choose_budget",
    "loader_bytes",
    "memory_limit_bytes",
    "mount_of",
    "mounts",
    "out_of_memory_kills",
    "room_in_group",
]

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
    group_room = room_in_group(limit_bytes) if limit_bytes is not None else LARGEST
    room = min(free - min(size // 20, RESERVE_BYTES), group_room)
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
        if limit_bytes is not None and asked_bytes > group_room:
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
    available_bytes = (_memory_bytes("MemAvailable") + ours_bytes) // 4
    budget = min(available_bytes, DEFAULT_CEILING_BYTES, room - beside_bytes)
    if budget < SMALLEST_BYTES:
        raise CannotStart(
            f"{directory.path} has only {free} bytes free",
            hint="free some, enlarge the tmpfs (docker: --shm-size), or name another --shm-dir",
        )
    return budget


_NO_LIMIT: Final = 1 << 60
"""Version 1 expresses "no limit" as the largest possible number of pages."""
_FILES: Final = {"cgroup2": "memory.max", "cgroup": "memory.limit_in_bytes"}


def memory_limit_bytes(proc: str = "/proc/self") -> int | None:
    """Return the lowest memory limit of this process's control group and its ancestors; None for none.

    Covers versions 1 and 2 of control groups (cgroups(7)).

    Parameters
    ----------
    proc
        Directory with ``cgroup`` and ``mountinfo`` of the process.
    """
    groups = _groups(Path(proc, "cgroup"))
    limits: list[int] = []
    for kind, root, mount, options in mounts(f"{proc}/mountinfo"):
        group = groups.get(kind)
        if group is None or (kind == "cgroup" and "memory" not in options):
            continue
        inside = os.path.relpath(group, root) if _is_below(group, root) else "."
        place = Path(mount, inside)
        while True:
            limits += [int(line) for line in _lines(place / _FILES[kind]) if line.isdecimal()]
            if place == Path(mount):
                break
            place = place.parent
    return min((limit for limit in limits if limit < _NO_LIMIT), default=None)


def out_of_memory_kills(vmstat: str = "/proc/vmstat") -> int:
    """Return how many processes the kernel has killed because memory ran out, anywhere on the machine."""
    return next((int(line.split()[1]) for line in _lines(Path(vmstat)) if line.startswith("oom_kill ")), 0)


def _groups(path: Path) -> dict[str, str]:
    """Return the control group of the process, by hierarchy."""
    found: dict[str, str] = {}
    for line in _lines(path):
        _number, controllers, group = line.split(":", 2)
        if not controllers:
            found["cgroup2"] = group
        elif "memory" in controllers.split(","):
            found["cgroup"] = group
    return found


def _is_below(group: str, root: str) -> bool:
    return group == root or group.startswith(root.rstrip("/") + "/")


def _lines(path: Path) -> list[str]:
    """Return the lines of a file; none if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return []


class Mount(NamedTuple):
    """A mount: its file system type, that file system's mounted directory, the mount point, and options."""

    kind: str
    root: str
    point: str
    options: list[str]


def mounts(path: str = "/proc/self/mountinfo") -> Iterator[Mount]:
    """Yield every mount of a process, in order of mounting; none if they cannot be read."""
    with contextlib.suppress(OSError), open(path, encoding="utf-8", errors="surrogateescape") as file:
        for line in file:
            before, _, after = line.partition(" - ")
            fields, (kind, _source, options) = before.split(), after.split()[:3]
            point = re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), fields[4])
            yield Mount(kind, fields[3], point, options.split(","))


def mount_of(path: str) -> Mount | None:
    """Return the mount that a path is on; None if unknown."""
    below = os.path.realpath(path) + "/"
    around = [mount for mount in mounts() if below.startswith(mount.point.rstrip("/") + "/")]
    return max(reversed(around), key=lambda mount: len(mount.point), default=None)
