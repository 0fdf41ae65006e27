# SPDX-License-Identifier: Apache-2.0
"""Points sorted into the voxels of a global lattice, and the layers ``voxel`` and ``ndt`` made from them.

Rows are numbered with x fastest, then y, then z.  ``voxel`` has one point for each voxel, the mean of its
points.  ``ndt`` has a Gaussian for each voxel of at least ``min_points`` points, ready for scan matching, and
a ``table`` that gives a voxel's row without a tree search: a point at ``(x, y, z)`` is in row
``table[k - k0, j - j0, i - i0]`` with ``i = floor(x * (1 / leaf))`` and so on (in the points' own precision,
see `shmmap.layers.kernels`), and ``(i0, j0, k0)`` the header's ``lattice_first``; -1: no row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.lazy_imports import needed_packages
from shmmap.segment.layout import Lattice

MAX_TABLE_VOXELS: Final = 1 << 24
"""Maximum number of voxels of a stored dense table: 64 MiB of int32, a 512 m cube at 2 m."""

_INDEX_LIMIT: Final = float(1 << 31)
_DENSE_POINTS: Final = 64
_SMALL_TABLE: Final = 1 << 21


@dataclass(slots=True)
class Grouping:
    """Assignment of points to voxels.

    Attributes
    ----------
    rows
        (N,) int32: row of each point's voxel; -1 for a point that is not finite, or whose voxel has
        too few points.
    counts
        (V,) int32: number of points in each row's voxel.
    indices
        (V, 3) int64: lattice index x, y, z of each row.
    leaf
        Edge lengths of a voxel, metres.
    """

    rows: NDArray[np.int32]
    counts: NDArray[np.int32]
    indices: NDArray[np.int64]
    leaf: tuple[float, float, float]

    @property
    def lattice(self) -> Lattice:
        """The lattice, with the index range that the rows occupy."""
        if not len(self.indices):
            return Lattice(self.leaf, (0, 0, 0), (0, 0, 0))
        low = self.indices.min(axis=0)
        shape = self.indices.max(axis=0) - low + 1
        return Lattice(
            self.leaf,
            (int(low[0]), int(low[1]), int(low[2])),
            (int(shape[0]), int(shape[1]), int(shape[2])),
        )

    def spread(self, values: NDArray[Any], empty: float) -> NDArray[Any]:
        """Arrange values per row as a table on the lattice, (nz, ny, nx) over the box that the rows occupy.

        Voxels without a row have the value ``empty``.

        Raises
        ------
        MapDataError
            The box is too large for a table (cause ``coordinate_range``).
        """
        lattice = self.lattice
        nx, ny, nz = lattice.shape
        if nx * ny * nz > MAX_TABLE_VOXELS:
            raise MapDataError(
                f"its voxels span {nx} x {ny} x {nz}, more than {MAX_TABLE_VOXELS}",
                cause="coordinate_range",
                hint="use a larger leaf or smaller cells, or remove stray points",
            )
        table = np.full((nz, ny, nx), empty, values.dtype)
        x, y, z = (self.indices - np.array(lattice.first, np.int64)).T
        table[z, y, x] = values
        return table


def group_points(xyz: NDArray[np.generic], leaf: tuple[float, float, float], *, least: int = 1) -> Grouping:
    """Sort points into voxels.

    Parameters
    ----------
    xyz
        (N, 3) float32 or float64, C-contiguous, metres; the lattice index is computed in the same
        precision.
    leaf
        Edge lengths of a voxel, metres; infinite: that axis is not divided.
    least
        Voxels of fewer points get no row.

    Raises
    ------
    MapDataError
        Coordinates are too large for the lattice (cause ``coordinate_range``).
    """
    from shmmap.layers.kernels import bounds, count_points, number_voxels

    real = xyz.dtype.type
    inverse_x, inverse_y, inverse_z = (real(1.0) / real(edge) for edge in leaf)
    found = np.empty(6)
    kept = bounds(xyz, inverse_x, inverse_y, inverse_z, found)
    if not kept:
        return Grouping(
            np.full(len(xyz), -1, np.int32), np.empty(0, np.int32), np.empty((0, 3), np.int64), leaf
        )
    if not np.all(np.abs(found) < _INDEX_LIMIT):
        raise MapDataError(
            f"coordinates are too large for a lattice of {min(leaf):g} m",
            cause="coordinate_range",
            hint="use a larger leaf, or remove the stray points",
        )
    first = found[:3].astype(np.int64)
    shape = found[3:6].astype(np.int64) - first + 1
    voxels = math.prod(shape.tolist())
    if voxels > max(_SMALL_TABLE, min(_DENSE_POINTS * kept, MAX_TABLE_VOXELS * 4)):
        rows, counts, indices = _by_sorting(xyz, np.array([inverse_x, inverse_y, inverse_z], real), least)
    else:
        place = np.empty(len(xyz), np.int32)
        table = np.zeros(voxels, np.int32)
        occupied = count_points(xyz, inverse_x, inverse_y, inverse_z, first, shape, place, table)
        counts, places = np.empty(occupied, np.int32), np.empty(occupied, np.int32)
        row_count = number_voxels(table, least, counts, places)
        counts, places = counts[:row_count], places[:row_count].astype(np.int64)
        rows = table[place]  # place -1 (point not finite) reads the last entry
        if kept < len(xyz):
            rows[place < 0] = -1
        indices = np.empty((row_count, 3), np.int64)
        indices[:, 0] = places % shape[0]
        indices[:, 1] = places // shape[0] % shape[1]
        indices[:, 2] = places // (shape[0] * shape[1])
        indices += first
    return Grouping(rows, counts, indices, leaf)


def _by_sorting(
    xyz: NDArray[Any],
    inverse: NDArray[Any],
    least: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Group points by sorting, for points too far apart for a dense table."""
    finite = np.isfinite(xyz).all(axis=1)
    index = np.floor(xyz[finite] * inverse).astype(np.int64)
    order = np.lexsort((index[:, 0], index[:, 1], index[:, 2]))
    ordered = index[order]
    starts = np.flatnonzero(np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)]))
    counts = np.diff(np.append(starts, len(ordered))).astype(np.int32)
    number = np.full(len(counts), -1, np.int32)
    wanted = np.flatnonzero(counts >= least)
    number[wanted] = np.arange(len(wanted), dtype=np.int32)
    inner = np.empty(len(ordered), np.int32)
    inner[order] = np.repeat(number, counts)
    rows = np.full(len(xyz), -1, np.int32)
    rows[finite] = inner
    return rows, counts[wanted], ordered[starts[wanted]]


