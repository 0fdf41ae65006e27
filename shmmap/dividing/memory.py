# SPDX-License-Identifier: Apache-2.0
"""How much memory is left under a limit that counts the whole process."""

from __future__ import annotations

import os
from typing import Final

__all__ = ["MIN_MEMORY_BYTES", "memory_left", "peak_memory_bytes"]

MIN_MEMORY_BYTES: Final = 384 << 20
"""The smallest limit that makes sense: Python, numpy, numba and its compiler take 200 MiB."""

_SPARE_BYTES: Final = 96 << 20  # what the compiler, the decompressors and the tables of cells come to take


def memory_left(limit_bytes: int) -> int:
    """Bytes that this process may still take under ``limit_bytes``, with some to spare."""
    with open("/proc/self/statm", "rb") as file:
        resident = int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    return max(32 << 20, limit_bytes - resident - _SPARE_BYTES)


def peak_memory_bytes() -> int:
    """Most memory that this program ever had resident.

    From ``VmHWM``: ``ru_maxrss`` would begin with the memory of whoever started the process.
    """
    with open("/proc/self/status", "rb") as file:
        for line in file:
            if line.startswith(b"VmHWM:"):
                return int(line.split()[1]) << 10
    raise OSError("/proc/self/status has no VmHWM")
