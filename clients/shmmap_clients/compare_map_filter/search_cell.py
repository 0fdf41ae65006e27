# SPDX-License-Identifier: Apache-2.0
"""The ``search`` layer of one cell, as this process sees it: views, never copies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

__all__ = ["TILE_COLUMNS", "SearchCell"]

TILE_COLUMNS = 8  # as `shmmap.layers.search` has them: 8 x 8 columns in a tile


class _Lattice(Protocol):
    @property
    def first(self) -> tuple[int, int, int]: ...
    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def leaf(self) -> tuple[float, float, float]: ...


@dataclass(frozen=True, slots=True, eq=False)
class SearchCell:
    """Sorted points of one cell and their table; read-only views.

    Attributes
    ----------
    xyz
        (N, 3) float32 or float64, map frame, metres: by tile, column, then z.
    tile
        (tiles_y, tiles_x) int32: number of each tile, -1 where it has no points.
    start
        (tiles * 64 + 1,) int32: first row of each column.
    leaf
        Edge of a column, metres.
    first
        First column along x and y, counted in columns from the map's origin.
    owner
        Whatever keeps the memory mapped.
    """

    xyz: NDArray[Any]
    tile: NDArray[np.int32]
    start: NDArray[np.int32]
    leaf: float
    first: tuple[int, int]
    owner: object = None

    @classmethod
    def of_table(cls, columns: Mapping[str, NDArray[Any]], lattice: _Lattice, owner: object) -> SearchCell:
        """Wrap the columns of a layer.

        Raises
        ------
        BadRequest
            They are not those of a ``search`` layer.
        """
        missing = [name for name in ("xyz", "tile", "start") if name not in columns]
        if missing:
            raise BadRequest(f"not a search layer: it has no column {', '.join(missing)}")
        xyz, tile, start = columns["xyz"], columns["tile"], columns["start"]
        if xyz.dtype not in (np.dtype("<f4"), np.dtype("<f8")) or not xyz.flags.c_contiguous:
            raise BadRequest(f"xyz of a search layer must be float32 or float64, not {xyz.dtype}")
        return cls(xyz, tile, start, float(lattice.leaf[0]), (lattice.first[0], lattice.first[1]), owner)

    @property
    def columns_end(self) -> tuple[int, int]:
        """One past the last column along x and y."""
        tiles_y, tiles_x = self.tile.shape
        return self.first[0] + tiles_x * TILE_COLUMNS, self.first[1] + tiles_y * TILE_COLUMNS
