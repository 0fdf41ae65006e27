# SPDX-License-Identifier: Apache-2.0
"""A small table of the statistics segment, as its writer keeps it: only what changed is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

__all__ = ["RowTable"]

_Row = TypeVar("_Row")

PAGE_BYTES = 4096


class RowTable(Generic[_Row]):
    """Rows of equal length at one place; memory for them is allocated a page at a time, as they come.

    Parameters
    ----------
    place, row_bytes, most
        Where the table is, how long a row is, and how many there can be.
    pack
        Makes of a row its bytes.
    write
        Writes bytes at a place; False if that cannot be done.
    allocate
        Has memory at a place, for so many bytes; False if there is none.
    allocated
        Rows for which there is memory from the start.

    Attributes
    ----------
    used : int
        Rows to look at.
    """

    def __init__(
        self,
        place: int,
        row_bytes: int,
        most: int,
        pack: Callable[[_Row], bytes],
        write: Callable[[bytes, int], bool],
        allocate: Callable[[int, int], bool],
        *,
        allocated: int = 0,
    ) -> None:
        self.used = 0
        self._place = place
        self._row_bytes = row_bytes
        self._most = most
        self._pack = pack
        self._write = write
        self._allocate = allocate
        self._allocated = allocated
        self._rows: list[_Row | None] = []

    def show(self, rows: Sequence[_Row]) -> None:
        """Have these rows in the table, the first of them if there is no room for all."""
        count = min(len(rows), self._room_for(min(len(rows), self._most)))
        self._rows += [None] * (count - len(self._rows))
        self.used = 0
        for index, row in enumerate(rows[:count]):
            place = self._place + index * self._row_bytes
            if self._rows[index] != row and not self._write(self._pack(row), place):
                break
            self._rows[index] = row
            self.used += 1

    def _room_for(self, wanted: int) -> int:
        while self._allocated < wanted:
            start = self._place + self._allocated * self._row_bytes
            if not self._allocate(start, PAGE_BYTES):
                break
            self._allocated += PAGE_BYTES // self._row_bytes
        return self._allocated
