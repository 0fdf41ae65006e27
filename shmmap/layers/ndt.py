# SPDX-License-Identifier: Apache-2.0
"""The ``ndt`` layer: a Gaussian for each voxel, ready for scan matching without any further work.

Rows are the voxels of at least ``min_points`` points, x fastest, then y, then z.  ``table`` finds a
voxel's row without a tree: a point at ``(x, y, z)`` is in row ``table[k - k0, j - j0, i - i0]`` with
``i = floor(x * (1 / leaf))`` and so on (in the points' own precision, see `shmmap.layers.lattice_kernels`),
and ``(i0, j0, k0)`` the header's ``lattice_first``; -1: no row.
"""

from __future__ import annotations

from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.lattice import dense_table, group_points
from shmmap.optional_packages import needed_packages

__all__ = ["CONVENTIONS", "NDT", "Convention", "build_ndt", "voxel_covariances"]

Convention: TypeAlias = Literal["autoware", "pclomp", "pcl"]
CONVENTIONS: Final[tuple[Convention, ...]] = ("autoware", "pclomp", "pcl")
_LEAST_EIGENVALUE_RATIO: Final = 0.01
"""``min_covar_eigvalue_mult_`` of PCL's VoxelGridCovariance and of its descendants."""


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
    inverse_covariances(grouping.counts, scatter, 0, _LEAST_EIGENVALUE_RATIO, np.empty((0, 6)), inverse)
    return LayerTable(
        columns={
            "mean": mean,
            "inverse_covariance": inverse,
            "scatter": scatter,
            "count": grouping.counts.astype(np.uint32),
            "table": dense_table(grouping),
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

    Of one set of moments, n points and their scatter S (sum of outer products of differences to the mean),
    they are exactly those of PCL, ndt_omp or Autoware:

    ========== ============================== ==========================================================
    convention covariance before regularising whose
    ========== ============================== ==========================================================
    autoware   (S + I) / (n - 1)              autoware_core, ndt_scan_matcher's multi-grid NDT since 2025
    pclomp     (S + I) / n * (n - 1) / n      koide3/ndt_omp; Autoware before
    pcl        S / (n - 1)                    PCL 1.12 and later
    ========== ============================== ==========================================================

    The identity comes from a leaf whose covariance starts as one and is summed into; it widens small
    voxels, and with it the basin of convergence.  Then all three raise a least eigenvalue below 0.01
    times the greatest to that, and only if they did so the middle one too (Magnusson 2009, 6.2).

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
        Both are 0 where the originals refuse a voxel: it has one point, or (``pcl``) all of its
        points are the same.
    """
    with needed_packages("voxel_covariances()"):
        from shmmap.layers.ndt_kernels import inverse_covariances

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
