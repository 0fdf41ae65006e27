# SPDX-License-Identifier: Apache-2.0
"""The ``voxel`` layer: one point for each voxel of the global lattice, the mean of those in it."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.lattice import Grouping, group_points

__all__ = ["VOXEL", "build_voxel"]

_EDGES: Final = ("leaf_x", "leaf_y", "leaf_z")


def _means(column: NDArray[np.generic], grouping: Grouping) -> NDArray[np.float64]:
    """Return the mean of a column over the points of each row, (V,) or (V, components) float64.

    Summed about each voxel's first value, so that large values lose no digits.
    """
    wide = column.reshape(len(column), math.prod(column.shape[1:]))
    kept = grouping.rows >= 0
    every = bool(kept.all())
    rows = grouping.rows if every else grouping.rows[kept]
    result = np.empty((len(grouping.counts), wide.shape[1]))
    if not len(result):
        return result.reshape(0, *column.shape[1:])
    about = np.empty(len(result))
    for component in range(wide.shape[1]):
        values = (wide[:, component] if every else wide[kept, component]).astype(np.float64)
        about[rows[::-1]] = values[::-1]  # the last assignment stands: the first value
        with np.errstate(invalid="ignore"):  # infinity minus infinity
            sums = np.bincount(rows, weights=values - about[rows], minlength=len(result))
        result[:, component] = sums / grouping.counts + about
    return result.reshape(len(result), *column.shape[1:])


def _kept_dtype(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Means of floats keep their dtype; those of integers are float32, float64 where that is too short."""
    if dtype.kind == "f":
        return dtype
    return np.dtype(np.float32 if dtype.itemsize <= 2 else np.float64)


def build_voxel(points: PointTable, parameters: Parameters) -> LayerTable:
    """Average the points of each voxel, every numeric column of them.

    A value that is not finite makes the mean of its column in its voxel not finite; a coordinate
    that is not finite leaves out its point.

    Raises
    ------
    MapDataError
        If the lattice cannot hold the coordinates.
    """
    leaf = _edges(parameters)
    grouping = group_points(points.xyz, leaf)
    columns: dict[str, NDArray[np.generic]] = {}
    for name, column in points.columns.items():
        if name != "count":
            columns[name] = _means(column, grouping).astype(_kept_dtype(column.dtype))
    columns["count"] = grouping.counts.astype(np.uint32)
    return LayerTable(
        columns=columns,
        rows=len(grouping.counts),
        units={**points.units, "xyz": "m", "count": ""},
        lattice=grouping.lattice,
    )


def _edges(parameters: Parameters) -> tuple[float, float, float]:
    if "leaf" in parameters:
        return (float(parameters["leaf"]),) * 3
    x, y, z = (float(parameters[name]) for name in _EDGES)
    return x, y, z


def _resolve(parameters: Parameters) -> Parameters:
    given = [name for name in _EDGES if name in parameters]
    if "leaf" in parameters:
        if given:
            raise BadRequest("voxel: give leaf, or leaf_x, leaf_y and leaf_z, not both")
        return parameters
    if len(given) != 3:
        raise BadRequest("voxel needs leaf, or leaf_x, leaf_y and leaf_z", hint="such as voxel(leaf=0.5)")
    if len({parameters[name] for name in _EDGES}) == 1:
        return {"leaf": parameters["leaf_x"]}
    return parameters


VOXEL: Final = LayerKind(
    name="voxel",
    builder_version=1,
    summary="one point for each voxel: the mean of the points in it, of every column, and their number",
    borders="a voxel that a border of the cell cuts has a point in each cell, of that cell's points alone",
    parameters=(
        Parameter("leaf", float, "edge of a voxel", "m", above=0.0, maximum=1e6),
        Parameter("leaf_x", float, "edge along x, with leaf_y and leaf_z", "m", above=0.0, maximum=1e6),
        Parameter("leaf_y", float, "edge along y", "m", above=0.0, maximum=1e6),
        Parameter("leaf_z", float, "edge along z", "m", above=0.0, maximum=1e6),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "mean of the points, map frame"),
        LayerColumn("*", None, "(rows,)", "", "mean of the column; float32 or float64 where it has integers"),
        LayerColumn("count", np.dtype("<u4"), "(rows,)", "", "points of the voxel"),
    ),
    build=build_voxel,
    resolve=_resolve,
    gives_points=True,
    needs=None,
    bytes_ratio=0.25,
)
