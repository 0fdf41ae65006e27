# SPDX-License-Identifier: Apache-2.0
"""Voxels and rays, looked up in chunks that this process has mapped; the daemon says which there are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.voxels import ChunkKey, in_chunk, voxel_indices
from shmmap.client.live.attached_chunk import AttachedChunk
from shmmap.errors import SegmentError, StaleHandle

__all__ = ["ChunkInfo", "ChunkReader", "Place"]

MOST_ATTACHED: Final = 512
"""Chunks that are kept mapped; the longest unused go first."""
VOXELS_AT_ONCE: Final = 1 << 20
"""Of rays, that are looked up at a time."""
ROUNDS: Final = 4
"""How often a chunk that is gone before it is mapped is looked for again."""


class ChunkInfo(msgspec.Struct, frozen=True):
    """One chunk of a live map.

    Attributes
    ----------
    key
        Which one.
    state
        ``loading``, ``clean``, ``dirty`` (changed since it was saved), ``saving``, ``evicting`` (given up,
        and still mapped by readers), or ``saved``: on disk alone.
    active, occupied, free
        Known voxels, and of these occupied and free ones.
    bytes
        Its memory, or its file.
    version
        Rises with each scan that it takes in.
    generation
        Another one each time that it comes into memory; 0 where it is not.
    """

    key: ChunkKey
    state: str
    active: int
    occupied: int
    free: int
    bytes: int
    version: int
    generation: int


class Place(NamedTuple):
    """Where the chunks of a map are, and what they say.

    ``prefix`` is what paths of chunks begin with, ``slot`` what is locked in each.
    """

    prefix: str
    map_id: bytes
    slot: int
    resolution: float
    occupied_above: int


Changed: TypeAlias = tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]
"""Chunks that changed, and that left memory; number of the last change; whether the one before was known."""


class ChunkReader:
    """Reads the chunks of one map.

    Parameters
    ----------
    place
        Gives where they are now.
    changes
        Given the number of a change, gives what came after it; 0: everything.
    """

    def __init__(self, place: Callable[[], Place], changes: Callable[[int], Changed]) -> None:
        self._place = place
        self._changes = changes
        self._chunks: dict[ChunkKey, AttachedChunk] = {}
        self._rows: dict[ChunkKey, ChunkInfo] = {}
        self._change = 0

    def look_up(self, xyz: NDArray[np.float64]) -> NDArray[np.int16]:
        """Log-odds of the voxels in which points lie, (N,) thousandths; 0 where nothing is known."""
        self._refresh()
        return self._look_up(voxel_indices(xyz, self._place().resolution))

    def first_hits(self, origins: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres to the middle of the first occupied voxel of each ray, (N,); infinity for none."""
        resolution = self._place().resolution
        first, last = voxel_indices(origins, resolution), voxel_indices(ends, resolution)
        steps = np.abs(last.astype(np.int64) - first).max(axis=1, initial=0)
        found = np.full(len(ends), np.inf)
        self._refresh()
        size = max(1, VOXELS_AT_ONCE // (int(steps.max(initial=0)) + 1))
        for begin in range(0, len(ends), size):
            part = slice(begin, begin + size)
            found[part] = self._hits(origins[part], first[part], last[part], steps[part])
        return found

    def _refresh(self) -> None:
        """Learn which chunks are in memory now."""
        rows, gone, change, known = self._changes(self._change)
        if not known or not self._change:
            self._rows = rows
        else:
            for key in gone:
                self._rows.pop(key, None)
            self._rows.update(rows)
        self._change = change

    def _attached(self, key: ChunkKey) -> AttachedChunk | None:
        """A chunk in memory, mapped; None where there is none."""
        row = self._rows.get(key)
        mapped = self._chunks.pop(key, None)
        if row is None or row.generation == 0:
            return None
        if mapped is None or mapped.generation != row.generation or not mapped.in_service:
            place = self._place()
            path = f"{place.prefix}{key.text}.{row.generation}"
            mapped = AttachedChunk(path, key, row.generation, place.map_id, place.slot)
        self._chunks[key] = mapped  # the last used comes last
        while len(self._chunks) > MOST_ATTACHED:
            self._chunks.pop(next(iter(self._chunks)))
        return mapped

    def _look_up(self, indices: NDArray[np.int32]) -> NDArray[np.int16]:
        found = np.zeros(len(indices), np.int16)
        if not len(indices):
            return found
        keys, places = in_chunk(indices)
        chunks, which = np.unique(keys, axis=0, return_inverse=True)
        which = which.reshape(-1)
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(chunks)))
        begin = 0
        for key, end in zip(chunks.tolist(), ends.tolist(), strict=True):
            rows = order[begin:end]
            begin = end
            dense = self._dense(ChunkKey(*key))
            if dense is not None:
                found[rows] = dense[places[rows]]
        return found

    def _dense(self, key: ChunkKey) -> NDArray[np.int16] | None:
        for _ in range(ROUNDS):
            try:
                chunk = self._attached(key)
                return chunk.dense() if chunk is not None else None
            except StaleHandle:  # noqa: PERF203  asked again, a few times
                self._chunks.pop(key, None)
                self._refresh()
        raise SegmentError(f"chunk {key.text} is written and given up all the time", hint="ask again")

    def _hits(
        self,
        origins: NDArray[np.float64],
        first: NDArray[np.int32],
        last: NDArray[np.int32],
        steps: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        count = int(steps.max(initial=0)) + 1
        at = np.minimum(np.arange(count), steps[:, None])
        delta = last.astype(np.int64) - first
        way = np.abs(delta)[:, None, :] * at[:, :, None]
        whole = np.maximum(steps, 1)[:, None, None]
        moved = np.sign(delta)[:, None, :] * ((2 * way + whole) // (2 * whole))
        voxels = (first[:, None, :] + moved).astype(np.int32)
        hit = self._look_up(voxels.reshape(-1, 3)).reshape(len(first), count) > self._place().occupied_above
        which = hit.argmax(axis=1)
        rows = np.arange(len(first))
        away = (voxels[rows, which] + 0.5) * self._place().resolution - origins
        distance = np.sqrt((away * away).sum(axis=1))
        found: NDArray[np.float64] = np.where(hit.any(axis=1), distance, np.inf)
        return found
