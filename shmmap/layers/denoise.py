# SPDX-License-Identifier: Apache-2.0
"""The ``denoise`` layer: statistical outlier removal, as PCL has it, with Open3D's neighbour search."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.open3d_package import load_open3d
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter, Parameters, PointTable
from shmmap.layers.neighbourhood import local_coordinates

__all__ = ["KIND", "build_denoise"]

_QUERIES_AT_ONCE: Final = 1 << 16


def build_denoise(points: PointTable, parameters: Parameters) -> LayerTable:
    """Drop points that lie far from their neighbours.

    Each point's mean distance to its ``neighbors`` nearest other points is compared with the mean of
    these means plus ``std_ratio`` standard deviations (n - 1), over the cell's own points.  Where
    there are fewer other points, all of them count; a point without any stays.
    """
    finite = points.finite()
    rows = np.flatnonzero(finite)
    if len(rows) > 1:
        distances = _mean_distances(
            local_coordinates(points, finite), len(rows), int(parameters["neighbors"])
        )
        limit = distances.mean() + float(parameters["std_ratio"]) * distances.std(ddof=1)
        rows = rows[distances <= limit]
    return points.selected(rows)


def _mean_distances(xyz: NDArray[np.float64], queries: int, neighbours: int) -> NDArray[np.float64]:
    """Mean distance of the first ``queries`` points to their nearest others."""
    o3d = load_open3d("the layer denoise")
    core = o3d.core
    search = core.nns.NearestNeighborSearch(core.Tensor(xyz))
    search.knn_index()
    wanted = min(neighbours + 1, len(xyz))
    means = np.empty(queries)
    for at in range(0, queries, _QUERIES_AT_ONCE):
        end = min(queries, at + _QUERIES_AT_ONCE)
        _, squared = search.knn_search(core.Tensor(np.ascontiguousarray(xyz[at:end])), wanted)
        # the nearest is the point itself, or one that lies where it does: 0 away either way
        means[at:end] = np.sqrt(squared.numpy()[:, 1:]).mean(axis=1)
    return means


KIND: Final = LayerKind(
    name="denoise",
    builder_version=1,
    summary="the points without statistical outliers, with every column",
    borders=(
        "neighbours' points within halo of the border count as neighbours; the threshold is of each cell's"
        " own points"
    ),
    parameters=(
        Parameter("neighbors", int, "nearest other points to look at", default=20, minimum=1, maximum=1000),
        Parameter("std_ratio", float, "standard deviations above the mean", default=2.0, minimum=0.0),
        Parameter(
            "halo", float, "how far beyond the cell to look", "m", default=1.0, minimum=0.0, maximum=50.0
        ),
    ),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates, map frame, in the source's order"),
        LayerColumn("*", None, "as in the source", "", "every other field"),
    ),
    build=build_denoise,
    halo_m=lambda parameters: float(parameters["halo"]),
    gives_points=True,
    takes_layers=False,
    needs=None,
    bytes_ratio=1.0,
)
