# SPDX-License-Identifier: Apache-2.0
"""NDT as Magnusson (2009) writes it, from points to Hessian: slow, and without the programs' own code.

Voxels come from the points (chapter 6.1), the score from eq. 6.9, and its derivatives from the score itself:
the gradient by a complex step (exact to rounding), the Hessian by differences of gradients.  Which voxels a
point is scored against is decided at the pose and kept while differentiating, as in eq. 6.12 and 6.13.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

_LEAST_POINTS = 6
_LEAST_RATIO = 0.01  # of a covariance's eigenvalues, section 6.2.1
_COMPLEX_STEP = 1e-40
_STEP = 1e-6

Array = NDArray[np.float64]


def _covariance(points: Array, convention: str) -> Array:
    """By PCL the sample's; ndt_omp and Autoware begin their sums of products with a unit matrix."""
    n = len(points)
    off = points - points.mean(axis=0)
    scatter = off.T @ off
    if convention == "pcl":
        factor = 1 / (n - 1)
    else:
        scatter += np.eye(3)
        factor = 1 / (n - 1) if convention == "autoware" else (n - 1) / n**2
    return np.asarray(scatter * factor, np.float64)


class Textbook:
    """The Gaussians of clouds; where a border cuts a voxel, each cloud has its own part.

    Parameters
    ----------
    clouds
        (N, 3) float64 each.
    leaf
        Metres.
    convention
        Whose covariances: ``"pcl"`` (the textbook's), ``"pclomp"`` or ``"autoware"``.
    """

    def __init__(self, clouds: Iterable[NDArray[np.floating]], leaf: float, convention: str) -> None:
        members: dict[tuple[int, ...], list[Array]] = defaultdict(list)
        for number, cloud in enumerate(clouds):
            for point in cloud:
                index = (number, *(int(v) for v in np.floor(point / leaf)))
                members[index].append(point)
        self.leaf = leaf
        kept = {index: np.array(points) for index, points in members.items() if len(points) >= _LEAST_POINTS}
        self.index = np.array(list(kept))[:, 1:]
        self.mean = np.array([points.mean(axis=0) for points in kept.values()])
        inverses = []
        for points in kept.values():
            values, vectors = np.linalg.eigh(_covariance(points, convention))
            values = np.maximum(values, _LEAST_RATIO * values[-1])
            inverses.append(vectors @ np.diag(1 / values) @ vectors.T)
        self.inverse = np.array(inverses)
        c1, c2 = 10 * (1 - 0.55), 0.55 / leaf**3  # eq. 6.8
        d3 = -math.log(c2)
        self.d1 = -math.log(c1 + c2) - d3
        self.d2 = -2 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / self.d1)

    def near(self, points: Array, pose: Array, neighbors: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Pairs of a point's and a voxel's number."""
        moved = np.real(_moved(points, pose))
        if neighbors == "radius":
            hit = np.linalg.norm(moved[:, None] - self.mean, axis=2) <= self.leaf
        else:
            apart = np.abs(np.floor(moved / self.leaf)[:, None] - self.index).sum(axis=2)
            hit = apart <= (1 if neighbors == "direct7" else 0)
        a, b = np.nonzero(hit)
        return a, b

    def shares(
        self, points: Array, pose: Array, pairs: tuple[NDArray[np.int64], NDArray[np.int64]]
    ) -> NDArray[np.inexact]:
        """Eq. 6.9 of each pair, with the sign of the programs: more is better."""
        d = _moved(points, pose)[pairs[0]] - self.mean[pairs[1]]
        exponent = np.einsum("ni,nij,nj->n", d, self.inverse[pairs[1]], d)
        return np.asarray(-self.d1 * np.exp(-self.d2 / 2 * exponent))

    def derivatives(self, points: Array, pose: Array, neighbors: str) -> tuple[float, Array, Array]:
        """Score, gradient and Hessian at a pose vector."""
        pairs = self.near(points, pose, neighbors)

        def gradient(at: Array) -> Array:
            steps = np.eye(6) * 1j * _COMPLEX_STEP
            imaginary = [self.shares(points, at + step, pairs).sum().imag for step in steps]
            return np.array(imaginary) / _COMPLEX_STEP

        ahead, behind = (np.array([gradient(pose + s * _STEP * e) for e in np.eye(6)]) for s in (1, -1))
        score = float(self.shares(points, pose, pairs).sum())
        return score, gradient(pose), (ahead - behind) / (2 * _STEP)


def rotation(angles: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Rx Ry Rz of roll, pitch and yaw, which may be complex."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(rx @ ry @ rz)


def _moved(points: Array, pose: NDArray[np.inexact]) -> NDArray[np.inexact]:
    return np.asarray(points @ rotation(pose[3:]).T + pose[:3])
