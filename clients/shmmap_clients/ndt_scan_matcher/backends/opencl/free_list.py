# SPDX-License-Identifier: Apache-2.0
"""Which bytes of a buffer of fixed size are free: first fit, neighbours joined."""

from __future__ import annotations

from typing import Final

__all__ = ["ALIGNMENT", "FreeList", "rounded"]

ALIGNMENT: Final = 64


def rounded(nbytes: int) -> int:
    """Return how many bytes a block of ``nbytes`` takes."""
    return max(-(-nbytes // ALIGNMENT), 1) * ALIGNMENT


class FreeList:
    """Blocks of a buffer; an offset is a multiple of `ALIGNMENT`.

    Parameters
    ----------
    capacity
        Bytes of the buffer.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._free = [(0, capacity // ALIGNMENT * ALIGNMENT)]

    @property
    def free_bytes(self) -> int:
        """Bytes that are free, in however many pieces."""
        return sum(length for _, length in self._free)

    def take(self, nbytes: int) -> int | None:
        """Return the offset of a new block, or None where no free piece is large enough."""
        needed = rounded(nbytes)
        for index, (offset, length) in enumerate(self._free):
            if length >= needed:
                if length == needed:
                    del self._free[index]
                else:
                    self._free[index] = (offset + needed, length - needed)
                return offset
        return None

    def give(self, offset: int, nbytes: int) -> None:
        """Take a block back."""
        joined: list[tuple[int, int]] = []
        for start, length in sorted([*self._free, (offset, rounded(nbytes))]):
            if joined and sum(joined[-1]) == start:
                joined[-1] = (joined[-1][0], joined[-1][1] + length)
            else:
                joined.append((start, length))
        self._free = joined
