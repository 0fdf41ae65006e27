# SPDX-License-Identifier: Apache-2.0
"""Which bytes of a buffer of fixed size are free: first fit, neighbours joined."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
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

    def take_all(self, sizes: Sequence[int]) -> list[int] | None:
        """Return the offsets of new blocks, side by side where there is room; None, and no block, else."""
        lengths = list(map(rounded, sizes))
        first = self.take(sum(lengths)) if lengths else 0
        if first is not None:
            return [first + end - length for end, length in zip(accumulate(lengths), lengths, strict=True)]
        found: list[int] = []
        for nbytes in sizes:
            offset = self.take(nbytes)
            if offset is None:
                for taken, length in zip(found, lengths, strict=False):
                    self.give(taken, length)
                return None
            found.append(offset)
        return found

    def give(self, offset: int, nbytes: int) -> None:
        """Take a block back."""
        joined: list[tuple[int, int]] = []
        for start, length in sorted([*self._free, (offset, rounded(nbytes))]):
            if joined and sum(joined[-1]) == start:
                joined[-1] = (joined[-1][0], joined[-1][1] + length)
            else:
                joined.append((start, length))
        self._free = joined
