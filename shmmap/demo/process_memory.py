# SPDX-License-Identifier: Apache-2.0
"""Memory of processes as the kernel counts it, from ``/proc/PID/smaps_rollup``.

*PSS* (proportional set size) divides every shared page among the processes that map it, so that
the PSS of several processes may be summed.  A page of shared memory that no process maps right now
is in nobody's PSS, although it is in memory.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ProcessMemory", "descendants", "process_memory", "sum_memory"]


@dataclass(frozen=True, slots=True)
class ProcessMemory:
    """Memory of one process, or of several summed.

    Attributes
    ----------
    pss_bytes
        Proportional set size.
    pss_shm_bytes
        The part of it in POSIX shared memory and other tmpfs files.
    private_bytes
        Pages that no other process maps.
    """

    pss_bytes: int
    pss_shm_bytes: int
    private_bytes: int

    @property
    def own_bytes(self) -> int:
        """Everything but shared memory: interpreter, libraries (its share of them), heap."""
        return self.pss_bytes - self.pss_shm_bytes


def process_memory(pid: int) -> ProcessMemory:
    """Read the memory of one process.

    Raises
    ------
    ProcessLookupError, FileNotFoundError
        It is gone.
    PermissionError
        It belongs to another user.
    """
    fields: dict[str, int] = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()[1:]:
        name, value = line.split(":")
        fields[name] = int(value.split()[0]) * 1024
    return ProcessMemory(
        pss_bytes=fields["Pss"],
        pss_shm_bytes=fields.get("Pss_Shmem", 0),  # since Linux 5.9
        private_bytes=fields["Private_Clean"] + fields["Private_Dirty"],
    )


def sum_memory(pids: Iterable[int]) -> ProcessMemory:
    """Sum the memory of several processes, read one after the other."""
    parts = [process_memory(pid) for pid in pids]
    return ProcessMemory(
        pss_bytes=sum(part.pss_bytes for part in parts),
        pss_shm_bytes=sum(part.pss_shm_bytes for part in parts),
        private_bytes=sum(part.private_bytes for part in parts),
    )


def descendants(pid: int) -> list[int]:
    """Return ``pid`` and every living process below it, ascending."""
    children: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        try:
            stat = Path(f"/proc/{entry}/stat").read_text(encoding="utf-8", errors="replace")
        except (FileNotFoundError, ProcessLookupError):
            continue
        state, parent = stat[stat.rindex(")") + 2 :].split(maxsplit=2)[:2]
        if state != "Z":
            children.setdefault(int(parent), []).append(int(entry))
    found, waiting = [], [pid]
    while waiting:
        current = waiting.pop()
        found.append(current)
        waiting.extend(children.get(current, ()))
    return sorted(found)
