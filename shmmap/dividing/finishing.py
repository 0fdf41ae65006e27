# SPDX-License-Identifier: Apache-2.0
"""Second passes over divided points: reduce each voxel to one point, encode cells."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.cell_files import CellFiles
from shmmap.dividing.kernels import assign_cells
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.partition import Partition, block_points_for, worker_count
from shmmap.dividing.sources import AXES
from shmmap.errors import BadRequest
from shmmap.formats.pcd.writer import write_pcd
from shmmap.progress import Progress

_BYTES_PER_POINT: Final = 96
"""Memory per point that reducing takes, besides two copies of the points."""

_MAX_KEYS: Final = (1 << 63) - 1
_PACKED_COLOURS: Final = frozenset({"rgb", "rgba"})  # PCL stores four bytes in a float32
_AMOUNTS: Final = frozenset({"intensity", "red", "green", "blue", "nir"})  # integers with a mean

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
    """Reduce the points of each bucket by `reduce_voxels`, and append the results to their cells.

    No voxel is in two buckets, so the result equals that of the whole cloud at once, whatever the cell size.
    A centroid is appended to the cell that contains it.

    Raises
    ------
    BadRequest
        A bucket does not fit in memory, or its points cannot be numbered by voxel.
    """
    _check_fits(buckets, 2 * buckets.row.itemsize + _BYTES_PER_POINT, memory_bytes)
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
    """Write the cells of ``stage`` to the directory ``final`` in ``encoding``; return them.

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
    """Yield (item, result) in the order of the items, processing a few of them in parallel."""
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


def reduce_voxels(rows: NDArray[np.void], voxels: CellLattice) -> NDArray[np.void]:
    """Return one row for each voxel that has points, in the order of x, y, z of the voxels.

    The coordinates are the centroid, summed in float64.  Float fields are means, too; integer amounts
    (intensity, colours) are rounded means.  All other fields (labels, rings, packed colours) are copied from
    the voxel's first point, so that only values of the cloud occur.

    Parameters
    ----------
    rows
        (N,) finite points.
    voxels
        Lattice in x and y; z has the same step about 0.

    Raises
    ------
    BadRequest
        A point is too far from the origin of the lattice, or points are too far from each other, to number
        the voxels.
    """
    if not len(rows):
        return rows
    keys = _keys(rows, voxels)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate(([True], ordered[1:] != ordered[:-1])))
    counts = np.diff(starts, append=len(rows)).astype(np.float64)
    out = np.empty(len(starts), rows.dtype)
    for name in rows.dtype.names or ():
        kind = rows.dtype[name].base.kind
        if (kind == "f" and name not in _PACKED_COLOURS) or name in _AMOUNTS:
            values = rows[name][order].astype(np.float64)
            with np.errstate(invalid="ignore"):
                means = np.add.reduceat(values, starts) / counts.reshape(-1, *[1] * (values.ndim - 1))
            out[name] = means if kind == "f" else np.rint(means)
        else:
            out[name] = rows[name][order[starts]]
    return out


def _keys(rows: NDArray[np.void], voxels: CellLattice) -> NDArray[np.int64]:
    """Return a number for each point's voxel, ascending in x, then y, then z."""
    flat = CellLattice(voxels.step, 0, 0, voxels.scale)
    ix, iy, iz = (np.empty(len(rows), np.int32) for _ in AXES)
    extremes = np.zeros((2, 3))
    x, y, z = (rows[axis] for axis in AXES)
    level, low_x, high_x, low_y, high_y = assign_cells(x, y, z, voxels.numbers, ix, iy, extremes)
    spare = np.empty(len(rows), np.int32)
    upright, low_z, high_z, _, _ = assign_cells(z, z, z, flat.numbers, iz, spare, extremes)
    spans = (high_x - low_x + 1, high_y - low_y + 1, high_z - low_z + 1)
    if level < 0 or upright < 0 or math.prod(spans) > _MAX_KEYS:
        raise BadRequest(
            f"the points span too many voxels of {voxels.size:g} m to number them",
            hint="larger --leaf, or look for a damaged coordinate with `shmmap inspect`",
        )
    keys: NDArray[np.int64] = ix.astype(np.int64) - low_x
    for index, low, high in ((iy, low_y, high_y), (iz, low_z, high_z)):
        keys *= high - low + 1
        keys += index
        keys -= low
    return keys
