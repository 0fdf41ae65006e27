# SPDX-License-Identifier: Apache-2.0
"""Voxels of an area, as the daemon lists them."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.voxels import voxel_centers
from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle

__all__ = ["Voxels", "read_voxels"]

_VOXEL_BYTES = 14


@dataclass(frozen=True, slots=True)
class Voxels:
    """Voxels of one kind.

    Attributes
    ----------
    indices
        (N, 3) int32: ``floor(x / resolution)`` along each axis.
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


def read_voxels(path: str, count: int, resolution: float, change: int) -> Voxels:
    """Read a list of voxels into memory of this process.

    Raises
    ------
    StaleHandle
        It is gone, in part or whole: it is kept for some seconds only.
    SegmentError, SegmentCorrupt
        It may not be read, or has another size.
    """
    if not count:
        return Voxels(np.empty((0, 3), np.int32), np.empty(0, np.int16), resolution, change)
    data = np.empty(count * _VOXEL_BYTES, np.uint8)
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError as error:
        raise StaleHandle(f"{path}: the list is gone") from error
    except OSError as error:
        raise SegmentError(f"{path}: {error.strerror}", hint="see `shmmap doctor`") from error
    try:
        at = 0
        while at < len(data) and (some := os.preadv(fd, [data.data[at:]], at)):
            at += some
        size = os.fstat(fd).st_size  # after that: what was cut meanwhile has lost its end first
    except OSError as error:
        raise SegmentError(f"{path}: {error.strerror}") from error
    finally:
        os.close(fd)
    if not size:
        raise StaleHandle(f"{path}: the list is gone")
    if size != len(data) or at != size:
        raise SegmentCorrupt(f"{path}: it is no list of {count} voxels")
    indices = data[: 12 * count].view("<i4").reshape(count, 3)
    return Voxels(indices, data[12 * count :].view("<i2"), resolution, change)
