# SPDX-License-Identifier: Apache-2.0
"""Write blocks of rows to the files of their cells, a few blocks in parallel.

Each block takes three steps: find the cell of each point, reserve places in the cells' files, and write the
rows, sorted by cell.  Only the second step runs in the order of the blocks.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from queue import SimpleQueue
from types import TracebackType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.cell_files import CellFiles, write_at
from shmmap.dividing.kernels import assign_cells, count_cells, scatter_rows
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.sources import word_view
from shmmap.errors import BadRequest

__all__ = ["Partition", "block_points_for", "worker_count"]

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
        self._block_points = block_points
        self._free: SimpleQueue[Rows] = SimpleQueue()
        for _ in range(threads + 1):
            self._free.put(np.empty(block_points, files.row))
        self._work: SimpleQueue[_Buffers] = SimpleQueue()
        for _ in range(threads):
            self._work.put(_Buffers(block_points, files.row))
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="divide")
        self._running: set[Future[None]] = set()
        self._turn = threading.Condition()
        self._next = self._tickets = 0
        self._failed = False
        self._error: BaseException | None = None

    def __enter__(self) -> Partition:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._fail()
        self._pool.shutdown(wait=True, cancel_futures=kind is not None)

    def buffer(self) -> Rows:
        """Return an empty buffer of `block_points` rows, to be filled and passed to `submit`."""
        while self._running and self._free.empty():
            done, self._running = wait(self._running, return_when=FIRST_COMPLETED)
            self._see(done)
        return self._free.get()

    def submit(self, buffer: Rows, count: int) -> None:
        """Divide the first ``count`` rows of a buffer; errors of earlier blocks are raised here."""
        done = {one for one in self._running if one.done()}
        self._running -= done
        self._see(done)
        ticket = self._tickets
        self._tickets += 1
        self._running.add(self._pool.submit(self._divide, ticket, buffer, count))

    def drain(self) -> None:
        """Wait until all submitted rows are written."""
        done, self._running = self._running, set()
        wait(done)
        self._see(done)

    def _see(self, done: set[Future[None]]) -> None:
        for future in done:
            error = future.exception()
            if error is not None:
                raise self._error or error

    def _divide(self, ticket: int, buffer: Rows, count: int) -> None:
        work = self._work.get()
        try:
            self._divide_with(work, ticket, buffer, count)
        except BaseException as error:
            self._fail(error)
            raise
        finally:
            self._work.put(work)

    def _divide_with(self, work: _Buffers, ticket: int, buffer: Rows, count: int) -> None:
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
            finite = ix != np.iinfo(np.int32).min
            keys = (iy[finite].astype(np.int64) << 32) + ix[finite]
            found, inverse, numbers = np.unique(keys, return_inverse=True, return_counts=True)
            wheres = np.column_stack(((found << 32) >> 32, found - ((found << 32) >> 32) >> 32))
            ix[finite], iy[finite] = inverse, 0
            low_x, low_y, width = 0, 0, len(found)
            places = np.cumsum(numbers) - numbers
        with self._in_order(ticket):
            slots = [
                self._files.reserve((ix, iy), number)
                for (ix, iy), number in zip(wheres.tolist(), numbers.tolist(), strict=True)
            ]
            self.kept += kept
            self.dropped += count - kept
            np.minimum(self.extremes[0], extremes[0], out=self.extremes[0])
            np.maximum(self.extremes[1], extremes[1], out=self.extremes[1])
        if kept:
            scatter_rows(word_view(rows), ix, iy, low_x, low_y, width, places, word_view(work.rows))
        self._free.put(buffer)
        view = work.rows.view(np.uint8).data
        size = self._files.row.itemsize
        start = 0
        for slot, number in zip(slots, numbers.tolist(), strict=True):
            write_at(slot, view[start * size : (start + number) * size])
            start += number

    def _fail(self, error: BaseException | None = None) -> None:
        with self._turn:
            self._failed = True
            self._error = self._error or error  # the first is the cause, the others its effect
            self._turn.notify_all()

    @contextlib.contextmanager
    def _in_order(self, ticket: int) -> Iterator[None]:
        """Run the part of a block's work that must happen in the order of the blocks."""
        with self._turn:
            self._turn.wait_for(lambda: self._failed or self._next == ticket)
            if self._failed:
                raise _AbandonedError
        yield
        with self._turn:
            self._next += 1
            self._turn.notify_all()


class _AbandonedError(Exception):
    """Raised in a block that stops because another block failed."""


class _Buffers:
    """The buffers of one thread for a block."""

    def __init__(self, points: int, row: np.dtype[np.void]) -> None:
        self.ix = np.empty(points, np.int32)
        self.iy = np.empty(points, np.int32)
        self.rows = np.empty(points, row)