def edge(name: str, meaning: str, *, default: float | None = None, required: bool = False) -> Parameter:
    """Return the parameter for an edge of voxels or columns, metres."""
    return Parameter(name, float, meaning, "m", default=default, required=required, above=0.0, maximum=1e6)


_EDGES: Final = ("leaf_x", "leaf_y", "leaf_z")


def _means(column: NDArray[np.generic], grouping: Grouping) -> NDArray[np.float64]:
    """Return the mean of a column over the points of each row, (V,) or (V, components) float64.

    Sums are relative to each voxel's first value, so that large values lose no digits.
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
        about[rows[::-1]] = values[::-1]  # reversed: the first value of a row is assigned last and stays
        with np.errstate(invalid="ignore"):  # infinity minus infinity may occur
            sums = np.bincount(rows, weights=values - about[rows], minlength=len(result))
        result[:, component] = sums / grouping.counts + about
    return result.reshape(len(result), *column.shape[1:])


def _kept_dtype(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return the dtype of a mean: that of the floats; float32 for integers up to 16 bits, else float64."""
    if dtype.kind == "f":
        return dtype
    return np.dtype(np.float32 if dtype.itemsize <= 2 else np.float64)


def build_voxel(points: PointTable, parameters: Parameters) -> LayerTable:
    """Average the points of each voxel, in every numeric column.

    A value that is not finite makes the mean of its column in its voxel not finite; a point with a
    coordinate that is not finite is left out.

    Raises
    ------
    MapDataError
        The coordinates exceed the range of the lattice.
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
        edge("leaf", "edge of a voxel"),
        edge("leaf_x", "edge along x, with leaf_y and leaf_z"),
        edge("leaf_y", "edge along y"),
        edge("leaf_z", "edge along z"),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "mean of the points", "map"),
        LayerColumn(
            "*",
            None,
            "the source's",
            "the source's",
            "mean of the field; of integers float32 up to 16 bits, else float64",
            missing="not finite if one is not",
        ),
        LayerColumn("count", np.dtype("<u4"), "(rows,)", "", "points of the voxel"),
    ),
    build=build_voxel,
    resolve=_resolve,
    gives_points=True,
    needs=None,
    bytes_ratio=0.25,
)


Convention: TypeAlias = Literal["autoware", "pclomp", "pcl"]
CONVENTIONS: Final[tuple[Convention, ...]] = ("autoware", "pclomp", "pcl")
_LEAST_EIGENVALUE_RATIO: Final = 0.01
"""``min_covar_eigvalue_mult_`` of PCL's VoxelGridCovariance and of its derivatives."""


