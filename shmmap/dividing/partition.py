# SPDX-License-Identifier: Apache-2.0
"""Write blocks of rows to the files of their cells, a few blocks in parallel.

Each block takes three steps: find the cell of each point, reserve places in the cells' files, and write the
rows, sorted by cell.  Only the second step runs in the order of the blocks.
"""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from shmmap.dividing.cell_files import CellFiles, Slot, write_at
from shmmap.dividing.kernels import NOWHERE, assign_cells, count_cells, scatter_rows
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.sources import word_view
from shmmap.errors import BadRequest

_WINDOW_CELLS: Final = 1 << 22  # up to this many cells between a block's extremes, a dense table counts
_MAX_BLOCK_POINTS: Final = 1 << 23
_MIN_BLOCK_POINTS: Final = 1 << 14

Rows = NDArray[np.void]


def worker_count() -> int:
    """Return the number of threads that sort and write; the main thread reads."""
    return max(1, min(4, len(os.sched_getaffinity(0))))


def block_points_for(memory_bytes: int, row_bytes: int, threads: int) -> int:
    """Return the points per block with which all buffers together take at most ``memory_bytes``."""
    per_point = (threads + 1) * row_bytes + threads * (row_bytes + 8)
    room = memory_bytes - threads * _WINDOW_CELLS * 16
    return max(_MIN_BLOCK_POINTS, min(_MAX_BLOCK_POINTS, room // per_point))


class Partition:
    """Writes blocks of rows to `CellFiles`.

    Parameters
    ----------
    files
        Files that receive the rows.
    lattice
        Lattice of the cells.
    block_points
        Maximum rows per block.
    threads
        Number of blocks processed in parallel.

    Attributes
    ----------
    kept, dropped
        Points written, and left out because x, y or z is not finite.
    extremes
        (2, 3) float64, least and greatest coordinates of the points written.
    """

    def __init__(self, files: CellFiles, lattice: CellLattice, *, block_points: int, threads: int) -> None:
        self._files = files
        self._lattice = lattice.numbers
        self.kept = self.dropped = 0
        self.extremes = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._free: SimpleQueue[Rows] = SimpleQueue()
        for _ in range(threads + 1):
            self._free.put(np.empty(block_points, files.row))
        self._work: SimpleQueue[_Buffers] = SimpleQueue()
        for _ in range(threads):
            self._work.put(_Buffers(block_points, files.row))
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="divide")
        self._running: deque[Future[None]] = deque()
        self._placed: Future[None] = Future()  # done once the block submitted last has its places
        self._placed.set_result(None)

    def __enter__(self) -> Partition:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=kind is not None)

    def buffer(self) -> Rows:
        """Return an empty buffer of `block_points` rows; errors of earlier blocks are raised here."""
        buffer = self._free.get()
        while self._running and self._running[0].done():
            self._running.popleft().result()
        return buffer

    def submit(self, buffer: Rows, count: int) -> None:
        """Divide the first ``count`` rows of a buffer."""
        before, self._placed = self._placed, Future()
        self._running.append(self._pool.submit(self._divide, buffer, count, before, self._placed))

    def drain(self) -> None:
        """Wait until all submitted rows are written."""
        while self._running:
            self._running.popleft().result()

    def _divide(self, buffer: Rows, count: int, before: Future[None], placed: Future[None]) -> None:
        """Divide a block; its rows get their places after ``before`` is done, and then ``placed`` is."""
        work = self._work.get()
        try:
            try:
                wheres, slots, numbers = self._sort(work, buffer, count, before, placed)
            finally:
                self._free.put(buffer)
            view = work.rows.view(np.uint8).data
            size = self._files.row.itemsize
            start = 0
            pieces: list[tuple[int, int, int, int, int]] = []
            for (ix, iy), slot, number in zip(wheres, slots, numbers, strict=True):
                rows = view[start * size : (start + number) * size]
                write_at(slot, rows)
                start += number
                if self._files.has_journal:
                    pieces.append((ix, iy, slot[2], len(rows), xxh3_64_intdigest(rows)))
            if pieces:
                self._files.written(pieces)
        except BaseException as error:
            if not placed.done():
                placed.set_exception(error)  # the next block fails, too
            raise
        finally:
            self._work.put(work)

    def _sort(
        self, work: _Buffers, buffer: Rows, count: int, before: Future[None], placed: Future[None]
    ) -> tuple[list[list[int]], list[Slot], list[int]]:
        """Copy the rows to the work buffer, sorted by cell; return cells, places and numbers of rows."""
        rows, ix, iy = buffer[:count], work.ix[:count], work.iy[:count]
        extremes = np.array([[np.inf] * 3, [-np.inf] * 3])
        kept, low_x, high_x, low_y, high_y = assign_cells(
            rows["x"], rows["y"], rows["z"], self._lattice, ix, iy, extremes
        )
        if kept < 0:
            raise BadRequest(
                "a point is more than 2**31 cells from the origin of the lattice",
                hint="larger --cell-size, or look for a damaged coordinate with `shmmap inspect`",
            )
        width = high_x - low_x + 1
        wheres, numbers = np.empty((0, 2), np.int64), np.empty(0, np.int64)
        places = np.empty(0, np.int64)
        if kept and width * (high_y - low_y + 1) <= _WINDOW_CELLS:
            counts = np.zeros(width * (high_y - low_y + 1), np.int64)
            count_cells(ix, iy, low_x, low_y, width, counts)
            cells = np.flatnonzero(counts)
            numbers = counts[cells]
            wheres = np.column_stack((cells % width + low_x, cells // width + low_y))
            places = np.cumsum(counts) - counts
        elif kept:
            # points far apart: number only the cells that contain points
            finite = ix != NOWHERE
            keys = (iy[finite].astype(np.int64) << 32) + ix[finite]
            found, inverse, numbers = np.unique(keys, return_inverse=True, return_counts=True)
            wheres = np.column_stack(((found << 32) >> 32, found - ((found << 32) >> 32) >> 32))
            ix[finite], iy[finite] = inverse, 0
            low_x, low_y, width = 0, 0, len(found)
            places = np.cumsum(numbers) - numbers
        before.result()
        cells_of_rows: list[list[int]] = wheres.tolist()
        slots = [
            self._files.reserve((ix, iy), number)
            for (ix, iy), number in zip(cells_of_rows, numbers.tolist(), strict=True)
        ]
        self.kept += kept
        self.dropped += count - kept
        np.minimum(self.extremes[0], extremes[0], out=self.extremes[0])
        np.maximum(self.extremes[1], extremes[1], out=self.extremes[1])
        placed.set_result(None)
        if kept:
            scatter_rows(word_view(rows), ix, iy, low_x, low_y, width, places, word_view(work.rows))
        return cells_of_rows, slots, numbers.tolist()


class _Buffers:
    """The buffers of one thread for a block."""

    def __init__(self, points: int, row: np.dtype[np.void]) -> None:
        self.ix = np.empty(points, np.int32)
        self.iy = np.empty(points, np.int32)
        self.rows = np.empty(points, row)
