# SPDX-License-Identifier: Apache-2.0
"""Writes points as a map divided into square cells, in the format that Autoware's loader reads."""

from __future__ import annotations

import itertools
import math
import os
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.formats.durable_file import flush_directory
from shmmap.formats.pcd.writer import write_pcd
from shmmap.logfmt import log
from shmmap.origin.metadata_text import metadata_text

__all__ = ["MapWriter", "WrittenMap"]

Columns = Mapping[str, NDArray[Any]]

# Autoware's loader reads corners into an int
_MAX_CORNER = 2**31


@dataclass(frozen=True, slots=True)
class WrittenMap:
    """What a `MapWriter` wrote.

    Attributes
    ----------
    path
        The map directory.
    cells, points
        How many PCD files, and points in them.
    dropped
        Points left out because x, y or z was not finite.
    """

    path: str
    cells: int
    points: int
    dropped: int


@dataclass(slots=True)
class _Cell:
    """Points of a cell that is not written yet: rows in memory, and perhaps some in a spill file."""

    rows: list[NDArray[np.void]]
    spilled: np.dtype[np.void] | None = None


class MapWriter:
    """Divides points into half-open square cells ``[i * size, (i + 1) * size)``, i = floor(x / size).

    Writes ``<out_dir>/pointcloud_map.pcd/<prefix>_<x>_<y>.pcd`` for each cell, x and y being its lower
    left corner in metres, and ``<out_dir>/pointcloud_map_metadata.yaml``.  Everything is made in a
    hidden directory beside ``out_dir`` and appears at once by `finish`; a writer that is left without
    it leaves nothing.  Points keep their order within a cell, every column its dtype and bits.

    Parameters
    ----------
    out_dir
        The map directory; must not exist, or be empty.
    cell_size
        Side of a cell, metres.  Autoware's loader reads whole corners only, so whole sizes.
    prefix
        Start of every file name.
    encoding
        PCD encoding: ``ascii``, ``binary`` or ``binary_compressed``.
    memory_bytes
        Points held back in memory; beyond that they wait on the disk.  A single cell must fit in
        memory three times over.
    durable
        Force the files to the disk before the map appears; slower, and pointless for scratch maps.

    Raises
    ------
    BadRequest
        ``out_dir`` is not empty, or an argument makes no sense.
    OSError
        Here and in every method: the disk is full, or not writable.
    """

    def __init__(
        self,
        out_dir: str | os.PathLike[str],
        *,
        cell_size: float = 20.0,
        prefix: str = "",
        encoding: str = "binary",
        memory_bytes: int = 256 << 20,
        durable: bool = True,
    ) -> None:
        if not (math.isfinite(cell_size) and cell_size > 0):
            raise BadRequest(f"the cell size must be a positive number of metres, not {cell_size!r}")
        if "/" in prefix or not prefix.isprintable():
            raise BadRequest(f"{prefix!r} cannot start a file name")
        self._out_dir = os.path.abspath(out_dir)
        self._refuse_existing()
        if not float(cell_size).is_integer():
            log.warning(
                "cell corners are not whole metres, refused by Autoware's loader", cell_size=cell_size
            )
        self._size = float(cell_size)
        self._prefix = prefix
        self._encoding = encoding
        self._memory_bytes = memory_bytes
        self._durable = durable
        parent, name = os.path.split(self._out_dir)
        os.makedirs(parent, exist_ok=True)
        self._partial = os.path.join(parent, f".{name}.partial-{secrets.token_hex(4)}")
        self._cells_dir = os.path.join(self._partial, "pointcloud_map.pcd")
        self._spill_dir = os.path.join(self._partial, ".spill")
        os.mkdir(self._partial)
        os.mkdir(self._cells_dir)
        os.mkdir(self._spill_dir)
        self._open = True
        self._row: np.dtype[np.void] | None = None
        self._pending: dict[tuple[int, int], _Cell] = {}
        self._pending_bytes = 0
        self._written: dict[tuple[int, int], str] = {}
        self._points = self._dropped = 0

    def __enter__(self) -> MapWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.discard()

    def add(self, columns: Columns, *, complete: bool = False) -> None:
        """Add points to whatever cells they fall into.

        Parameters
        ----------
        columns
            Arrays of equal length: ``xyz`` (N, 3) float32 or float64, metres, map frame, and any
            others, (N,) or (N, k).  Every call brings the same names, dtypes and widths.
        complete
            These are all the points of their cells: the cells are written now, nothing is held back.

        Raises
        ------
        BadRequest
            The columns are not as described, a cell was completed before, or a coordinate is beyond
            2**31 m.
        """
        rows = self._rows(columns)
        ix, iy = self._cell_indices(rows)
        order, bounds = _group(ix, iy)
        rows = rows[order]
        for start, stop in itertools.pairwise(bounds):
            where = (int(ix[order[start]]), int(iy[order[start]]))
            if where in self._written or (complete and where in self._pending):
                raise BadRequest(f"the cell at {self._corner_text(where)} has points already")
            if complete:
                self._write(where, rows[start:stop])
            else:
                self._pending.setdefault(where, _Cell([])).rows.append(rows[start:stop])
                self._pending_bytes += rows[start:stop].nbytes
        if self._pending_bytes > self._memory_bytes:
            self._spill()

    def finish(self) -> WrittenMap:
        """Write what is held back and the metadata, and let the map appear.

        Raises
        ------
        BadRequest
            No points were added, or ``out_dir`` was filled by somebody else meanwhile.
        """
        self._require_open()
        if not (self._pending or self._written):
            raise BadRequest(f"no points to write to {self._out_dir}")
        for where in sorted(self._pending):
            cell = self._pending.pop(where)
            parts = cell.rows
            if cell.spilled is not None:
                parts = [np.fromfile(self._spill_file(where), dtype=cell.spilled), *parts]
            self._write(where, np.concatenate(parts))
        shutil.rmtree(self._spill_dir)
        self._write_metadata()
        if self._durable:
            for directory in (self._cells_dir, self._partial):
                flush_directory(directory)
        self._refuse_existing()
        # replaces an empty directory, and fails on any other
        os.rename(self._partial, self._out_dir)
        self._open = False
        if self._durable:
            flush_directory(os.path.dirname(self._out_dir))
        return WrittenMap(self._out_dir, len(self._written), self._points, self._dropped)

    def discard(self) -> None:
        """Remove what was written, unless it was finished."""
        if self._open:
            self._open = False
            self._pending.clear()
            shutil.rmtree(self._partial, ignore_errors=True)

    def _require_open(self) -> None:
        if not self._open:
            raise BadRequest(f"the map writer for {self._out_dir} is closed")

    def _refuse_existing(self) -> None:
        if os.path.lexists(self._out_dir) and not (
            os.path.isdir(self._out_dir)
            and not os.path.islink(self._out_dir)
            and not os.listdir(self._out_dir)
        ):
            raise BadRequest(f"{self._out_dir} exists already and is not an empty directory")

    def _rows(self, columns: Columns) -> NDArray[np.void]:
        """The finite points as packed rows, one field per column."""
        self._require_open()
        xyz = columns.get("xyz")
        if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.char not in "fd":
            raise BadRequest("points need a column xyz of shape (N, 3), float32 or float64")
        for name, column in columns.items():
            if column.ndim not in (1, 2) or len(column) != len(xyz):
                raise BadRequest(f"column {name} has shape {column.shape}, not ({len(xyz)},) or (N, k)")
        row = np.dtype([(name, column.dtype, column.shape[1:]) for name, column in columns.items()])
        if self._row is None:
            self._row = row
        elif self._row != row:
            raise BadRequest(f"the columns changed from {self._row} to {row}")
        # NaN and infinity show in the extremes; the mask is needed only then
        if len(xyz) and not (np.isfinite(xyz.min()) and np.isfinite(xyz.max())):
            finite = np.isfinite(xyz).all(axis=1)
            columns = {name: column[finite] for name, column in columns.items()}
            self._dropped += len(xyz) - int(np.count_nonzero(finite))
        rows = np.empty(len(columns["xyz"]), dtype=row)
        for name, column in columns.items():
            rows[name] = column
        return rows

    def _cell_indices(self, rows: NDArray[np.void]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        xy = rows["xyz"][:, :2].astype(np.float64)
        if len(xy) and float(np.abs(xy).max()) >= _MAX_CORNER:
            raise BadRequest("a coordinate is beyond 2**31 m, more than Autoware's format can say")
        indices = np.floor(xy / self._size).astype(np.int64)
        return indices[:, 0], indices[:, 1]

    def _spill(self) -> None:
        for where, cell in self._pending.items():
            if cell.rows:
                with open(self._spill_file(where), "ab") as file:
                    for rows in cell.rows:
                        rows.tofile(file)
                cell.spilled = cell.rows[0].dtype
                cell.rows = []
        self._pending_bytes = 0

    def _spill_file(self, where: tuple[int, int]) -> str:
        return os.path.join(self._spill_dir, f"{where[0]}_{where[1]}")

    def _write(self, where: tuple[int, int], rows: NDArray[np.void]) -> None:
        name = f"{self._prefix}_{self._corner_text(where, '_')}.pcd"
        columns = {column: np.ascontiguousarray(rows[column]) for column in rows.dtype.names or ()}
        with open(os.path.join(self._cells_dir, name), "xb") as file:
            write_pcd(file, columns, encoding=self._encoding)
            if self._durable:
                file.flush()
                os.fsync(file.fileno())
        self._written[where] = name
        self._points += len(rows)

    def _write_metadata(self) -> None:
        entries = [
            (name, (_number_text(where[0] * self._size), _number_text(where[1] * self._size)))
            for where, name in self._written.items()
        ]
        text = metadata_text(_number_text(self._size), entries)
        path = os.path.join(self._partial, "pointcloud_map_metadata.yaml")
        with open(path, "x", encoding="utf-8") as file:
            file.write(text)
            if self._durable:
                file.flush()
                os.fsync(file.fileno())

    def _corner_text(self, where: tuple[int, int], between: str = ", ") -> str:
        return between.join(_number_text(index * self._size) for index in where)


def _number_text(value: float) -> str:
    """Shortest text of a number of metres, an integer whenever it is whole."""
    return str(int(value)) if value.is_integer() else repr(round(value, 9))


def _group(ix: NDArray[np.int64], iy: NDArray[np.int64]) -> tuple[NDArray[np.intp], list[int]]:
    """Order that brings points of a cell together, stably, and where each cell starts and the last ends."""
    if not len(ix):
        return np.empty(0, dtype=np.intp), []
    width, height = int(np.ptp(ix)) + 1, int(np.ptp(iy)) + 1
    if width * height <= 1 << 16:
        # numpy sorts 16-bit integers by radix, in linear time
        keys: NDArray[Any] = ((iy - iy.min()) * width + (ix - ix.min())).astype(np.uint16)
    else:
        keys = (iy << 32) + ix
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate(([True], ordered[1:] != ordered[:-1])))
    return order, [*starts.tolist(), len(order)]
