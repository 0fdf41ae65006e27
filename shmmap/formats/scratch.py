# SPDX-License-Identifier: Apache-2.0
"""Buffers that outlive one file.

Cells are small and many: fresh buffers for each would cost more in page faults than the reading
itself.  A reader borrows, and gives back when it is done.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Scratch", "borrow_scratch"]

_KEPT_BYTES: Final = 16 << 20  # larger sets of buffers are not kept
_FIRST_BYTES: Final = 4 << 20  # from here on numpy asks for huge pages; only what is touched counts
_ALIGNMENT_BYTES: Final = 64
_idle: list[Scratch] = []


class Scratch:
    """One growing buffer, cut into arrays; a cut stays valid until the next `cut`."""

    def __init__(self) -> None:
        self._memory: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._start = 0

    def __enter__(self) -> Scratch:
        return self

    def __exit__(self, *_: object) -> None:
        if not _idle and self.nbytes <= _KEPT_BYTES:
            _idle.append(self)

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._memory.nbytes

    def cut(self, *shapes: tuple[tuple[int, ...], np.dtype[Any]]) -> tuple[NDArray[Any], ...]:
        """Return one uninitialised C-contiguous array per (shape, dtype)."""
        sizes = [math.prod(shape) * dtype.itemsize for shape, dtype in shapes]
        steps = [-(-size // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES for size in sizes]
        needed = sum(steps) + _ALIGNMENT_BYTES
        if len(self._memory) < needed:
            self._memory = np.empty(max(needed, _FIRST_BYTES), np.uint8)
            self._start = -self._memory.ctypes.data % _ALIGNMENT_BYTES
        at = self._start
        arrays: list[NDArray[Any]] = []
        for (shape, dtype), size, step in zip(shapes, sizes, steps, strict=True):
            arrays.append(self._memory[at : at + size].view(dtype).reshape(shape))
            at += step
        return tuple(arrays)


def borrow_scratch() -> Scratch:
    """Return a `Scratch` that nobody else uses inside its ``with``; at most one idle one is kept."""
    try:
        return _idle.pop()
    except IndexError:
        return Scratch()
