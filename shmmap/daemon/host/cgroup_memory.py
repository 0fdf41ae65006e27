# SPDX-License-Identifier: Apache-2.0
"""The memory limit of the control group that this process lives in, versions 1 and 2 (cgroups(7)).

Shared memory counts for the group of whoever wrote it first, and stays charged when that process
ends.  Beyond the limit there is no error: the kernel kills.  So the limit has to be known beforehand.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from shmmap.daemon.host.mounts import mounts

__all__ = ["memory_limit_bytes", "out_of_memory_kills"]

_NO_LIMIT: Final = 1 << 60
"""Version 1 says "none" with the largest number of pages there is."""
_FILES: Final = {"cgroup2": "memory.max", "cgroup": "memory.limit_in_bytes"}


def memory_limit_bytes(proc: str = "/proc/self") -> int | None:
    """Return the lowest memory limit of this process's group and the groups around it; None for none.

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
    """Return how many processes the kernel has killed for lack of memory, the machine's or a group's."""
    return next((int(line.split()[1]) for line in _lines(Path(vmstat)) if line.startswith("oom_kill ")), 0)


def _groups(path: Path) -> dict[str, str]:
    """Per kind of hierarchy, the group of the process."""
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
    """Lines of a file; none where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return []
