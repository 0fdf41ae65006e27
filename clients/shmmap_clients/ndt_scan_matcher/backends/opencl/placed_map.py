# SPDX-License-Identifier: Apache-2.0
"""Where the kernel finds a map's tables, whether they are read in place or copied."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.opencl.square_directory import squares_of
from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap

__all__ = ["MapTables", "PlacedMap", "map_tables"]


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMap:
    """Where a map's tables lie; and how the kernel finds its way in them.

    Attributes
    ----------
    voxel_map
    places
        Of the table of cells, their origins, where each square's cells start, and the cells: offsets into the
        pool, or addresses where maps are read in place.
    lead
        Columns of the lattice between the first square's corner and the map's box, in i and j.
    squares
        In a row of j.
    memory
        What lies there, where nobody else keeps it.
    """

    voxel_map: VoxelMap
    places: tuple[int, int, int, int]
    lead: tuple[int, int]
    squares: int
    memory: object = None


@dataclass(frozen=True, slots=True, eq=False)
class MapTables:
    """What is small of a map: the arrays of `PlacedMap.places` in their order, and the rest of it."""

    arrays: list[NDArray[Any]]
    lead: tuple[int, int]
    squares: int


def map_tables(voxel_map: VoxelMap, table: NDArray[np.int64]) -> MapTables:
    """Return a map's tables.

    Parameters
    ----------
    voxel_map
    table : (C, `TABLE_COLUMNS`) int64
        Of its cells; what is in the columns of addresses does not matter here.
    """
    boxes = voxel_map.boxes
    low, squares, start, square_cell = squares_of(boxes[:, :2], boxes[:, 8:])
    return MapTables(
        [table, voxel_map.origins, start, square_cell],
        (int(voxel_map.box[0] - low[0]), int(voxel_map.box[1] - low[1])),
        squares,
    )
