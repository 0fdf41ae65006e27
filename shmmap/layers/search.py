# SPDX-License-Identifier: Apache-2.0
"""The ``search`` layer: points sorted so that the neighbours of any place are found without building a tree.

The ground is divided into columns of ``leaf`` x ``leaf``, at multiples of ``leaf`` from the map's origin
(index ``floor(coordinate * (1 / leaf))`` in float64), and 8 x 8 columns make a tile.  ``tile[ty, tx]``
numbers the tiles that have points; the rows of column (cx, cy) are ``start[n] : start[n + 1]`` with
``n = tile[cy // 8, cx // 8] * 64 + (cy % 8) * 8 + cx % 8``, cx and cy counted from the lattice's first
column, and within a column z ascends.  All points within r of a place are then found in the columns
that its square of half-side r touches, by bisection of z.

Two levels keep the table small where a map is mostly empty: 4 bytes per 64 columns, and 256 bytes
more for each tile that has points.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.layers.contract import (
    Lattice,
    LayerColumn,
    LayerKind,
    LayerTable,
    Parameter,
    Parameters,
    PointTable,
)
from shmmap.layers.lattice import group_points

__all__ = ["SEARCH", "TILE_COLUMNS", "build_search"]

TILE_COLUMNS: Final = 8
"""Columns of a tile along x and along y."""

_MAX_TILES: Final = 1 << 24  # 64 MiB of table: 16 km x 16 km in tiles of 4 m


def build_search(points: PointTable, parameters: Parameters) -> LayerTable:
    """Sort points by tile, then column, then z; equal ones stay in the source's order.

    Raises
    ------
    MapDataError
        If the points lie too far apart for the table (cause ``coordinate_range``).
    """
    leaf = float(parameters["leaf"])
    xyz = np.ascontiguousarray(points.xyz)
    finite = np.isfinite(xyz)
    if not finite.all():
        xyz = np.ascontiguousarray(xyz[finite.all(axis=1)])
    units = {"xyz": "m", "tile": "", "start": ""}
    if not len(xyz):
        empty: dict[str, NDArray[np.generic]] = {
            "xyz": xyz,
            "tile": np.empty((0, 0), np.int32),
            "start": np.zeros(1, np.int32),
        }
        return LayerTable(empty, 0, units, _lattice(leaf, (0, 0), (0, 0)))
    # in float64 also where the points are float32
    grouping = group_points(np.ascontiguousarray(xyz, np.float64), (leaf, leaf, math.inf))
    column = grouping.indices[:, :2]
    first = column.min(axis=0) // TILE_COLUMNS * TILE_COLUMNS  # whole tiles of one lattice for all cells
    column_x, column_y = (column - first).T
    tiles_x, tiles_y = int(column_x.max()) // TILE_COLUMNS + 1, int(column_y.max()) // TILE_COLUMNS + 1
    if tiles_x * tiles_y > _MAX_TILES:
        raise MapDataError(
            f"the points lie too far apart for a search table of {leaf:g} m",
            cause="coordinate_range",
            hint="divide the map into cells, remove stray points, or use a larger leaf",
        )
    used, number = np.unique(
        column_y // TILE_COLUMNS * tiles_x + column_x // TILE_COLUMNS, return_inverse=True
    )
    key = number * TILE_COLUMNS**2 + column_y % TILE_COLUMNS * TILE_COLUMNS + column_x % TILE_COLUMNS
    key = key[grouping.rows]
    order = np.argsort(xyz[:, 2], kind="stable")
    # numpy sorts 16 bits by their digits, in no time
    narrow = key if len(used) * TILE_COLUMNS**2 > 1 << 16 else key.astype(np.uint16)
    order = order[np.argsort(narrow[order], kind="stable")]
    start = np.zeros(len(used) * TILE_COLUMNS * TILE_COLUMNS + 1, np.int32)
    np.cumsum(np.bincount(key, minlength=len(start) - 1), out=start[1:], dtype=np.int32)
    table = np.full(tiles_x * tiles_y, -1, np.int32)
    table[used] = np.arange(len(used), dtype=np.int32)
    columns: dict[str, NDArray[np.generic]] = {
        "xyz": np.ascontiguousarray(xyz[order]),
        "tile": table.reshape(tiles_y, tiles_x),
        "start": start,
    }
    shape = (tiles_x * TILE_COLUMNS, tiles_y * TILE_COLUMNS)
    return LayerTable(columns, len(xyz), units, _lattice(leaf, (int(first[0]), int(first[1])), shape))


def _lattice(leaf: float, first: tuple[int, int], shape: tuple[int, int]) -> Lattice:
    depth = 1 if shape[0] else 0
    return Lattice((leaf, leaf, math.inf), (*first, 0), (*shape, depth))


SEARCH: Final = LayerKind(
    name="search",
    builder_version=1,
    summary="points sorted by column and height, with a table of columns, for finding neighbours",
    borders="holds the cell's own points alone; who looks near a border looks into both cells",
    parameters=(
        Parameter(
            "leaf", float, "edge of a column, best the distance searched", "m", required=True, above=0.0,
            maximum=1e6,
        ),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "the points, map frame: by tile, column, then z"),
        LayerColumn("tile", np.dtype("<i4"), "(tiles_y, tiles_x)", "", "number of a tile; -1: no points"),
        LayerColumn("start", np.dtype("<i4"), "(tiles * 64 + 1,)", "", "first row of each column of a tile"),
    ),
    build=build_search,
    needs=("xyz",),
    bytes_ratio=1.0,
)  # fmt: skip
