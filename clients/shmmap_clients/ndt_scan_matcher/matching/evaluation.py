# SPDX-License-Identifier: Apache-2.0
"""Pose vectors, and their evaluation: score, gradient and Hessian.

A pose vector is (x, y, z, roll, pitch, yaw), metres and radians, with R = Rx(roll) Ry(pitch) Rz(yaw), as
in PCL, ndt_omp and Autoware.

For a neighbour with inverse covariance C and offset d = Rx + t - mean, q = C d and w = d1 d2 exp(-d2/2 d.q),
gradient and Hessian need only A = sum w q and B = sum w (C - d2 q q^T) per point: the derivatives J of
Rx + t follow from x alone, so that J^T A and J^T B J are formed once per point, and everything that is linear
in x is contracted once per evaluation.  Each backend computes these 33 sums, see `SUMS`, instead of a
6 x 6 matrix per neighbour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance

Neighbors = Literal["direct1", "direct7", "radius"]

# Index of each sum in a row.
SCORE: Final = 0
NEAREST: Final = 1
FOUND: Final = 2
NEIGHBOURS: Final = 3
CUT_POINTS: Final = 4
CUT_NEIGHBOURS: Final = 5
A: Final = slice(6, 9)
AX: Final = slice(9, 18)
B: Final = slice(18, 24)
BJ: Final = slice(24, 33)
JBJ: Final = slice(33, 39)
SUMS: Final = 40  # numbers in a row, padded to whole cache lines

CHUNK_POINTS: Final = 128  # summed together; fixed, so that results do not depend on threads
NEGLIGIBLE_EXPONENT: Final = 36.7  # exp(-36.7) is less than half a unit in the last place of 1

_OUTLIER_RATIO: Final = 0.55


@dataclass(frozen=True, slots=True)
class Scoring:
    """Parameters of the score of a pose.

    Attributes
    ----------
    neighbors
        The voxels that a point is scored against: its own voxel (``"direct1"``), also the six voxels at
        its faces (``"direct7"``), or all voxels whose mean is within one leaf (``"radius"``).
    covariance
        Rule that derives voxels' covariances from their moments.
    pitch_sign
        Sign of the sine in the second derivative by pitch: -1 is right, ndt_omp uses +1.
    deadline_s
        Deadline on `time.monotonic` for a device; after it, `DeviceHung` is raised.  None: only the
        backend's own limit.
    """

    neighbors: Neighbors
    covariance: Covariance
    pitch_sign: float = -1.0
    deadline_s: float | None = None


def matrix_from_pose(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) transform of a pose vector."""
    x, y, z, roll, pitch, yaw = pose.tolist()
    cx, sx = math.cos(roll), math.sin(roll)
    cy, sy = math.cos(pitch), math.sin(pitch)
    cz, sz = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cz, -cy * sz, sy, x],
            [cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, y],
            [sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def pose_from_matrix(T: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the pose vector of a (4, 4) transform; pitch lies within a quarter turn."""
    matrix = np.asarray(T, np.float64)
    roll = math.atan2(-matrix[1, 2], matrix[2, 2])
    pitch = math.atan2(matrix[0, 2], math.hypot(matrix[0, 0], matrix[0, 1]))
    yaw = math.atan2(-matrix[0, 1], matrix[0, 0])
    return np.array([*matrix[:3, 3], roll, pitch, yaw])


@dataclass(frozen=True, slots=True)
class Gauss:
    """Constants d1 and d2 of the score, eq. 6.8 of Magnusson 2009."""

    d1: float
    d2: float


@lru_cache(maxsize=16)
def gauss_for(leaf: float) -> Gauss:
    """Return the constants for a leaf size in metres, with the originals' outlier ratio of 0.55."""
    c1 = 10.0 * (1.0 - _OUTLIER_RATIO)
    c2 = _OUTLIER_RATIO / leaf**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    return Gauss(d1, -2.0 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1))


def search_columns(neighbors: str) -> NDArray[np.int64]:
    """Return the lattice columns to look at around a point's own: (di, dj, first dk, last dk)."""
    if neighbors == "direct1":
        return np.array([[0, 0, 0, 0]], np.int64)
    if neighbors == "direct7":
        return np.array([[0, 0, -1, 1], [-1, 0, 0, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 1, 0, 0]], np.int64)
    return np.array([[i, j, -1, 1] for i in (-1, 0, 1) for j in (-1, 0, 1)], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Evaluation of one pose.

    Attributes
    ----------
    score
        Sum over points and neighbours of -d1 exp(...).
    gradient : (6,) float64
    hessian : (6, 6) float64
        Second derivatives of the score by the pose vector.
    nearest
        Sum over points of the best neighbour's term.
    found
        Number of points with at least one neighbour.
    neighbours
        Number of neighbours over all points.
    cut_points, cut_neighbours
        Number of points with more neighbours than the limit, and of neighbours left out.
    """

    score: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]
    nearest: float
    found: int
    neighbours: int
    cut_points: int
    cut_neighbours: int

    @property
    def nvtl(self) -> float:
        """Nearest-voxel transformation likelihood; zero where no point has a neighbour."""
        return self.nearest / self.found if self.found else 0.0


NOTHING: Final = Evaluation(0.0, np.zeros(6), np.zeros((6, 6)), 0.0, 0, 0, 0, 0)
"""Evaluation of a pose without any neighbour."""
