# SPDX-License-Identifier: Apache-2.0
"""Chunks in plain memory, and marks applied to them: what the daemon's worker does, without the worker.

    python -m tests.support.chunk_memory FILE BRICKS

fills a chunk's file with one number after the other: a copy with two of them is torn.  It prints ``ready``,
and goes on until it is killed.
"""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from shmmap.chunks import applying_kernels as kernels
from shmmap.chunks.applying import UNDO_BYTES, ChunkWriter, UndoRecord
from shmmap.chunks.layout import ChunkIdentity, ChunkView, check_consistent, chunk_bytes, new_header
from shmmap.chunks.marks import Marks
from shmmap.chunks.occupancy import Occupancy
from shmmap.chunks.voxels import ChunkKey, voxels_of
from shmmap.live_worker.chunk_memory import map_chunk, view_at

MAP_ID = bytes(range(16))


class ChunkMemory:
    """A map's chunks by key, each as long as its bricks, and their writer."""

    def __init__(self, resolution: float, occupancy: Occupancy | None = None, map_id: bytes = MAP_ID) -> None:
        self.resolution = resolution
        self.map_id = map_id
        self.occupancy = occupancy if occupancy is not None else Occupancy()
        self.chunks: dict[ChunkKey, ChunkView] = {}
        self.undo = UndoRecord(bytearray(UNDO_BYTES))
        self.writer = ChunkWriter(self.occupancy, self.undo)

    def chunk(self, key: ChunkKey) -> ChunkView:
        """A chunk, a new one if there is none."""
        if key not in self.chunks:
            _, _, low, high = self.occupancy.steps
            identity = ChunkIdentity(
                self.map_id, key, self.resolution, low, high, *self.occupancy.thresholds, 1, "map"
            )
            self.chunks[key] = ChunkView(new_header(identity))
        return self.chunks[key]

    def grown(self, key: ChunkKey, bricks: int) -> ChunkView:
        """The same chunk with room for ``bricks`` bricks."""
        old = self.chunks[key].data
        data = bytearray(chunk_bytes(bricks))
        data[: len(old)] = old
        self.chunks[key] = ChunkView(data)
        return self.chunks[key]

    def apply(self, marks: Marks, *, mapper: int = 1, scan: int, known: tuple[int, ...] = ()) -> None:
        """Add a scan's evidence to all chunks that it touches."""
        starts = marks.starts.tolist()
        for number, (key, hits) in enumerate(zip(marks.chunks, marks.hits.tolist(), strict=True)):
            part = slice(starts[number], starts[number + 1])
            self.writer.apply(
                self.chunk(key),
                marks.words[part],
                marks.bits[part],
                hits,
                mapper=mapper,
                scan=scan,
                now_ns=scan,
                grow=lambda bricks, key=key: self.grown(key, bricks),  # type: ignore[misc]
                known_mappers=known,
            )

    def voxels(self) -> dict[tuple[int, int, int], int]:
        """All known voxels; every chunk is consistent."""
        found: dict[tuple[int, int, int], int] = {}
        for key, view in self.chunks.items():
            check_consistent(view, key.text)
            dense = view.dense()
            places = np.flatnonzero(dense)
            for voxel, value in zip(voxels_of(key, places).tolist(), dense[places].tolist(), strict=True):
                found[voxel[0], voxel[1], voxel[2]] = value
        return found


BETWEEN_S = 50e-6
"""About as long as from one scan to the next, seen from a chunk that is copied in 5 us."""


def main() -> None:
    """Write until the end."""
    path, bricks = sys.argv[1], int(sys.argv[2])
    fd = os.open(path, os.O_RDWR)
    view = view_at(map_chunk(fd, path), chunk_bytes(bricks))
    sequence = view.state["sequence"].reshape(1)
    number = 0
    kernels.begin_writing(sequence)
    kernels.end_writing(sequence)
    print("ready", flush=True)
    while True:
        number = number % 1000 + 1
        kernels.begin_writing(sequence)
        view.state["version"] += 1
        for brick in view.bricks:
            brick[:] = number
        kernels.end_writing(sequence)
        end_s = time.perf_counter() + BETWEEN_S
        while time.perf_counter() < end_s:
            pass


if __name__ == "__main__":
    main()
