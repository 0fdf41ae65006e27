# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels that apply marks to the voxels of a chunk."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import int16, int64, types, uint16, uint64
from numba.cpython.unsafe import numbers
from numba.extending import intrinsic

from shmmap.chunks.voxels import BRICK_VOXELS
from shmmap.compiling import compiled, read_only

_ONE: Final = np.uint64(1)
_trailing_zeros: Any = numbers.trailing_zeros


@compiled(types.int64(read_only(uint16, 1), read_only(uint16, 1), uint16[::1]), brief=True)
def touched_bricks(index: Any, words: Any, touched: Any) -> Any:
    """Find the bricks that contain the given words.

    ``touched``, (1024,), receives the places of the existing bricks, each once, followed by zeros.  Returns
    the number of bricks that do not exist yet.
    """
    seen = np.zeros(index.shape[0], np.bool_)
    there, new = 0, 0
    touched[:] = 0
    for word in words:
        brick = word >> 2
        if seen[brick]:
            continue
        seen[brick] = True
        if index[brick]:
            touched[there] = index[brick]
            there += 1
        else:
            new += 1
    return new


@compiled(
    types.void(
        uint16[::1],
        int16[::1],
        read_only(uint16, 1),
        read_only(uint64, 1),
        int64,
        read_only(int64, 1),
        int64[::1],
    ),
    brief=True,
)
def add_evidence(index: Any, cells: Any, words: Any, bits: Any, hits: Any, limits: Any, counts: Any) -> None:
    """Add the evidence of one scan to a chunk; ``cells`` has room for the bricks that become known.

    Parameters
    ----------
    index, cells
        Positions of bricks, (1024,), and their voxels, (N * 256,); both are changed.
    words, bits, hits
        The chunk's marks, and how many of the words are hits; the others are misses.
    limits
        Log-odds of a hit and a miss, the clamps, and the thresholds of occupied and free.
    counts
        (4,): numbers of bricks and of known, occupied and free voxels; updated.
    """
    low, high, occupied_above, free_below = limits[2], limits[3], limits[4], limits[5]
    bricks, active, occupied, free = counts[0], counts[1], counts[2], counts[3]
    for n in range(words.shape[0]):
        step = limits[0] if n < hits else limits[1]
        word, left = words[n], bits[n]
        brick = word >> 2
        if not index[brick]:
            bricks += 1
            index[brick] = bricks
        base = (np.int64(index[brick]) - 1) * BRICK_VOXELS + (np.int64(word) & 3) * 64
        while left:
            at = base + np.int64(_trailing_zeros(left))
            left &= left - _ONE
            before = np.int64(cells[at])
            after = min(max(before + step, low), high)
            cells[at] = after
            active += np.int64(after != 0) - np.int64(before != 0)
            occupied += np.int64(after > occupied_above) - np.int64(before > occupied_above)
            free += np.int64(after < free_below) - np.int64(before < free_below)
    counts[0], counts[1], counts[2], counts[3] = bricks, active, occupied, free


def _typed_fence(_context: Any) -> Any:
    """Emit a memory fence: earlier writes become visible before later ones."""

    def generate(context: Any, builder: Any, _signature: Any, _arguments: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


_fence: Any = intrinsic(_typed_fence)


@compiled(types.void(uint64[::1]), brief=True)
def begin_writing(sequence: Any) -> None:
    """Make the sequence, (1,), odd before any other change."""
    sequence[0] |= _ONE
    _fence()


@compiled(types.void(uint64[::1]), brief=True)
def end_writing(sequence: Any) -> None:
    """Set the sequence to the next even number after all other changes."""
    _fence()
    sequence[0] = (sequence[0] | _ONE) + _ONE
