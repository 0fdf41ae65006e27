# SPDX-License-Identifier: Apache-2.0
"""Look up voxels and rays in copies of chunks; the daemon lists which chunks there are.

A chunk is opened, read and closed at each access.  So no reader delays a writer or keeps a chunk's memory
from being freed.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Final, NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.layout import ChunkView
from shmmap.chunks.reading import read_chunk, sequence_of
from shmmap.chunks.voxels import ChunkKey, in_chunk, voxel_indices
from shmmap.errors import SegmentCorrupt, SegmentError, StaleHandle

MAX_COPIES: Final = 512
"""Number of chunk copies that are kept; the least recently used are dropped first."""
VOXELS_PER_STEP: Final = 1 << 20
"""Number of voxels along rays that are looked up in one step."""
ROUNDS: Final = 8
"""How often a chunk that vanished before it was read is looked for again."""
_FLAGS: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


class ChunkInfo(msgspec.Struct, frozen=True):
    """One chunk of a live map.

    Attributes
    ----------
    state
        ``loading``, ``clean``, ``dirty`` (changed since it was saved), ``saving``, or ``saved`` (only on
        disk).
    active, occupied, free
        Number of known voxels, and how many of these are occupied and free.
    bytes
        Size of its memory, or of its file if it is only on disk.
    version
        Increases with each scan that is applied to the chunk.
    generation
        Changes each time that the chunk is loaded into memory; 0 if it is not in memory.
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
    """Location of a map's chunks (paths begin with ``prefix``), and the properties that they must have."""

    prefix: str
    map_id: bytes
    resolution: float
    occupied_above: int


Changed: TypeAlias = tuple[dict[ChunkKey, ChunkInfo], list[ChunkKey], int, bool]
"""Changed chunks; keys of chunks that left memory; number of the last change; whether ``since`` was known."""


class _Copy(NamedTuple):
    """Copy of a chunk: ``view`` holds the content of the file ``inode`` at its ``sequence``."""

    generation: int
    inode: int
    sequence: int
    view: ChunkView


class ChunkReader:
    """Reads the chunks of one map.

    Parameters
    ----------
    place
        Returns the present location of the chunks.
    changes
        Returns the changes after the change with a given number; 0: all.
    """

    def __init__(self, place: Callable[[], Place], changes: Callable[[int], Changed]) -> None:
        self._place = place
        self._changes = changes
        self._copies: dict[ChunkKey, _Copy] = {}
        self._rows: dict[ChunkKey, ChunkInfo] = {}
        self._change = 0

    def look_up(self, xyz: NDArray[np.float64]) -> NDArray[np.int16]:
        """Return log-odds of the voxels that contain the points, (N,) thousandths; 0 for unknown voxels."""
        self._refresh()
        return self._look_up(voxel_indices(xyz, self._place().resolution))

    def first_hits(self, origins: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance to the first occupied voxel's centre on each ray, (N,) metres, or infinity."""
        resolution = self._place().resolution
        first, last = voxel_indices(origins, resolution), voxel_indices(ends, resolution)
        steps = np.abs(last.astype(np.int64) - first).max(axis=1, initial=0)
        found = np.full(len(ends), np.inf)
        self._refresh()
        size = max(1, VOXELS_PER_STEP // (int(steps.max(initial=0)) + 1))
        for begin in range(0, len(ends), size):
            part = slice(begin, begin + size)
            found[part] = self._hits(origins[part], first[part], last[part], steps[part])
        return found

    def _refresh(self) -> None:
        """Update the list of chunks in memory."""
        rows, gone, change, known = self._changes(self._change)
        if not known or not self._change:
            self._rows = rows
        else:
            for key in gone:
                self._rows.pop(key, None)
            self._rows.update(rows)
        self._change = change

    def _read(self, key: ChunkKey) -> ChunkView | None:
        """Return the present content of a chunk in memory; None if it is not in memory.

        Raises
        ------
        StaleHandle
            The chunk is gone, or its writer died in the middle of a change; the next writer repairs or
            replaces it.
        SegmentError
            This user may not read the chunk.
        SegmentCorrupt
            The file is not the expected chunk.
        """
        row = self._rows.get(key)
        copy = self._copies.pop(key, None)
        if row is None or row.generation == 0:
            return None
        place = self._place()
        path = f"{place.prefix}{key.text}.{row.generation}"
        try:
            fd = os.open(path, _FLAGS)
        except FileNotFoundError as error:
            raise StaleHandle(f"{path}: the chunk is gone") from error
        except OSError as error:
            raise SegmentError(f"{path}: {error.strerror}", hint="see `shmmap doctor`") from error
        try:
            inode = os.fstat(fd).st_ino
            # not its version: a change undone by a writer's death may be repeated with other content
            if copy is None or copy[:3] != (row.generation, inode, sequence_of(fd, path)):
                view = read_chunk(fd, path)
                if view is None:
                    raise StaleHandle(f"{path}: it is being written")
                identity = view.identity
                if (identity.key, identity.generation, identity.map_id) != (
                    key,
                    row.generation,
                    place.map_id,
                ):
                    raise SegmentCorrupt(f"{path}: it is another chunk than its name says")
                copy = _Copy(row.generation, inode, int(view.state["sequence"]), view)
        except OSError as error:
            raise SegmentError(f"{path}: {error.strerror}") from error
        finally:
            os.close(fd)
        self._copies[key] = copy  # most recently used at the end
        while len(self._copies) > MAX_COPIES:
            self._copies.pop(next(iter(self._copies)))
        return copy.view

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
            chunk = self._now(ChunkKey(*key))
            if chunk is not None:
                found[rows] = chunk.at(places[rows])
        return found

    def _now(self, key: ChunkKey) -> ChunkView | None:
        """Return the newest generation of a chunk in memory; None if it is not in memory."""
        for _ in range(ROUNDS):
            try:
                return self._read(key)
            except StaleHandle:  # noqa: PERF203  retried a few times
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
        travelled = np.abs(delta)[:, None, :] * at[:, :, None]
        whole = np.maximum(steps, 1)[:, None, None]
        moved = np.sign(delta)[:, None, :] * ((2 * travelled + whole) // (2 * whole))
        voxels = (first[:, None, :] + moved).astype(np.int32)
        hit = self._look_up(voxels.reshape(-1, 3)).reshape(len(first), count) > self._place().occupied_above
        which = hit.argmax(axis=1)
        rows = np.arange(len(first))
        away = (voxels[rows, which] + 0.5) * self._place().resolution - origins
        distance = np.sqrt((away * away).sum(axis=1))
        found: NDArray[np.float64] = np.where(hit.any(axis=1), distance, np.inf)
        return found
