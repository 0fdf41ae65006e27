# SPDX-License-Identifier: Apache-2.0
"""Tables as long as a map of which only some rows are ever written, all over the table.

numpy asks for huge pages for large arrays: then the first write to any row has the kernel clear 2 MB, which
takes up to a millisecond of whoever writes, and a few thousand rows make the whole table resident.
"""

from __future__ import annotations

import contextlib
import math
import mmap
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["sparse_zeros"]

SMALL_BYTES: Final = 1 << 21
"""For less numpy does not ask for huge pages, and no other memory is worth a mapping."""


def sparse_zeros(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array of zeros that takes memory by small pages, as it is written."""
    nbytes = math.prod(shape if isinstance(shape, tuple) else (shape,)) * np.dtype(dtype).itemsize
    if nbytes < SMALL_BYTES:
        return np.zeros(shape, dtype)
    memory = mmap.mmap(-1, nbytes, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without huge pages
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype).reshape(shape)
