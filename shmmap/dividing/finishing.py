# SPDX-License-Identifier: Apache-2.0
"""What needs all points of a place at once: voxels, and compression."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.cell_files import CellFiles
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.partition import Partition, block_points_for, worker_count
from shmmap.dividing.progress import Progress
from shmmap.dividing.voxels import BYTES_PER_POINT, reduce_voxels
from shmmap.errors import BadRequest
from shmmap.formats.pcd.writer import write_pcd

__all__ = ["thin_out", "write_encoded"]

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def thin_out(
    buckets: CellFiles,
    cells: CellFiles,
    voxels: CellLattice,
    lattice: CellLattice,
    memory_bytes: int,
    progress: Progress,
) -> None:
    """Reduce the points of each bucket by `reduce_voxels` and append them to the cells they fall into.

    No voxel is in two buckets, so the result is that of the whole cloud at once, whatever the cell size;
    a centroid goes to the cell that contains it.

    Raises
    ------
    BadRequest
        A bucket does not fit in memory, or its points cannot be numbered by voxel.
    """
    _check_fits(buckets, 2 * buckets.row.itemsize + BYTES_PER_POINT, memory_bytes)
    progress.stage("thinning out", sum(buckets.counts.values()))
    block_points = block_points_for(memory_bytes // 4, cells.row.itemsize, 1)
    wheres = sorted(buckets.counts)
    with Partition(cells, lattice, block_points=block_points, threads=1) as partition:
        for where, thinned in _in_order(lambda w: reduce_voxels(buckets.read(w), voxels), wheres):
            for start in range(0, len(thinned), block_points):
                part = thinned[start : start + block_points]
                buffer = partition.buffer()
                buffer[: len(part)] = part
                partition.submit(buffer, len(part))
            progress.advance(buckets.counts[where])
        partition.drain()


def write_encoded(
    stage: CellFiles, final: str, encoding: str, memory_bytes: int, progress: Progress
) -> CellFiles:
    """Write the cells of ``stage`` to the directory ``final`` in ``encoding``; return what was written.

    Raises
    ------
    BadRequest
        A cell does not fit in memory.
    """
    _check_fits(stage, 4 * stage.row.itemsize + 32, memory_bytes)
    progress.stage("encoding", sum(stage.counts.values()))
    cells = CellFiles(final, stage.row, stage.name)
    cells.counts = dict(stage.counts)

    def write(where: tuple[int, int]) -> None:
        rows = stage.read(where)
        columns: dict[str, NDArray[np.generic]] = {name: rows[name] for name in rows.dtype.names or ()}
        with open(cells.path(where), "wb") as file:
            write_pcd(file, columns, encoding=encoding)

    for where, _ in _in_order(write, sorted(stage.counts)):
        progress.advance(stage.counts[where])
    return cells


def _check_fits(files: CellFiles, bytes_per_point: int, memory_bytes: int) -> None:
    where, count = max(files.counts.items(), key=lambda item: item[1])
    if count * bytes_per_point * worker_count() > memory_bytes:
        raise BadRequest(
            f"{os.path.basename(files.path(where))} has {count} points, which do not fit in memory at once",
            hint="smaller --cell-size, or more --max-memory",
        )


def _in_order(
    function: Callable[[_Item], _Result], items: Iterable[_Item]
) -> Iterator[tuple[_Item, _Result]]:
    """Yield (item, result) in the order of the items, a few of them worked on at a time."""
    threads = worker_count()
    waiting: deque[tuple[_Item, Future[_Result]]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="finish") as pool:
        try:
            for item in items:
                waiting.append((item, pool.submit(function, item)))
                if len(waiting) >= threads:
                    done, future = waiting.popleft()
                    yield done, future.result()
            while waiting:
                done, future = waiting.popleft()
                yield done, future.result()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
