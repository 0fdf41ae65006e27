# SPDX-License-Identifier: Apache-2.0
"""Memory of a state of the map that is served no more.

Of ten million cells the stamps alone take 240 MB.  Where there are no huge pages it takes the kernel 20 ms to
take them back, of whoever drops them last: here that is a thread, which does not hold the interpreter
meanwhile.  Requests that began before still ask the old state for ids; so its names stay until the last of
them has followed.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import threading
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.origin.catalogue_change import Tables

__all__ = ["give_back", "give_back_apart"]

_MADV_DONTNEED: Final = 4
LARGE_BYTES: Final = 1 << 22
"""What is smaller is taken back in less than a millisecond by whoever drops it."""


def give_back_apart(old: Tables | None, new: Tables | None) -> None:
    """Have a thread `give_back` what a new state of the map does not share with the old one."""
    if old is None or new is None or old is new or old.stamps.nbytes < LARGE_BYTES:
        return
    with contextlib.suppress(RuntimeError):  # as many threads as there may be: then it takes its time
        threading.Thread(target=give_back, args=(old, new), name="giving back", daemon=True).start()


def give_back(old: Tables, new: Tables) -> None:
    """Give back the memory of the old state's stamps, and of its boxes unless the new one has them, too.

    They read as zeros from then on.
    """
    for table, now in ((old.stamps, new.stamps), (old.boxes, new.boxes)):
        if not np.may_share_memory(table, now):
            _give_back(table)


def _give_back(table: NDArray[Any]) -> None:
    """Give back the whole pages of an array."""
    page = mmap.PAGESIZE
    begin = -(-table.ctypes.data // page) * page
    end = (table.ctypes.data + table.nbytes) // page * page
    if end > begin and (table.flags.c_contiguous or table.flags.f_contiguous):
        ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)
