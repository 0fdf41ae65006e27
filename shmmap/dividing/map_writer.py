# SPDX-License-Identifier: Apache-2.0
"""Write points that a program produces as a map divided into square cells."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.cell_files import CellFiles, write_at, write_metadata
from shmmap.dividing.inputs import check_output_directory
from shmmap.dividing.settings import DivideSettings, lattice_of
from shmmap.dividing.workspace import Workspace
from shmmap.errors import BadRequest

Columns = Mapping[str, NDArray[Any]]

_MAX_INDEX: Final = 1 << 30


@dataclass(frozen=True, slots=True)
class WrittenMap:
    """Result of a `MapWriter`: map directory, numbers of files and points, and of points not finite."""

    path: str
    cells: int
    points: int
    dropped: int


class MapWriter:
    """Divides points into half-open square cells ``[i * size, (i + 1) * size)``, i = floor(x / size).

    Writes ``<out_dir>/pointcloud_map.pcd/<prefix>_<x>_<y>.pcd`` for each cell, x and y being its lower left
    corner in metres, and ``<out_dir>/pointcloud_map_metadata.yaml``.  Everything is written to a hidden
    directory beside ``out_dir``, and `finish` makes it appear at once; without `finish` nothing remains.
    Points keep their order within a cell, every column its dtype and bits.

    Parameters
    ----------
    out_dir
        The map directory; must not exist, or be empty.
    cell_size
        Side of a cell, metres.  Autoware's loader reads whole corners only, so whole sizes.
    prefix
        Start of every file name.
    durable
        Flush the files to the disk before the map appears: slower, and unnecessary for scratch maps.

    Raises
    ------
    BadRequest
        ``out_dir`` is not empty, or an argument is invalid.
    OSError
        The disk is full or not writable; also raised by every method.
    """

    def __init__(
        self,
        out_dir: str | os.PathLike[str],
        *,
        cell_size: float = 20.0,
        prefix: str = "",
        durable: bool = True,
    ) -> None:
        self._lattice = lattice_of(DivideSettings(cell_size=cell_size, prefix=prefix))
        self._prefix = prefix
        self._durable = durable
        self._out_dir = os.path.abspath(out_dir)
        check_output_directory(self._out_dir, force=False)
        self._open = contextlib.ExitStack()
        self._space: Workspace | None = self._open.enter_context(Workspace(self._out_dir, "writing"))
        self._space.empty()
        self._cells_dir = self._space.directory("map/pointcloud_map.pcd")
        self._files: CellFiles | None = None
        self._points = self._dropped = 0

    def __enter__(self) -> MapWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()

    def add(self, columns: Columns) -> None:
        """Add points to the cells that contain them.

        Parameters
        ----------
        columns
            Arrays of equal length: ``xyz`` (N, 3) float32 or float64, metres, map frame, and any others, (N,)
            or (N, k).  All calls must have the same names, dtypes and widths.

        Raises
        ------
        BadRequest
            The columns are invalid, or a point is more than 2**30 cells from the map's origin.
        """
        self._require_open()
        rows = _rows(columns)
        if self._files is None:
            self._files = CellFiles(
                self._cells_dir, rows.dtype, partial(self._lattice.file_name, self._prefix)
            )
            self._open.callback(self._files.close)
        elif self._files.row != rows.dtype:
            raise BadRequest(f"the columns changed from {self._files.row} to {rows.dtype}")
        finite = np.isfinite(rows["x"]) & np.isfinite(rows["y"]) & np.isfinite(rows["z"])
        if not finite.all():
            self._dropped += len(rows) - int(np.count_nonzero(finite))
            rows = rows[finite]
        self._points += len(rows)
        if not len(rows):
            return
        index = [np.floor(rows[axis].astype(np.float64) / self._lattice.size) for axis in "xy"]
        if np.abs(index).max() >= _MAX_INDEX:
            raise BadRequest("a point is more than 2**30 cells from the origin of the map")
        ix, iy = (one.astype(np.int64) for one in index)
        key = (iy - iy.min()) * (np.ptp(ix) + 1) + (ix - ix.min())
        # numpy's radix sort of 16-bit values is fast
        order = np.argsort(key.astype(np.uint16) if key.max() < 1 << 16 else key, kind="stable")
        starts = np.flatnonzero(np.diff(key[order], prepend=-1))
        for start, stop in itertools.pairwise([*starts.tolist(), len(order)]):
            where = int(ix[order[start]]), int(iy[order[start]])
            slot = self._files.reserve(where, stop - start)
            write_at(slot, rows[order[start:stop]].view(np.uint8).data)

    def finish(self) -> WrittenMap:
        """Write the metadata and publish the map.

        Raises
        ------
        BadRequest
            No points were added, or another program wrote to ``out_dir`` meanwhile.
        """
        space = self._require_open()
        if not self._points or self._files is None:
            raise BadRequest(f"no points to write to {self._out_dir}")
        self._files.finish()
        cells = self._files.counts
        write_metadata(space.content, self._lattice, self._prefix, cells)
        check_output_directory(self._out_dir, force=False)
        space.publish(replace=False, durable=self._durable)
        self.discard()
        return WrittenMap(self._out_dir, len(cells), self._points, self._dropped)

    def discard(self) -> None:
        """Remove the written files, unless the map is finished."""
        self._space = None
        self._open.close()

    def _require_open(self) -> Workspace:
        if self._space is None:
            raise BadRequest(f"the map writer for {self._out_dir} is closed")
        return self._space


def _rows(columns: Columns) -> NDArray[np.void]:
    """Return points as packed rows, x, y and z first."""
    xyz = columns.get("xyz")
    if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.char not in "fd":
        raise BadRequest("points need a column xyz of shape (N, 3), float32 or float64")
    for name, column in columns.items():
        if column.ndim not in (1, 2) or len(column) != len(xyz):
            raise BadRequest(f"column {name} has shape {column.shape}, not ({len(xyz)},) or (N, k)")
    others = {name: column for name, column in columns.items() if name != "xyz"}
    rows = np.empty(
        len(xyz),
        [
            *((axis, xyz.dtype) for axis in "xyz"),
            *((name, column.dtype, column.shape[1:]) for name, column in others.items()),
        ],
    )
    for index, axis in enumerate("xyz"):
        rows[axis] = xyz[:, index]
    for name, column in others.items():
        rows[name] = column
    return rows
