# SPDX-License-Identifier: Apache-2.0
"""The score by its definition, one point and one voxel at a time: slow, and independent of the kernels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import VoxelMap
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance

FACES = {(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)}


def rotation(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Rx Ry Rz, as products of the three."""
    c, s = math.cos, math.sin
    rx = np.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    ry = np.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    rz = np.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    return np.asarray(rx @ ry @ rz, np.float64)


def gaussians(
    voxel_map: VoxelMap, covariance: Covariance
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]]:
    """Lattice index, mean and inverse covariance of every voxel."""
    for key, cell in voxel_map.cells.items():
        inverse = voxel_map.inverses(key, covariance)
        for place in np.argwhere(cell.lattice >= 0):
            row = cell.lattice[tuple(place)]
            if inverse[row, 0] > 0:
                yield (
                    place + cell.lattice_origin,
                    cell.mean[row] + cell.origin,
                    inverse[row][[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3),
                )


def score(
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
    voxel_map: VoxelMap,
    covariance: Covariance,
    neighbors: str,
) -> tuple[float, float, int, int]:
    """Score, sum of best shares, points with a neighbour, neighbours."""
    leaf = voxel_map.leaf
    c1, c2 = 10 * (1 - 0.55), 0.55 / leaf**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    d2 = -2 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)
    all_gaussians = list(gaussians(voxel_map, covariance))
    R = rotation(*pose[3:])
    total = nearest = 0.0
    found = number = 0
    for x in points:
        y = R @ x + pose[:3]
        own = np.floor(y / leaf).astype(int)
        shares = []
        for index, mean, inverse in all_gaussians:
            step = tuple(int(v) for v in index - own)
            if neighbors == "radius":
                near = float(np.linalg.norm(y - mean)) <= leaf
            else:
                near = step in (FACES if neighbors == "direct7" else {(0, 0, 0)})
            if near:
                d = y - mean
                shares.append(-d1 * math.exp(-d2 / 2 * float(d @ inverse @ d)))
        if shares:
            found += 1
            number += len(shares)
            total += sum(shares)
            nearest += max(shares)
    return total, nearest, found, number
