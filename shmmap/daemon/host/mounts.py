# SPDX-License-Identifier: Apache-2.0
"""What is mounted where (proc_pid_mountinfo(5))."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from typing import NamedTuple

__all__ = ["Mount", "file_system_of", "mounts"]


class Mount(NamedTuple):
    """A mount: the type of its file system, the directory of it that is mounted, where, and its options."""

    kind: str
    root: str
    point: str
    options: list[str]


def mounts(path: str = "/proc/self/mountinfo") -> Iterator[Mount]:
    """Give every mount of a process, in the order made; none where they are not told."""
    with contextlib.suppress(OSError), open(path, encoding="utf-8", errors="surrogateescape") as file:
        for line in file:
            before, _, after = line.partition(" - ")
            fields, (kind, _source, options) = before.split(), after.split()[:3]
            point = re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), fields[4])
            yield Mount(kind, fields[3], point, options.split(","))


def file_system_of(path: str) -> str:
    """Return the type of the file system a path is on, empty where that is not told."""
    below = os.path.realpath(path) + "/"
    around = [mount for mount in mounts() if below.startswith(mount.point.rstrip("/") + "/")]
    return max(reversed(around), key=lambda mount: len(mount.point)).kind if around else ""
