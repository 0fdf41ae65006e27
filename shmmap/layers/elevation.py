# SPDX-License-Identifier: Apache-2.0
"""The ``elevation`` layer: heights of each column of a ground grid.

Each table is (ny, nx): the column of a point (x, y) is ``[j - j0, i - i0]`` with ``i = floor(x * (1 /
resolution))``, ``j`` likewise (in the points' own precision, see `shmmap.layers.lattice_kernels`), and
``(i0, j0)`` the header's ``lattice_first``.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.lattice import dense_table, group_points

__all__ = ["KIND", "build_elevation"]


def build_elevation(points: PointTable, parameters: Parameters) -> LayerTable:
    """Lowest, highest and mean z of each column, and how many points it has.

    Raises
    ------
    MapDataError
        If the grid cannot hold the coordinates.
    """
    from shmmap.layers.height_kernels import heights

    edge = float(parameters["resolution"])
    grouping = group_points(points.xyz, (edge, edge, math.inf))
    table = dense_table(grouping)[0] if len(grouping.counts) else np.empty((0, 0), np.int32)
    rows = len(grouping.counts)
    low, high, mean = np.empty(rows), np.empty(rows), np.empty(rows)
    heights(points.xyz, grouping.rows, grouping.counts, low, high, mean)

    def spread(values: NDArray[np.float64]) -> NDArray[np.float32]:
        grid = np.full(table.shape, np.nan, np.float32)
        grid[table >= 0] = values[table[table >= 0]]
        return grid

    count = np.zeros(table.shape, np.uint32)
    count[table >= 0] = grouping.counts[table[table >= 0]]
    return LayerTable(
        columns={"min": spread(low), "max": spread(high), "mean": spread(mean), "count": count},
        rows=rows,
        units={column.name: column.unit for column in KIND.columns},
        lattice=grouping.lattice,
    )


KIND: Final = LayerKind(
    name="elevation",
    builder_version=1,
    summary="lowest, highest and mean height and number of points of each column of a ground grid",
    borders=(
        "a column that a border of the cell cuts is in each cell, with that cell's points alone; extremes"
        " and count-weighted means of both give those of the whole"
    ),
    parameters=(
        Parameter("resolution", float, "edge of a column", "m", required=True, above=0.0, maximum=1e6),
    ),
    columns=(
        LayerColumn("min", np.dtype("<f4"), "(ny, nx)", "m", "lowest z, map frame; NaN: no points"),
        LayerColumn("max", np.dtype("<f4"), "(ny, nx)", "m", "highest z"),
        LayerColumn("mean", np.dtype("<f4"), "(ny, nx)", "m", "mean z"),
        LayerColumn("count", np.dtype("<u4"), "(ny, nx)", "", "points; 0: none"),
    ),
    build=build_elevation,
    bytes_ratio=0.1,
)
