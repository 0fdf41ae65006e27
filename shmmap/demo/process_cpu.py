# SPDX-License-Identifier: Apache-2.0
"""Processor time of processes as the kernel counts it, from ``/proc/PID/stat``."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Final

__all__ = ["cpu_seconds"]

_USER: Final = 11  # utime, stime, cutime, cstime follow one another: proc(5), counted after the command
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pids: Iterable[int]) -> float:
    """Return the user and system time of processes, and of their children that have ended, seconds.

    Raises
    ------
    ProcessLookupError, FileNotFoundError
        One of them is gone.
    """
    ticks = 0
    for pid in pids:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        ticks += sum(int(field) for field in stat[stat.rindex(")") + 2 :].split()[_USER : _USER + 4])
    return ticks / _TICKS_PER_S