def build_ndt(points: PointTable, parameters: Parameters) -> LayerTable:
    """Compute moments and inverse covariances of each voxel.

    Parameters
    ----------
    parameters
        ``leaf`` metres, ``min_points``.

    Raises
    ------
    MapDataError
        The coordinates exceed the range of the lattice.
    """
    from shmmap.layers.kernels import inverse_covariances, moments

    leaf = float(parameters["leaf"])
    grouping = group_points(points.xyz, (leaf, leaf, leaf), least=int(parameters["min_points"]))
    voxels = len(grouping.counts)
    mean, scatter = np.empty((voxels, 3)), np.empty((voxels, 6))
    inverse = np.empty((voxels, 6))
    moments(points.xyz, grouping.rows, grouping.counts, mean, scatter)
    inverse_covariances(grouping.counts, scatter, 0, _LEAST_EIGENVALUE_RATIO, np.empty((0, 6)), inverse)
    return LayerTable(
        columns={
            "mean": mean,
            "inverse_covariance": inverse,
            "scatter": scatter,
            "count": grouping.counts.astype(np.uint32),
            "table": grouping.spread(np.arange(voxels, dtype=np.int32), -1),
        },
        rows=voxels,
        units={column.name: column.unit for column in NDT.columns},
        lattice=grouping.lattice,
    )


def voxel_covariances(
    counts: NDArray[np.generic],
    scatter: NDArray[np.generic],
    convention: Convention = "autoware",
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return covariance and inverse covariance of each voxel in one convention.

    Computed from the number of points n and their scatter S (sum of outer products of differences to the
    mean), they are exactly those of PCL, ndt_omp or Autoware:

    ========== ============================== ==========================================================
    convention covariance before regularising used by
    ========== ============================== ==========================================================
    autoware   (S + I) / (n - 1)              autoware_core, ndt_scan_matcher's multi-grid NDT since 2025
    pclomp     (S + I) / n * (n - 1) / n      koide3/ndt_omp; Autoware before
    pcl        S / (n - 1)                    PCL 1.12 and later
    ========== ============================== ==========================================================

    The identity matrix I arises because these implementations initialise a voxel's covariance with it and
    then add to it.  It widens voxels of few points, and so the basin of convergence.  Then all three raise a
    least eigenvalue below 0.01 times the greatest to that limit, and only in this case also the middle one
    (Magnusson 2009, 6.2).

    Parameters
    ----------
    counts
        (V,) points of each voxel.
    scatter
        (V, 6) sums xx, xy, xz, yy, yz, zz of products of differences to the mean, m^2.

    Returns
    -------
    covariance : (V, 6) float64, m^2
        After regularising; xx, xy, xz, yy, yz, zz.
    inverse : (V, 6) float64, 1/m^2
        Both are 0 for a voxel that the originals refuse: it has one point, or (``pcl``) all its points are
        identical.
    """
    with needed_packages("voxel_covariances()"):
        from shmmap.layers.kernels import inverse_covariances

    if convention not in CONVENTIONS:
        raise BadRequest(f"no convention {convention!r}", hint=f"conventions are: {', '.join(CONVENTIONS)}")
    covariance, inverse = np.empty((len(counts), 6)), np.empty((len(counts), 6))
    inverse_covariances(
        np.ascontiguousarray(counts, np.int32),
        np.ascontiguousarray(scatter, np.float64),
        CONVENTIONS.index(convention),
        _LEAST_EIGENVALUE_RATIO,
        covariance,
        inverse,
    )
    return covariance, inverse


NDT: Final = LayerKind(
    name="ndt",
    builder_version=1,
    summary="a Gaussian for each voxel: moments, inverse covariance in Autoware's convention, lookup table",
    borders=(
        "a voxel that a border of the cell cuts has a row in each cell, of that cell's points alone, as in"
        " Autoware; nothing is merged"
    ),
    parameters=(
        edge("leaf", "edge of a voxel", required=True),
        Parameter("min_points", int, "minimum points of a voxel", default=6, minimum=2, maximum=1 << 30),
    ),
    columns=(
        LayerColumn("mean", np.dtype("<f8"), "(rows, 3)", "m", "mean of the points", "map"),
        LayerColumn(
            "inverse_covariance",
            np.dtype("<f8"),
            "(rows, 6)",
            "1/m^2",
            "xx, xy, xz, yy, yz, zz of the inverse of (S + I)/(n - 1), regularised",
            "map",
        ),
        LayerColumn(
            "scatter",
            np.dtype("<f8"),
            "(rows, 6)",
            "m^2",
            "S: sums xx, xy, xz, yy, yz, zz of products of differences to the mean",
            "map",
        ),
        LayerColumn("count", np.dtype("<u4"), "(rows,)", "", "n: points of the voxel"),
        LayerColumn(
            "table", np.dtype("<i4"), "(nz, ny, nx)", "", "row of each voxel of the lattice box", missing="-1"
        ),
    ),
    build=build_ndt,
    bytes_ratio=0.1,
)
