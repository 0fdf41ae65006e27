# SPDX-License-Identifier: Apache-2.0
"""Reading chunks that somebody writes: a copy that is whole, and the voxels in it.

A reader copies a chunk, and the copy counts if the chunk's ``sequence`` was even and the same before and
after.  On x86 the processor keeps the order of reads; elsewhere a barrier of the kernel does.
"""

from __future__ import annotations

import ctypes
import os
import platform
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shmmap.chunks.layout import BRICK_BYTES, HEADER_BYTES, ChunkView
from shmmap.chunks.voxels import BRICK_VOXELS, BRICKS, ChunkKey, voxels_of
from shmmap.errors import BadRequest, SegmentCorrupt

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["KINDS", "consistent_copy", "select_voxels"]

KINDS: Final = ("occupied", "free")
TRIES: Final = 1000
"""A writer takes 40 us for a chunk; one that died meanwhile leaves the sequence odd until the next comes."""

_MEMBARRIER: Final = {"aarch64": 283, "riscv64": 283, "armv7l": 389, "ppc64le": 365}
_GLOBAL: Final = 1


def _barrier() -> Callable[[], object]:
    number = _MEMBARRIER.get(platform.machine())
    if number is None:
        return lambda: None
    call: Any = ctypes.CDLL(None, use_errno=True).syscall
    return lambda: call(number, _GLOBAL, 0)


_fence: Final = _barrier()


def consistent_copy(view: ChunkView, room: Callable[[int], ChunkView]) -> ChunkView | None:
    """Copy a chunk as it was at one moment.

    Parameters
    ----------
    view
        The mapped chunk, at least its header.
    room
        Given a number of bricks, returns a view of the same chunk that has as many.

    Returns
    -------
    ChunkView
        Over memory of its own; None if the writer kept changing it, or died while it did.

    Raises
    ------
    SegmentCorrupt
        It says that it has more bricks than a chunk can have.
    """
    for attempt in range(TRIES):
        before = int(view.state["sequence"])
        if before & 1:
            os.sched_yield()
            continue
        _fence()
        bricks = int(view.state["bricks"])
        if bricks > BRICKS:
            if int(view.state["sequence"]) != before and attempt < TRIES - 1:
                continue
            raise SegmentCorrupt(f"a chunk says that it has {bricks} bricks; {BRICKS} are the most")
        whole = room(bricks)
        copy = bytes(whole.data[: HEADER_BYTES + bricks * BRICK_BYTES])
        _fence()
        if int(view.state["sequence"]) == before:
            return ChunkView(copy)
    return None


def select_voxels(view: ChunkView, kind: str) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """Find the voxels of a kind in a chunk that nobody is writing.

    Parameters
    ----------
    kind
        ``occupied`` or ``free``.

    Returns
    -------
    indices
        (N, 3) int32, of voxels.
    log_odds
        (N,) int16, in thousandths.

    Raises
    ------
    BadRequest
        There is no such kind.
    """
    identity = view.identity
    cells = view.bricks[: int(view.state["bricks"])]
    if kind == "occupied":
        found = cells > identity.occupied_above
    elif kind == "free":
        found = cells < identity.free_below
    else:
        raise BadRequest(f"voxels are not {kind!r}", hint=f"ask for one of {', '.join(KINDS)}")
    found &= cells != 0
    bricks, within = np.nonzero(found)
    places = _place_of_bricks(view)[bricks] * BRICK_VOXELS + within
    key: ChunkKey = identity.key
    return voxels_of(key, places), cells[bricks, within]


def _place_of_bricks(view: ChunkView) -> NDArray[np.int64]:
    """Which of the chunk's 1024 bricks each one that it has is, in the order in which they lie."""
    there = np.flatnonzero(view.index)
    places = np.zeros(int(view.state["bricks"]), np.int64)
    places[view.index[there].astype(np.intp) - 1] = there
    return places
