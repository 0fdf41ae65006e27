# SPDX-License-Identifier: Apache-2.0
"""What processes cost in memory, by the kernel's books."""

from __future__ import annotations

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
