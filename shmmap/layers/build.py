# SPDX-License-Identifier: Apache-2.0
"""Layers of plain arrays: the same builders that the daemon's workers run, without a daemon.

::

    from shmmap.layers import build_layer

    ndt = build_layer("ndt(leaf=2.0)", xyz)
    ndt["mean"], ndt["inverse_covariance"], ndt.lattice
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest, InternalError
from shmmap.layers.contract import BUILT_ANYWHERE, Box, Columns, LayerTable, PointTable
from shmmap.layers.spec import LayerSpec, parse_layer
from shmmap.optional_packages import needed_packages

__all__ = ["build_layer", "build_spec"]


def build_layer(
    layer: str | LayerSpec,
    points: NDArray[np.generic] | Mapping[str, NDArray[np.generic]],
    *,
    units: Mapping[str, str] | None = None,
    box: Box = BUILT_ANYWHERE,
    halo: NDArray[np.generic] | None = None,
) -> LayerTable:
    """Build one layer of a cloud.

    Parameters
    ----------
    layer
        A layer spec, such as ``voxel(leaf=0.5)``.
    points
        (N, 3) float32 or float64, metres; or named columns, ``xyz`` among them, all of N rows.
        Other dtypes of coordinates become float64.
    units
        Unit of each column, for the table's.
    box
        (min_x, min_y, max_x, max_y) of the cell, metres; only kinds with a halo look at it.
    halo
        (M, 3) coordinates of points around the cell, for such kinds.

    Returns
    -------
    The layer; points that are not finite are left out.

    Raises
    ------
    BadRequest
        If the spec or the arrays make no sense.
    MapDataError
        If the points cannot be turned into this layer.
    PackageMissing
        If a package that builds it is not installed.
    """
    spec = parse_layer(layer) if isinstance(layer, str) else layer
    given = points if isinstance(points, Mapping) else {"xyz": points}
    columns = _checked(given)
    around = None
    if halo is not None:
        around = np.ascontiguousarray(_checked({"xyz": halo})["xyz"], columns["xyz"].dtype)
    with needed_packages(f"layer {spec.kind.name}"):
        return build_spec(spec, PointTable(columns, dict(units or {}), box, around))


def build_spec(spec: LayerSpec, points: PointTable) -> LayerTable:
    """Build a layer along its chain from the source's points."""
    if spec.of is not None:
        below = build_spec(spec.of, points)
        points = PointTable(below.columns, below.units, points.box)
    table = spec.kind.build(points, spec.parameters)
    for name, column in table.columns.items():
        if not column.flags.c_contiguous or column.dtype.kind not in "fiu" or column.ndim > 4:
            raise InternalError(f"{spec.kind.name}: column {name} is not a contiguous numeric array")
    return table


def _checked(columns: Mapping[str, NDArray[np.generic]]) -> Columns:
    if "xyz" not in columns:
        raise BadRequest("points need a column xyz")
    checked = {name: np.ascontiguousarray(column) for name, column in columns.items()}
    xyz = checked["xyz"]
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise BadRequest(f"xyz must have shape (N, 3), not {xyz.shape} of {xyz.dtype}")
    if xyz.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        checked["xyz"] = xyz.astype(np.float64)
    for name, column in checked.items():
        if column.ndim not in (1, 2) or len(column) != len(xyz) or column.dtype.kind not in "fiu":
            raise BadRequest(
                f"column {name!r} must be numeric with {len(xyz)} rows, not {column.shape} of {column.dtype}"
            )
    return checked
