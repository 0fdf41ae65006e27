# SPDX-License-Identifier: Apache-2.0
"""The daemon's change counter, read in its statistics segment without asking anybody."""

from __future__ import annotations

import ctypes
import os
import stat
from typing import Final

from shmmap.errors import SegmentError
from shmmap.segment.attach import map_file
from shmmap.segment.owned import Owned
from shmmap.statistics.layout import CHANGES, unpack_header

__all__ = ["ChangeCounter"]

_FLAGS: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_HEADER_BYTES: Final = 65536


class ChangeCounter:
    """Counts how often the map of one life of the daemon became another one.

    Parameters
    ----------
    path
        Of the statistics segment.

    Attributes
    ----------
    epoch : int
        Whose it is.

    Raises
    ------
    OSError, SegmentError
        It cannot be read, or has no such counter.
    """

    def __init__(self, path: str) -> None:
        file = Owned(zip(map(os.open, (path,), (_FLAGS,))), os.close)
        try:
            status = os.fstat(file.value)
            if not stat.S_ISREG(status.st_mode):
                raise SegmentError(f"{path} is no regular file: no daemon made it")
            offset = unpack_header(os.pread(file.value, _HEADER_BYTES, 0)).changes_offset
            if not 0 < offset <= status.st_size - CHANGES.size:
                raise SegmentError(f"{path} has no change counter", hint="update the daemon")
            self._memory = map_file(file.value, offset + CHANGES.size)
        finally:
            file.give_back()
        self._numbers = (ctypes.c_uint64 * 2).from_address(self._memory.value + offset)
        self.epoch: int = self._numbers[0]

    def read(self) -> int:
        """Return the count as it is now."""
        count: int = self._numbers[1]
        return count
