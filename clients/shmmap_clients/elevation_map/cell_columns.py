# SPDX-License-Identifier: Apache-2.0
"""From a cell to rows by column, and from all rows of a column to its height."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest, Cell
from shmmap_clients.elevation_map.rule import ElevationRule
from shmmap_clients.elevation_map.seams import Columns
from shmmap_clients.elevation_map.surface import surface_heights

__all__ = ["columns_of", "heights_of"]

_MIN, _MAX, _MEAN, _COUNT = range(4)


def columns_of(cell: Cell, rule: ElevationRule) -> Columns:
    """Points of a cell, (N, 3); or of its ``elevation`` layer min, max, mean and count, (N, 4) float64."""
    if rule.name == "surface":
        xyz = cell.xyz if not any(cell.origin) else cell.xyz.astype(np.float64) + cell.origin
        index = np.floor(xyz[:, :2].astype(np.float64) * (1.0 / rule.resolution)).astype(np.int64)
        return Columns(index[:, 0], index[:, 1], xyz)
    lattice = cell.header.lattice
    if lattice is None:
        raise BadRequest(f"{cell.id}: layer {cell.layer} has no lattice")
    count = cell["count"]
    j, i = np.nonzero(count)
    values = np.stack([cell[name][j, i].astype(np.float64) for name in ("min", "max", "mean")], axis=1)
    values = np.column_stack([values, count[j, i].astype(np.float64)])
    return Columns(i + lattice.first[0], j + lattice.first[1], values)


def heights_of(
    rows: Columns, rule: ElevationRule
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Columns i and j, (M,), and the height of each, (M,) float64 metres, from all their rows."""
    low_i, low_j = int(rows.i.min()), int(rows.j.min())
    width = int(rows.i.max()) - low_i + 1
    key = (rows.j - low_j) * width + (rows.i - low_i)
    if rule.name == "surface":
        columns, heights = surface_heights(rows.values, key, rule)
    else:
        columns, member = np.unique(key, return_inverse=True)
        member = member.reshape(-1)
        if rule.name == "mean":
            points = np.bincount(member, weights=rows.values[:, _COUNT])
            sums = np.bincount(member, weights=rows.values[:, _MEAN] * rows.values[:, _COUNT])
            heights = sums / points
        else:
            lowest = rule.name == "min"
            heights = np.full(len(columns), np.inf if lowest else -np.inf)
            ufunc = np.minimum if lowest else np.maximum
            ufunc.at(heights, member, rows.values[:, _MIN if lowest else _MAX])
    return columns % width + low_i, columns // width + low_j, heights
