# SPDX-License-Identifier: Apache-2.0
"""A map of a drive without any bounds, which knows no daemon: what a live map must be."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import CHUNK_VOXELS, WORDS, ChunkKey
from shmmap.daemon.live.disk.stored_map import StoredMap, opened_folder_to_read

if TYPE_CHECKING:
    from shmmap.chunks.occupancy import ScanFilter

__all__ = ["Comparison", "UnboundedMap"]


class Comparison(NamedTuple):
    """A live map beside the unbounded one.

    Attributes
    ----------
    voxels
        That are known in one of the two, or in both.
    differing
        Of these, how many are not the same.
    """

    voxels: int
    differing: int


class UnboundedMap:
    """Remembers what every scan said of every chunk.

    Parameters
    ----------
    resolution
        Edge of a voxel, metres.
    scan_filter
        Which points count.
    """

    def __init__(self, resolution: float, scan_filter: ScanFilter) -> None:
        from shmmap.chunks.marking import Marker  # imports compiled kernels

        self._marker = Marker(resolution, scan_filter)
        self._said: dict[ChunkKey, list[tuple[NDArray[np.uint16], NDArray[np.uint64], int]]] = defaultdict(
            list
        )

    def add(self, points: NDArray[np.floating], pose: NDArray[np.floating]) -> None:
        """Take in a scan: (N, 3) metres in the sensor's frame, and T_map_sensor."""
        marks, _ = self._marker.mark(points, pose)
        starts = marks.starts.tolist()
        for at, (key, hits) in enumerate(zip(marks.chunks, marks.hits.tolist(), strict=True)):
            part = slice(starts[at], starts[at + 1])
            self._said[key].append((marks.words[part].copy(), marks.bits[part].copy(), hits))

    def chunk(self, key: ChunkKey, occupancy: Occupancy) -> NDArray[np.int16]:
        """Log-odds of a chunk's voxels by their places, thousandths: scan after scan, from nothing."""
        hit, miss, low, high = occupancy.steps
        found = np.zeros((WORDS, 64), np.int16)
        for words, bits, hits in self._said.get(key, ()):
            voxels = np.unpackbits(bits.astype("<u8").view(np.uint8), bitorder="little").reshape(-1, 64)
            for part, step in ((slice(hits), hit), (slice(hits, None), miss)):
                before = found[words[part]]
                after = np.clip(before.astype(np.int32) + step, low, high).astype(np.int16)
                found[words[part]] = np.where(voxels[part] != 0, after, before)
        return found.reshape(CHUNK_VOXELS)

    def compare(self, path: str) -> Comparison:
        """Compare with the files of a live map in a directory, voxel for voxel.

        Raises
        ------
        MapMissing, MapDataError
            There is none, or a file of it cannot be read.
        """
        voxels = differing = 0
        nothing = np.zeros(CHUNK_VOXELS, np.int16)
        with opened_folder_to_read(path) as folder:
            stored = StoredMap(folder, path)
            for key in sorted({*self._said, *stored.chunks}):
                mine = self.chunk(key, stored.settings.occupancy)
                theirs = stored.chunk(key)[1].dense() if key in stored.chunks else nothing
                voxels += int(np.count_nonzero(mine | theirs))
                differing += int(np.count_nonzero(mine != theirs))
        return Comparison(voxels, differing)
