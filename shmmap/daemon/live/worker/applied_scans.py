# SPDX-License-Identifier: Apache-2.0
"""Up to which scan of each mapper a map has taken everything in, in memory that outlives the worker.

A program that plays scans from files goes on after the last of these.  What is noted is never more than what
is in the map; of what comes again nothing counts twice, whatever is noted.
"""

from __future__ import annotations

import mmap
from collections.abc import Collection
from typing import Final

import numpy as np

from shmmap.chunks.layout import MAPPERS

__all__ = ["APPLIED_BYTES", "AppliedScans"]

_ROW: Final = np.dtype([("mapper", "<u8"), ("scan", "<u8")])
APPLIED_BYTES: Final = _ROW.itemsize * MAPPERS


class AppliedScans:
    """A table of mappers.

    Parameters
    ----------
    memory
        `APPLIED_BYTES`, at first zeros.
    """

    def __init__(self, memory: bytearray | mmap.mmap) -> None:
        self._rows = np.frombuffer(memory, _ROW, MAPPERS)

    def of(self, mapper: int) -> int:
        """The scan up to which all are in the map; 0 where nothing is known."""
        found = np.flatnonzero(self._rows["mapper"] == mapper)
        return int(self._rows["scan"][found[0]]) if len(found) else 0

    def note(self, mapper: int, scan: int, known: Collection[int]) -> None:
        """All scans of a mapper up to this one are in the map; those not ``known`` any more give way."""
        found = np.flatnonzero(self._rows["mapper"] == mapper)
        if not len(found):
            numbers = self._rows["mapper"].tolist()
            at = next((at for at, number in enumerate(numbers) if number not in known), None)
            if at is None:
                return  # nothing is lost: it is only not known from where on to play again
            self._rows["scan"][at] = 0  # a kill between these is to leave no other mapper's number
            self._rows["mapper"][at] = mapper
            found = np.array([at])
        self._rows["scan"][found[0]] = scan
