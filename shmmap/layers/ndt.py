# SPDX-License-Identifier: Apache-2.0
"""The ``ndt`` layer: a Gaussian for each voxel, ready for scan matching without any further work.

Rows are the voxels of at least ``min_points`` points, x fastest, then y, then z.  ``table`` finds a
voxel's row without a tree: a point at ``(x, y, z)`` is in row ``table[k - k0, j - j0, i - i0]`` with
``i = floor(x * (1 / leaf))`` and so on (in the points' own precision, see `shmmap.layers.lattice_kernels`),
and ``(i0, j0, k0)`` the header's ``lattice_first``; -1: no row.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.covariance import LEAST_EIGENVALUE_RATIO
from shmmap.layers.lattice import dense_table, group_points

__all__ = ["KIND", "build_ndt"]


def build_ndt(points: PointTable, parameters: Parameters) -> LayerTable:
    """Compute moments and inverse covariances of each voxel.

    Parameters
    ----------
    parameters
        ``leaf`` metres, ``min_points``.

    Raises
    ------
    MapDataError
        If the lattice cannot hold the coordinates.
    """
    from shmmap.layers.ndt_kernels import inverse_covariances, moments

    leaf = float(parameters["leaf"])
    grouping = group_points(points.xyz, (leaf, leaf, leaf), least=int(parameters["min_points"]))
    voxels = len(grouping.counts)
    mean, scatter = np.empty((voxels, 3)), np.empty((voxels, 6))
    inverse = np.empty((voxels, 6))
    moments(points.xyz, grouping.rows, grouping.counts, mean, scatter)
    inverse_covariances(grouping.counts, scatter, 0, LEAST_EIGENVALUE_RATIO, np.empty((0, 6)), inverse)
    return LayerTable(
        columns={
            "mean": mean,
            "inverse_covariance": inverse,
            "scatter": scatter,
            "count": grouping.counts.astype(np.uint32),
            "table": dense_table(grouping),
        },
        rows=voxels,
        units={column.name: column.unit for column in KIND.columns},
        lattice=grouping.lattice,
    )


KIND: Final = LayerKind(
    name="ndt",
    builder_version=1,
    summary="a Gaussian for each voxel: moments, inverse covariance in Autoware's convention, lookup table",
    borders=(
        "a voxel that a border of the cell cuts has a row in each cell, of that cell's points alone, as in"
        " Autoware; nothing is merged"
    ),
    parameters=(
        Parameter("leaf", float, "edge of a voxel", "m", required=True, above=0.0, maximum=1e6),
        Parameter("min_points", int, "minimum points of a voxel", default=6, minimum=2, maximum=1 << 30),
    ),
    columns=(
        LayerColumn("mean", np.dtype("<f8"), "(rows, 3)", "m", "mean of the points, map frame"),
        LayerColumn(
            "inverse_covariance", np.dtype("<f8"), "(rows, 6)", "1/m^2",
            "xx, xy, xz, yy, yz, zz of the inverse of (S + I)/(n - 1), regularised",
        ),
        LayerColumn(
            "scatter", np.dtype("<f8"), "(rows, 6)", "m^2",
            "S: sums xx, xy, xz, yy, yz, zz of products of differences to the mean",
        ),
        LayerColumn("count", np.dtype("<u4"), "(rows,)", "", "n: points of the voxel"),
        LayerColumn(
            "table", np.dtype("<i4"), "(nz, ny, nx)", "", "row of each voxel of the lattice box, -1: none"
        ),
    ),
    build=build_ndt,
    bytes_ratio=0.1,
)  # fmt: skip
