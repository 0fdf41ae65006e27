# SPDX-License-Identifier: Apache-2.0
"""Slow, independent answers to what layers hold, and a package that offers layer kinds by entry point."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def voxels_of(xyz: NDArray[Any], leaf: tuple[float, float, float]) -> dict[tuple[int, int, int], list[int]]:
    """Which points lie in which voxel of the global lattice, by index (x, y, z).

    The index is computed in the points' own precision, as PCL does: ``floor(x * (1 / leaf))``.
    Points that are not finite are in none.
    """
    real = xyz.dtype.type
    inverse = [real(1) / real(edge) for edge in leaf]
    found: defaultdict[tuple[int, int, int], list[int]] = defaultdict(list)
    for number, point in enumerate(xyz):
        if np.isfinite(point).all():
            i, j, k = (int(np.floor(real(value * by))) for value, by in zip(point, inverse, strict=True))
            found[i, j, k].append(number)
    return dict(found)


def covariance_of(
    points: NDArray[Any], convention: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Covariance after regularising, and its inverse, (3, 3) each, of one voxel's points.

    ``autoware``: the covariance starts as the identity, outer products are added, the product of sum
    and mean is subtracted, all divided by n - 1.  ``pclomp``: (identity and sums, divided by n, minus
    the mean's outer product as ndt_omp writes it) times (n - 1) / n.  ``pcl``: S / (n - 1).  None where
    there is nothing to invert.
    """
    n = len(points)
    if n < 2:
        return None
    shifted = np.asarray(points, np.float64)
    about = shifted[0]
    shifted = shifted - about
    mean = shifted.mean(axis=0)
    products = sum((np.outer(p, p) for p in shifted), np.zeros((3, 3)))
    start = np.zeros((3, 3)) if convention == "pcl" else np.eye(3)
    if convention == "pclomp":
        covariance = ((start + products) / n - np.outer(mean, mean)) * (n - 1) / n
    else:
        covariance = (start + products - n * np.outer(mean, mean)) / (n - 1)
    values, vectors = np.linalg.eigh(covariance)
    if values[2] <= 0 or values[0] < -1e-12 * values[2]:
        return None
    floor = 0.01 * values[2]
    if values[0] < floor:
        values[0] = floor
        if values[1] < floor:
            values[1] = floor
        covariance = vectors @ np.diag(values) @ np.linalg.inv(vectors)
    return covariance, np.linalg.inv(covariance).astype(np.float64)


def columns_of(xyz: NDArray[Any], edge: float) -> dict[tuple[int, int], list[int]]:
    """Which points lie in which column of the global ground grid, by index (x, y)."""
    found: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
    for (i, j, _), rows in voxels_of(xyz, (edge, edge, 1e30)).items():
        found[i, j] += rows
    return {index: sorted(rows) for index, rows in found.items()}


def fitted_height(xyz: NDArray[Any], x: float, y: float, margin_m: float = 1.0) -> float | None:
    """Autoware's map_height_fitter: the lowest z of points closer than the nearest one's distance + 1 m."""
    finite = np.asarray(xyz, np.float64)[np.isfinite(xyz).all(axis=1)]
    if not len(finite):
        return None
    distance = np.hypot(finite[:, 0] - x, finite[:, 1] - y)
    return float(finite[distance < distance.min() + margin_m, 2].min())


def _distances(points: NDArray[Any], place: NDArray[Any]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = np.linalg.norm(points.astype(np.float64) - place.astype(np.float64), axis=1)
    return found


def inliers_of(
    xyz: NDArray[Any], neighbours: int, std_ratio: float, halo: NDArray[Any] | None = None
) -> tuple[NDArray[np.float64], float]:
    """Mean distance of each point to its nearest others, and the threshold: PCL's outlier removal."""
    around = xyz if halo is None else np.concatenate([xyz, halo])
    means = np.zeros(len(xyz))
    for number, point in enumerate(xyz):
        others = np.sort(np.delete(_distances(around, point), number))[:neighbours]
        means[number] = others.mean() if len(others) else 0.0
    spread = means.std(ddof=1) if len(means) > 1 else 0.0
    return means, float(means.mean() + std_ratio * spread) if len(means) else 0.0


def normal_of(
    xyz: NDArray[Any], number: int, radius: float, neighbours: int
) -> tuple[NDArray[np.float64], float]:
    """Normal of a plane through the nearest points within a radius, and how clearly it is one.

    The clearness is the gap between the two least eigenvalues of the covariance over the greatest: where
    it is near 0 any direction is as good.
    """
    distance = _distances(xyz, xyz[number])
    near = np.argsort(distance, kind="stable")[:neighbours]
    if (np.abs(distance - radius) < 1e-6).any():
        return np.array([0.0, 0.0, 1.0]), 0.0
    near = near[distance[near] < radius]
    if len(near) < 3:
        return np.array([0.0, 0.0, 1.0]), 1.0
    points = np.asarray(xyz[near], np.float64) - np.asarray(xyz[number], np.float64)
    values, vectors = np.linalg.eigh(np.cov(points.T))
    normal = vectors[:, 0].astype(np.float64)
    clear = (values[1] - values[0]) / values[2] if values[2] > 0 else 0.0
    return (normal if normal[2] >= 0 else -normal), float(clear)


# A package that offers layer kinds by entry point, made on the spot, as users would install it


MODULE = '''
import os
import numpy as np
from shmmap.layers.contract import LayerColumn, LayerKind, LayerTable, Parameter


def around(points, parameters):
    """Per cell: how many points it has, and how many its neighbours have within the radius."""
    halo = points.halo if points.halo is not None else np.empty((0, 3))
    counts = np.array([len(points), len(halo)], np.int64)
    return LayerTable({"counts": counts}, rows=2, units={"counts": ""})


def broken(points, parameters):
    if parameters["how"] == 1:
        os.abort()
    raise RuntimeError("the builder has a defect")


AROUND = LayerKind(
    name="around", builder_version=1, summary="counts points", borders="looks radius beyond",
    parameters=(Parameter("radius", float, "how far", "m", required=True, above=0.0, maximum=100.0),),
    columns=(LayerColumn("counts", np.dtype("<i8"), "(2,)", "", "own and around"),),
    build=around, halo_m=lambda parameters: float(parameters["radius"]), takes_layers=False,
)
BROKEN = LayerKind(
    name="broken", builder_version=1, summary="fails", borders="none",
    parameters=(Parameter("how", int, "0 raises, 1 aborts", default=0, minimum=0, maximum=1),),
    columns=(), build=broken,
)
'''

ENTRY_POINTS = """
[shmmap.layers]
around = offered_kinds:AROUND
broken = offered_kinds:BROKEN
absent = offered_kinds_that_do_not_exist:KIND
"""


def install(directory: Path) -> str:
    """Make the package in ``directory``; returns what to put on the module path."""
    information = directory / "offered_kinds-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: offered-kinds\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRY_POINTS)
    (directory / "offered_kinds.py").write_text(MODULE)
    return str(directory)
