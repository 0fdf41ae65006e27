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

__all__ = ["KIND", "TILE_COLUMNS", "build_search"]

TILE_COLUMNS: Final = 8
"""Columns of a tile along x and along y."""

_MAX_TILES: Final = 1 << 24  # 64 MiB of table: 16 km x 16 km in tiles of 4 m
_INDEX_LIMIT: Final = float(1 << 31)


def build_search(points: PointTable, parameters: Parameters) -> LayerTable:
    """Sort points by tile, then column, then z; equal ones stay in the source's order.

    Raises
    ------
    MapDataError
        If the points lie too far apart for the table (cause ``coordinate_range``).
    """
    leaf = float(parameters["leaf"])
    xyz = np.ascontiguousarray(points.xyz)
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        xyz = np.ascontiguousarray(xyz[finite])
    units = {"xyz": "m", "tile": "", "start": ""}
    if not len(xyz):
        empty: dict[str, NDArray[np.generic]] = {
            "xyz": xyz,
            "tile": np.empty((0, 0), np.int32),
            "start": np.zeros(1, np.int32),
        }
        return LayerTable(empty, 0, units, _lattice(leaf, (0, 0), (0, 0)))
    column, first, tiles = _columns(xyz, leaf)
    number, used = _number_tiles(column, tiles)
    inside = (column[:, 1] % TILE_COLUMNS) * TILE_COLUMNS + column[:, 0] % TILE_COLUMNS
    key = number * (TILE_COLUMNS * TILE_COLUMNS) + inside
    order = np.lexsort((xyz[:, 2], key))
    start = np.zeros(len(used) * TILE_COLUMNS * TILE_COLUMNS + 1, np.int32)
    np.cumsum(np.bincount(key, minlength=len(start) - 1), out=start[1:], dtype=np.int32)
    table = np.full(tiles[0] * tiles[1], -1, np.int32)
    table[used] = np.arange(len(used), dtype=np.int32)
    columns: dict[str, NDArray[np.generic]] = {
        "xyz": np.ascontiguousarray(xyz[order]),
        "tile": table.reshape(tiles[1], tiles[0]),
        "start": start,
    }
    shape = (tiles[0] * TILE_COLUMNS, tiles[1] * TILE_COLUMNS)
    return LayerTable(columns, len(xyz), units, _lattice(leaf, first, shape))


def _lattice(leaf: float, first: tuple[int, int], shape: tuple[int, int]) -> Lattice:
    depth = 1 if shape[0] else 0
    return Lattice((leaf, leaf, math.inf), (*first, 0), (*shape, depth))


def _columns(
    xyz: NDArray[np.generic], leaf: float
) -> tuple[NDArray[np.int64], tuple[int, int], tuple[int, int]]:
    """Column of each point counted from the first, (N, 2); the first; and tiles along x and y."""
    place = np.floor(xyz[:, :2].astype(np.float64) * (1.0 / leaf))
    low, high = place.min(axis=0), place.max(axis=0)
    if not (np.abs(low).max() < _INDEX_LIMIT and np.abs(high).max() < _INDEX_LIMIT):
        raise _too_far(leaf)
    # whole tiles of one lattice for all cells
    first = (low.astype(np.int64) // TILE_COLUMNS) * TILE_COLUMNS
    tiles = (high.astype(np.int64) - first) // TILE_COLUMNS + 1
    if int(tiles[0]) * int(tiles[1]) > _MAX_TILES:
        raise _too_far(leaf)
    column = place.astype(np.int64) - first
    return column, (int(first[0]), int(first[1])), (int(tiles[0]), int(tiles[1]))


def _too_far(leaf: float) -> MapDataError:
    return MapDataError(
        f"the points lie too far apart for a search table of {leaf:g} m",
        cause="coordinate_range",
        hint="divide the map into cells, remove stray points, or use a larger leaf",
    )


def _number_tiles(
    column: NDArray[np.int64], tiles: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Number of each point's tile among those that have points, and their places in the table."""
    place = (column[:, 1] // TILE_COLUMNS) * tiles[0] + column[:, 0] // TILE_COLUMNS
    used = np.flatnonzero(np.bincount(place, minlength=1))
    numbers = np.empty(int(used[-1]) + 1, np.int64)
    numbers[used] = np.arange(len(used))
    return numbers[place], used


KIND: Final = LayerKind(
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
