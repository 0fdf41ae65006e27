# SPDX-License-Identifier: Apache-2.0
"""What processes cost, by the kernel's books."""

from __future__ import annotations

import os
from pathlib import Path


def proportional_bytes(pid: int) -> int:
    """Proportional set size of a process: its own pages, and its share of those it shares."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024
    raise AssertionError("no Pss")


def proportional_bytes_under(pid: int, directory: str) -> int:
    """The part of it that belongs to mappings of files in a directory."""
    total, inside = 0, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        first = line.split(maxsplit=1)[0]
        if not first.endswith(":"):
            inside = f" {directory}/" in line
        elif inside and first == "Pss:":
            total += int(line.split()[1]) * 1024
    return total


def resident_bytes(pid: int) -> int:
    """Memory that a process has now."""
    return _status_bytes(pid, "VmRSS")


def anonymous_bytes(pid: int) -> int:
    """Memory of its own that it has now; libraries, which other processes may share or not, are left out."""
    return _status_bytes(pid, "RssAnon")


def peak_bytes(pid: int) -> int:
    """Most memory that a process ever had."""
    return _status_bytes(pid, "VmHWM")


def _status_bytes(pid: int, name: str) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    raise AssertionError(f"no {name}")


def descriptors(pid: int) -> int:
    """How many files a process has open."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def mappings_under(path: str) -> int:
    """How many mappings of files below ``path`` this process has."""
    return sum(path in line for line in Path("/proc/self/maps").read_text().splitlines())
