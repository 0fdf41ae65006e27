# SPDX-License-Identifier: Apache-2.0
"""Mounts and control groups, as this process sees them: proc_pid_mountinfo(5), cgroups(7).

``root`` is where the machine's files are; tests give another directory.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import Final, NamedTuple

REMOTE: Final = (
    *("nfs", "nfs4", "cifs", "smb3", "9p", "ceph", "lustre", "glusterfs", "afs"),
    *("fuse.sshfs", "fuse.glusterfs"),
)
"""Types of file systems that other machines change as well."""


class Mount(NamedTuple):
    """A mount: its file system type, that file system's mounted directory, the mount point, and options."""

    kind: str
    root: str
    point: str
    options: list[str]

    @property
    def huge_pages(self) -> str:
        """The option that puts all files of a tmpfs on huge pages; empty without one."""
        huge = next((option for option in self.options if option.startswith("huge=")), "")
        return "" if huge in ("huge=never", "huge=advise") else huge


def mounts(root: str = "/") -> Iterator[Mount]:
    """Yield every mount of this process, in order of mounting; none if they cannot be read."""
    for line in _lines(f"{root}/proc/self/mountinfo"):
        before, _, after = line.partition(" - ")
        fields, (kind, _source, options) = before.split(), after.split()[:3]
        point = re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), fields[4])
        yield Mount(kind, fields[3], point, options.split(","))


def mount_of(path: str, root: str = "/") -> Mount:
    """Return the mount that a path is on; of type ``unknown`` if the mounts cannot be read."""
    place = os.path.realpath(path)
    around = [mount for mount in mounts(root) if _is_in(place, mount.point)]
    return max(reversed(around), key=lambda mount: len(mount.point), default=Mount("unknown", "/", "/", []))


def control_groups(controller: str, process: int | str = "self", root: str = "/") -> Iterator[list[str]]:
    """Yield the directory of a process's control group and those of its ancestors, nearest first.

    Versions 1 and 2 of control groups are separate hierarchies; a process may be in a group of both.

    Parameters
    ----------
    controller
        What the groups limit: ``memory``, ``pids``.
    """
    groups: dict[str, str] = {}
    for line in _lines(f"{root}/proc/{process}/cgroup"):
        _number, controllers, group = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            groups["cgroup" if controllers else "cgroup2"] = group
    for mount in mounts(root):
        group = groups.get(mount.kind, "")
        if not group or (mount.kind == "cgroup" and controller not in mount.options):
            continue
        top = root.rstrip("/") + mount.point
        is_seen = _is_in(group, mount.root) and "/../" not in f"{group}/"  # not outside of our namespace
        places = [os.path.normpath(f"{top}/{os.path.relpath(group, mount.root)}") if is_seen else top]
        while places[-1] != top:
            places.append(os.path.dirname(places[-1]))
        yield places


def group_values(groups: list[str], name: str) -> list[int]:
    """Return the numbers in a file of control groups, without those where it is missing or ``max``."""
    return [int(line) for group in groups for line in _lines(f"{group}/{name}") if line.isdecimal()]


def _is_in(path: str, directory: str) -> bool:
    return f"{path}/".startswith(f"{directory.rstrip('/')}/")


def _lines(path: str) -> list[str]:
    """Return the lines of a file; none if it cannot be read."""
    try:
        with open(path, encoding="utf-8", errors="surrogateescape") as file:
            return file.read().splitlines()
    except OSError:
        return []
