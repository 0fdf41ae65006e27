# SPDX-License-Identifier: Apache-2.0
"""The ``search`` layers of cells in this process: views, and a table of their addresses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell
from shmmap.layers import LayerTable

TILE_COLUMNS = 8  # as in `shmmap.layers.ground`: 8 x 8 columns in a tile
_MAX_BINS: Final = 1 << 16
_REACH_COLUMNS: Final = 2  # columns of neighbours within one leaf, and a margin for rounding
# indices of values in a row of the table
ADDRESS_XYZ, ADDRESS_TILE, ADDRESS_START, TILES_X, TILES_Y, FIRST_X, FIRST_Y, IS_DOUBLE = range(8)


@dataclass(frozen=True, slots=True, eq=False)
class SearchCell:
    """Sorted points of one cell and their table; read-only views.

    Attributes
    ----------
    xyz
        (N, 3) float32 or float64, map frame, metres: by tile, column, then z.
    tile
        (tiles_y, tiles_x) int32: number of each tile, -1 for a tile without points.
    start
        (tiles * 64 + 1,) int32: first row of each column.
    leaf
        Edge of a column, metres.
    first
        First column along x and y, counted in columns from the map's origin.
    owner
        Object that keeps the memory mapped.
    """

    xyz: NDArray[Any]
    tile: NDArray[np.int32]
    start: NDArray[np.int32]
    leaf: float
    first: tuple[int, int]
    owner: object = None

    @classmethod
    def of_layer(cls, layer: Cell | LayerTable) -> SearchCell:
        """Wrap the columns of a layer that has a lattice.

        Raises
        ------
        BadRequest
            The columns are not those of a ``search`` layer.
        """
        columns, lattice = layer.columns, layer.lattice
        assert lattice is not None  # noqa: S101  # the callers have looked
        missing = [name for name in ("xyz", "tile", "start") if name not in columns]
        if missing:
            raise BadRequest(f"not a search layer: it has no column {', '.join(missing)}")
        xyz, tile, start = columns["xyz"], columns["tile"], columns["start"]
        if xyz.dtype not in (np.dtype("<f4"), np.dtype("<f8")) or not xyz.flags.c_contiguous:
            raise BadRequest(f"xyz of a search layer must be float32 or float64, not {xyz.dtype}")
        return cls(xyz, tile, start, float(lattice.leaf[0]), (lattice.first[0], lattice.first[1]), layer)

    @property
    def columns_end(self) -> tuple[int, int]:
        """One past the last column along x and y."""
        tiles_y, tiles_x = self.tile.shape
        return self.first[0] + tiles_x * TILE_COLUMNS, self.first[1] + tiles_y * TILE_COLUMNS


@dataclass(frozen=True, slots=True, eq=False)
class SearchTable:
    """Private table of base addresses, and a coarse grid that finds the cells near a column.

    Attributes
    ----------
    cells
        The cells, which keep the memory mapped while the table exists.
    rows
        (C, 8) int64: addresses of ``xyz``, ``tile`` and ``start``; tiles along x and y; first column
        along x and y; whether ``xyz`` is float64.
    leaf
        Edge of a column, metres.
    bin_columns, bin_first, bin_shape
        The grid: columns in a bin, first bin along x and y, bins along x and y.
    bin_start, bin_cells
        (bins + 1,) and (entries,) int32: the cells of each bin, including cells within a leaf of it.
    """

    cells: tuple[SearchCell, ...]
    rows: NDArray[np.int64]
    leaf: float
    bin_columns: int
    bin_first: tuple[int, int]
    bin_shape: tuple[int, int]
    bin_start: NDArray[np.int32]
    bin_cells: NDArray[np.int32]

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Bounds of all columns: min_x, min_y, max_x, max_y, metres; None without cells."""
        if not self.cells:
            return None
        low = np.array([cell.first for cell in self.cells]).min(axis=0) * self.leaf
        high = np.array([cell.columns_end for cell in self.cells]).max(axis=0) * self.leaf
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def touches(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> bool:
        """Return whether a cell has columns in the rectangle from ``low`` to ``high``, (2,) each, metres."""
        first = np.array([cell.first for cell in self.cells]).reshape(-1, 2) * self.leaf
        end = np.array([cell.columns_end for cell in self.cells]).reshape(-1, 2) * self.leaf
        return bool(((first <= high) & (end >= low)).all(axis=1).any())

    @classmethod
    def of_cells(cls, given: Sequence[SearchCell]) -> SearchTable:
        """Make the table of cells, all of one ``leaf``, without empty cells."""
        cells = tuple(cell for cell in given if len(cell.xyz))
        nothing = np.zeros(1, np.int32)
        if not cells:
            return cls((), np.empty((0, 8), np.int64), 1.0, 1, (0, 0), (0, 0), nothing, nothing[:0])
        rows = np.array(
            [
                (
                    cell.xyz.ctypes.data,
                    cell.tile.ctypes.data,
                    cell.start.ctypes.data,
                    cell.tile.shape[1],
                    cell.tile.shape[0],
                    *cell.first,
                    cell.xyz.dtype.itemsize == 8,
                )
                for cell in cells
            ],
            np.int64,
        )
        low = np.array([cell.first for cell in cells], np.int64) - _REACH_COLUMNS
        high = np.array([cell.columns_end for cell in cells], np.int64) + _REACH_COLUMNS
        # about one cell in each bin, and at most as many bins as fit into a cache
        span = high.max(axis=0) - low.min(axis=0)
        wide = max(1, int(np.median(high - low)))
        while (span[0] // wide + 2) * (span[1] // wide + 2) > _MAX_BINS:
            wide *= 2
        first = low.min(axis=0) // wide
        shape = (high.max(axis=0) - 1) // wide - first + 1
        bin_low, bin_high = low // wide - first, (high - 1) // wide - first
        entries = [
            (int(y * shape[0] + x), number)
            for number in range(len(cells))
            for y in range(bin_low[number, 1], bin_high[number, 1] + 1)
            for x in range(bin_low[number, 0], bin_high[number, 0] + 1)
        ]
        bins, members = np.array(sorted(entries), np.int64).T
        start = np.searchsorted(bins, np.arange(int(shape[0]) * int(shape[1]) + 1)).astype(np.int32)
        return cls(
            cells,
            rows,
            cells[0].leaf,
            wide,
            (int(first[0]), int(first[1])),
            (int(shape[0]), int(shape[1])),
            start,
            members.astype(np.int32),
        )
