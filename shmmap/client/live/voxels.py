# SPDX-License-Identifier: Apache-2.0
"""Voxels of an area, as the daemon lists them."""

from __future__ import annotations

import mmap
import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.voxels import voxel_centers
from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle

__all__ = ["Voxels", "open_voxels"]

_VOXEL_BYTES = 14


@dataclass(frozen=True, slots=True)
class Voxels:
    """Voxels of one kind.

    Attributes
    ----------
    indices
        (N, 3) int32, read-only, in shared memory: ``floor(x / resolution)`` along each axis.
    log_odds
        (N,) int16, thousandths.
    resolution
        Edge of a voxel, metres.
    change
        Number of the map's last change before: send it as ``since`` to get what came after.
    """

    indices: NDArray[np.int32]
    log_odds: NDArray[np.int16]
    resolution: float
    change: int

    def __len__(self) -> int:
        return len(self.log_odds)

    @property
    def xyz(self) -> NDArray[np.float64]:
        """Their middles, (N, 3) metres in the map's frame."""
        return voxel_centers(self.indices, self.resolution)

    @property
    def probability(self) -> NDArray[np.float64]:
        """How surely each is occupied, (N,), between 0 and 1."""
        odds = self.log_odds.astype(np.float64) / 1000.0
        chance: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-odds))
        return chance


def open_voxels(path: str, count: int, resolution: float, change: int) -> Voxels:
    """Map a list of voxels.

    Raises
    ------
    StaleHandle, SegmentError, SegmentCorrupt
        It is gone, may not be read, or has another size.
    """
    if not count:
        return Voxels(np.empty((0, 3), np.int32), np.empty(0, np.int16), resolution, change)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError as error:
        raise StaleHandle(f"{path}: the list is gone") from error
    except OSError as error:
        raise SegmentError(f"{path}: {error.strerror}", hint="see `shmmap doctor`") from error
    try:
        if os.fstat(fd).st_size != count * _VOXEL_BYTES:
            raise SegmentCorrupt(f"{path}: it is no list of {count} voxels")
        data = mmap.mmap(fd, count * _VOXEL_BYTES, prot=mmap.PROT_READ)
    finally:
        os.close(fd)
    indices = np.frombuffer(data, "<i4", 3 * count).reshape(count, 3)
    return Voxels(indices, np.frombuffer(data, "<i2", count, 12 * count), resolution, change)
