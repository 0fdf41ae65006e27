# SPDX-License-Identifier: Apache-2.0
"""A chunk of a live map as a reader has it: mapped, and copied whole when it is looked at."""

from __future__ import annotations

import os
import weakref
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.layout import HEADER_BYTES, MOST_BYTES, OUT_OF_SERVICE, ChunkView, chunk_bytes
from shmmap.chunks.mapping import map_chunk, unmap_chunk, view_at
from shmmap.chunks.reading import consistent_copy
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle
from shmmap.segment.pins import lock_slot

__all__ = ["AttachedChunk"]

_FLAGS: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


class AttachedChunk:
    """One chunk, mapped for reading.

    Parameters
    ----------
    path
        Its file.
    key, generation, map_id
        What it must be.
    slot
        Of the session, which is locked as long as it is mapped.

    Raises
    ------
    StaleHandle
        It is gone: ask which chunks there are.
    SegmentError
        This user may not read it, or the process has no room for more mappings.
    SegmentCorrupt
        It is not the chunk that it should be.
    """

    def __init__(self, path: str, key: ChunkKey, generation: int, map_id: bytes, slot: int) -> None:
        self.key, self.generation = key, generation
        self._path = path
        try:
            fd = os.open(path, _FLAGS)
        except FileNotFoundError as error:
            raise StaleHandle(f"{path}: the chunk is gone") from error
        except OSError as error:
            raise SegmentError(f"{path}: {error.strerror}", hint="see `shmmap doctor`") from error
        try:
            if not HEADER_BYTES <= os.fstat(fd).st_size <= MOST_BYTES:
                raise SegmentCorrupt(f"{path}: its size cannot be that of a chunk")
            if slot:
                lock_slot(fd, slot)
            self._address = map_chunk(fd, path)
        except OSError as error:
            raise SegmentError(f"{path}: {error.strerror}") from error
        finally:
            os.close(fd)
        self._end = weakref.finalize(self, unmap_chunk, self._address)
        self._header = view_at(self._address, HEADER_BYTES)
        identity = self._header.identity
        if (identity.key, identity.generation, identity.map_id) != (key, generation, map_id):
            self.close()
            raise SegmentCorrupt(f"{path}: it is another chunk than its name says")
        self.occupied_above, self.free_below = identity.occupied_above, identity.free_below
        self._copy: ChunkView | None = None
        self._dense: NDArray[np.int16] | None = None

    def close(self) -> None:
        """Unmap it."""
        self._end()

    @property
    def in_service(self) -> bool:
        """Whether it may still change; if not, another one may have its key."""
        return int(self._header.state["state"]) != OUT_OF_SERVICE

    def copy(self) -> ChunkView:
        """Return it as it was at one moment, just now.

        Raises
        ------
        StaleHandle
            Its writer died in the middle of a change: the next one mends it, or has another chunk in its
            place.
        """
        # not its version: what a writer had changed when it died is undone, and may come again otherwise
        if self._copy is None or self._copy.state["sequence"] != self._header.state["sequence"]:
            copy = consistent_copy(self._header, self._room)
            if copy is None:
                raise StaleHandle(f"{self._path}: it is being written")
            self._copy, self._dense = copy, None
        return self._copy

    def _room(self, bricks: int) -> ChunkView:
        return view_at(self._address, chunk_bytes(bricks))

    def dense(self) -> NDArray[np.int16]:
        """Log-odds of all voxels by their place in the chunk, (262144,) int16: 0 where nothing is known."""
        copy = self.copy()
        if self._dense is None:
            self._dense = copy.dense()
        return self._dense
