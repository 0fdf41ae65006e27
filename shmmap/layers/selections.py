# SPDX-License-Identifier: Apache-2.0
"""Layers whose rows are all or some of the source's points, in its order and with every column.

``crop`` keeps the points between two heights, ``sample`` every n-th point or a reproducible random choice,
``denoise`` the points that are not statistical outliers (as in PCL, with Open3D's neighbour search).
``normals`` adds the surface normal at each point, computed by Open3D.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.layers.contract import (
    OTHER_FIELDS,
    LayerColumn,
    LayerKind,
    LayerTable,
    Parameter,
    Parameters,
    PointTable,
)
from shmmap.open3d_loading import load_open3d

_XYZ: Final = LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates, in the source's order", "map")
_SOURCE_COLUMNS: Final = (_XYZ, OTHER_FIELDS)
_QUERIES_PER_BATCH: Final = 1 << 16


def build_crop(points: PointTable, parameters: Parameters) -> LayerTable:
    """Keep the points with ``z_min <= z <= z_max``, with every column."""
    z = points.xyz[:, 2]
    inside = points.finite()
    inside &= z >= float(parameters.get("z_min", -math.inf))
    inside &= z <= float(parameters.get("z_max", math.inf))
    return points.selected(inside)


def _resolve_crop(parameters: Parameters) -> Parameters:
    low, high = parameters.get("z_min", -math.inf), parameters.get("z_max", math.inf)
    if not parameters or low > high:
        raise BadRequest(
            "crop needs z_min, z_max, or both with z_min <= z_max", hint="such as crop(z_min=-2.0,z_max=3.0)"
        )
    return parameters


CROP: Final = LayerKind(
    name="crop",
    builder_version=1,
    summary="the points between two heights, with every column",
    borders="each point is judged alone",
    parameters=(
        Parameter("z_min", float, "lowest z kept", "m"),
        Parameter("z_max", float, "highest z kept", "m"),
    ),
    columns=_SOURCE_COLUMNS,
    build=build_crop,
    resolve=_resolve_crop,
    gives_points=True,
    needs=None,
    bytes_ratio=0.7,
)


def _mixed(rows: int, seed: int) -> NDArray[np.uint64]:
    """Return a random number for each row: SplitMix64 (Steele, Lea, Flood 2014) of seed and row.

    Unlike numpy's generators, it gives the same numbers in every version of numpy.
    """
    with np.errstate(over="ignore"):
        state = np.arange(1, rows + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        state += np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed: NDArray[np.uint64] = state ^ (state >> np.uint64(31))
    return mixed


def build_sample(points: PointTable, parameters: Parameters) -> LayerTable:
    """Sample points, in the source's order and with every column."""
    rows = np.flatnonzero(points.finite())
    if "every" in parameters:
        return points.selected(rows[:: int(parameters["every"])])
    count = int(parameters["count"])
    if count < len(rows):
        chosen = np.argsort(_mixed(len(rows), int(parameters["seed"])), kind="stable")[:count]
        rows = rows[np.sort(chosen)]
    return points.selected(rows)


def _resolve_sample(parameters: Parameters) -> Parameters:
    if ("every" in parameters) == ("count" in parameters):
        raise BadRequest(
            "sample needs either every or count", hint="such as sample(every=10) or sample(count=5000,seed=1)"
        )
    if "every" in parameters:
        if parameters["seed"] != 0:
            raise BadRequest("sample: seed belongs to count")
        return {"every": parameters["every"]}
    return parameters


SAMPLE: Final = LayerKind(
    name="sample",
    builder_version=1,
    summary="some of the points, with every column: every n-th, or a random choice",
    borders="each cell is sampled alone: count is a cell's, and every begins with a cell's first point",
    parameters=(
        Parameter(
            "every", int, "keep the first of each group of this many points", minimum=1, maximum=1 << 40
        ),
        Parameter("count", int, "number of points to keep, chosen at random", minimum=1, maximum=1 << 40),
        Parameter("seed", int, "which random choice", default=0, minimum=0, maximum=(1 << 32) - 1),
    ),
    columns=_SOURCE_COLUMNS,
    build=build_sample,
    resolve=_resolve_sample,
    gives_points=True,
    needs=None,
    bytes_ratio=0.5,
)


