# SPDX-License-Identifier: Apache-2.0
"""Memory and processor time of processes as the kernel counts them.

*PSS* (proportional set size) divides every shared page among the processes that map it, so that
the PSS of several processes may be summed.  A page of shared memory that no process maps right now
is in no process's PSS, although it is in memory.  From ``/proc/PID/smaps_rollup`` and ``/proc/PID/stat``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

__all__ = ["ProcessMemory", "cpu_seconds", "descendants", "process_memory"]

_USER: Final = 11  # utime, stime, cutime, cstime follow one another: proc(5), counted after the command
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class ProcessMemory:
    """Memory of one process.

    Attributes
    ----------
    own_bytes
        Proportional set size without shared memory: interpreter, libraries (its share of them), heap.
    private_bytes
        Pages that no other process maps.
    """

    own_bytes: int
    private_bytes: int


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
        own_bytes=fields["Pss"] - fields.get("Pss_Shmem", 0),  # since Linux 5.9
        private_bytes=fields["Private_Clean"] + fields["Private_Dirty"],
    )


def cpu_seconds(pids: Iterable[int]) -> float:
    """Return the user and system time of processes, and of their children that have ended, seconds.

    Raises
    ------
    ProcessLookupError, FileNotFoundError
        One of them is gone.
    """
    ticks = 0
    for pid in pids:
        ticks += sum(int(field) for field in _stat(pid)[_USER : _USER + 4])
    return ticks / _TICKS_PER_S


def descendants(pid: int) -> list[int]:
    """Return ``pid`` and every living process below it, ascending."""
    children: dict[int, list[int]] = {}
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            state, parent = _stat(int(entry))[:2]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if state != "Z":
            children.setdefault(int(parent), []).append(int(entry))
    found, waiting = [], [pid]
    while waiting:
        current = waiting.pop()
        found.append(current)
        waiting.extend(children.get(current, ()))
    return sorted(found)


def _stat(pid: int) -> list[str]:
    """Return the fields after the command, which may hold blanks and brackets."""
    stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    return stat[stat.rindex(")") + 2 :].split()
