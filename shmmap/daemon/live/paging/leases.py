# SPDX-License-Identifier: Apache-2.0
"""Memory of chunks that are out of service and that readers may still map."""

from __future__ import annotations

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.paging.records import Lease

__all__ = ["Leases"]


class Leases:
    """Counts it until nobody maps it any more.

    Attributes
    ----------
    by_number
        What is counted.
    nbytes
        All of it.
    """

    def __init__(self) -> None:
        self.by_number: dict[int, Lease] = {}
        self.nbytes = 0
        self._given = 0

    def begin(self, key: ChunkKey, nbytes: int) -> Lease:
        """A chunk was given up."""
        self._given += 1
        lease = self.by_number[self._given] = Lease(key, self._given, nbytes)
        self.nbytes += nbytes
        return lease

    def end(self, lease: Lease) -> None:
        """Nobody maps it any more."""
        del self.by_number[lease.number]
        self.nbytes -= lease.nbytes
