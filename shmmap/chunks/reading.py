# SPDX-License-Identifier: Apache-2.0
"""Read chunks while they are written: a consistent copy, and the voxels in it.

A reader copies a chunk by `os.pread`; the copy is valid if the chunk's ``sequence`` was even and the same
before and after.  On x86 the processor keeps the order of reads; elsewhere a barrier in the kernel does.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shmmap.chunks.layout import HEADER_BYTES, MAX_BYTES, OUT_OF_SERVICE, STATE_AT, ChunkView, chunk_bytes
from shmmap.chunks.voxels import BRICK_VOXELS, ChunkKey, voxels_of
from shmmap.errors import BadRequest, SegmentCorrupt, StaleHandle

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

KINDS: Final = ("occupied", "free")
TRIES: Final = 1000
"""Tries for one copy: a write takes 40 us, but after a writer's death the sequence may stay odd."""

_SEQUENCE: Final = struct.Struct("<Q")
_MEMBARRIER: Final = {"aarch64": 283, "riscv64": 283, "armv7l": 389, "ppc64le": 365}
_GLOBAL: Final = 1


def _barrier() -> Callable[[], object]:
    number = _MEMBARRIER.get(platform.machine())
    if number is None:
        return lambda: None
    call: Any = ctypes.CDLL(None, use_errno=True).syscall
    return lambda: call(number, _GLOBAL, 0)


_fence: Final = _barrier()


def sequence_of(fd: int, name: str = "chunk") -> int:
    """Return the ``sequence`` of an open chunk: a copy is current as long as this does not change.

    Raises
    ------
    StaleHandle
        The chunk was evicted.
    """
    data = os.pread(fd, _SEQUENCE.size, STATE_AT)
    if len(data) < _SEQUENCE.size:
        raise StaleHandle(f"{name}: the chunk was given up")
    number: int = _SEQUENCE.unpack(data)[0]
    return number


def read_chunk(fd: int, name: str = "chunk") -> ChunkView | None:
    """Read a consistent copy of a chunk.

    Parameters
    ----------
    fd
        The chunk's file, open for reading.  (Only the writer maps a chunk, since the file is truncated to
        nothing when the chunk is evicted.)
    name
        Name in error messages.

    Returns
    -------
    ChunkView
        The copy; None if the writer kept changing the chunk, or died during a change.

    Raises
    ------
    StaleHandle
        The chunk was evicted.
    SegmentCorrupt
        The header states more bricks than the file contains, or than a chunk can have.
    OSError
        The file cannot be read.
    """
    for _ in range(TRIES):
        before = sequence_of(fd, name)
        if before & 1:
            os.sched_yield()
            continue
        _fence()
        size = os.fstat(fd).st_size
        if size > MAX_BYTES:
            raise SegmentCorrupt(f"{name}: {size} bytes cannot be a chunk")
        data = os.pread(fd, size, 0)
        _fence()
        if sequence_of(fd, name) != before:
            continue
        if len(data) < HEADER_BYTES:
            raise SegmentCorrupt(f"{name}: {len(data)} bytes cannot be a chunk")
        view = ChunkView(data)
        if int(view.state["state"]) == OUT_OF_SERVICE:
            raise StaleHandle(f"{name}: the chunk is given up")
        bricks = int(view.state["bricks"])
        if bricks > len(view.bricks) or int(view.index.max()) > bricks:
            raise SegmentCorrupt(f"{name}: it says that it has {bricks} bricks; {len(view.bricks)} are there")
        return ChunkView(view.data[: chunk_bytes(bricks)])
    return None


def select_voxels(view: ChunkView, kind: str) -> tuple[NDArray[np.int32], NDArray[np.int16]]:
    """Find the voxels of a kind in a chunk that is not being written.

    Parameters
    ----------
    kind
        ``occupied`` or ``free``.

    Returns
    -------
    indices
        Indices of the voxels, (N, 3) int32.
    log_odds
        (N,) int16, in thousandths.

    Raises
    ------
    BadRequest
        The kind is unknown.
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
    """Return the place of each brick among the chunk's 1024, in storage order."""
    there = np.flatnonzero(view.index)
    places = np.zeros(int(view.state["bricks"]), np.int64)
    places[view.index[there].astype(np.intp) - 1] = there
    return places
