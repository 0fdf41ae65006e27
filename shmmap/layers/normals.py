# SPDX-License-Identifier: Apache-2.0
"""The ``normals`` layer: the points with the direction of the surface at each, by Open3D."""

from __future__ import annotations

from typing import Final

import numpy as np

from shmmap.formats.open3d_package import load_open3d
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.neighbourhood import local_coordinates

__all__ = ["KIND", "build_normals"]


def build_normals(points: PointTable, parameters: Parameters) -> LayerTable:
    """Direction of least spread of the nearest ``neighbors`` points within ``radius`` of each point.

    Normals have length 1 and point up.  As in Open3D, a point with fewer than three points around it,
    itself included, has the normal (0, 0, 1).
    """
    o3d = load_open3d("the layer normals")
    finite = points.finite()
    table = points.selected(finite)
    normals = np.zeros((table.rows, 3), np.float32)
    if table.rows:
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(local_coordinates(points, finite))
        radius, most = float(parameters["radius"]), int(parameters["neighbors"])
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=most))
        found = np.asarray(cloud.normals)[: table.rows]
        normals[:] = np.where(found[:, 2:] < 0, -found, found)
    table.columns["normal"] = normals
    table.units = {**table.units, "normal": ""}
    return table


KIND: Final = LayerKind(
    name="normals",
    builder_version=1,
    summary="the points with the surface's normal at each, pointing up; every column",
    borders="neighbours' points within radius of the border are looked at: no seam",
    parameters=(
        Parameter("radius", float, "how far around a point", "m", required=True, above=0.0, maximum=50.0),
        Parameter("neighbors", int, "at most so many of the nearest", default=30, minimum=3, maximum=1000),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates, map frame, in the source's order"),
        LayerColumn("*", None, "as in the source", "", "every other field but one called normal"),
        LayerColumn("normal", np.dtype("<f4"), "(rows, 3)", "", "unit vector, z >= 0"),
    ),
    build=build_normals,
    halo_m=lambda parameters: float(parameters["radius"]),
    gives_points=True,
    takes_layers=False,
    needs=None,
    bytes_ratio=2.0,
)