def build_denoise(points: PointTable, parameters: Parameters) -> LayerTable:
    """Drop points that lie far from their neighbours.

    Each point's mean distance to its ``neighbors`` nearest other points is compared with the mean of
    these means plus ``std_ratio`` standard deviations (n - 1), over the cell's own points.  If there are
    fewer than ``neighbors`` other points, all of them count; a point without neighbours is kept.
    """
    finite = points.finite()
    rows = np.flatnonzero(finite)
    if len(rows) > 1:
        distances = _mean_distances(
            _local_coordinates(points, finite), len(rows), int(parameters["neighbors"])
        )
        limit = distances.mean() + float(parameters["std_ratio"]) * distances.std(ddof=1)
        rows = rows[distances <= limit]
    return points.selected(rows)


def _mean_distances(xyz: NDArray[np.float64], queries: int, neighbours: int) -> NDArray[np.float64]:
    """Return the mean distance of each of the first ``queries`` points to its nearest other points."""
    o3d = load_open3d("the layer denoise")
    core = o3d.core
    search = core.nns.NearestNeighborSearch(core.Tensor(xyz))
    search.knn_index()
    wanted = min(neighbours + 1, len(xyz))
    means = np.empty(queries)
    for at in range(0, queries, _QUERIES_PER_BATCH):
        end = min(queries, at + _QUERIES_PER_BATCH)
        _, squared = search.knn_search(core.Tensor(np.ascontiguousarray(xyz[at:end])), wanted)
        # the nearest point is the point itself or a duplicate, at distance 0 in both cases
        means[at:end] = np.sqrt(squared.numpy()[:, 1:]).mean(axis=1)
    return means


DENOISE: Final = LayerKind(
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
    columns=_SOURCE_COLUMNS,
    build=build_denoise,
    halo_m=lambda parameters: float(parameters["halo"]),
    gives_points=True,
    takes_layers=False,
    needs=None,
    bytes_ratio=1.0,
)


def build_normals(points: PointTable, parameters: Parameters) -> LayerTable:
    """Compute normals: the direction of least spread of the nearest points within ``radius`` of each point.

    At most ``neighbors`` points are used.  Normals have length 1 and point up.  As in Open3D, a point with
    fewer than three points around it, itself included, has the normal (0, 0, 1).
    """
    o3d = load_open3d("the layer normals")
    finite = points.finite()
    table = points.selected(finite)
    normals = np.zeros((table.rows, 3), np.float32)
    if table.rows:
        cloud = o3d.geometry.PointCloud()
        cloud.points = o3d.utility.Vector3dVector(_local_coordinates(points, finite))
        radius, most = float(parameters["radius"]), int(parameters["neighbors"])
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=radius, max_nn=most))
        found = np.asarray(cloud.normals)[: table.rows]
        normals[:] = np.where(found[:, 2:] < 0, -found, found)
    table.columns["normal"] = normals
    table.units = {**table.units, "normal": ""}
    return table


NORMALS: Final = LayerKind(
    name="normals",
    builder_version=1,
    summary="the points with the surface's normal at each, pointing up; every column",
    borders="neighbours' points within radius of the border are looked at: no seam",
    parameters=(
        Parameter("radius", float, "how far around a point", "m", required=True, above=0.0, maximum=50.0),
        Parameter(
            "neighbors",
            int,
            "greatest number of nearest points to look at",
            default=30,
            minimum=3,
            maximum=1000,
        ),
    ),
    columns=(
        _XYZ,
        OTHER_FIELDS,
        LayerColumn("normal", np.dtype("<f4"), "(rows, 3)", "", "unit vector, z >= 0", "map"),
    ),
    build=build_normals,
    halo_m=lambda parameters: float(parameters["radius"]),
    gives_points=True,
    takes_layers=False,
    needs=None,
    bytes_ratio=2.0,
)


def _local_coordinates(points: PointTable, finite: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return a cell's finite points, then its halo, (N + M, 3) float64, relative to the first point.

    With absolute coordinates, Open3D's sums would lose digits far from the map's origin.
    """
    own = points.xyz[finite].astype(np.float64)
    if points.halo is None or not len(points.halo) or not len(own):
        return own - own[:1]
    halo = points.halo[np.isfinite(points.halo).all(axis=1)].astype(np.float64)
    local: NDArray[np.float64] = np.concatenate([own, halo]) - own[:1]
    return local
