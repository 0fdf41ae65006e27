# SPDX-License-Identifier: Apache-2.0
"""Score and derivatives of one pose, and the sums that every backend brings to them.

For a neighbour with inverse covariance C and offset d = Rx + t - mean, q = C d and w = d1 d2 exp(-d2/2 d.q),
gradient and Hessian need only A = sum w q and B = sum w (C - d2 q q^T) per point: the derivatives J of
Rx + t follow from x alone, so that J^T A and J^T B J are formed once per point, and everything that is linear
in x is contracted once per evaluation.  That is 33 sums instead of a 6 x 6 matrix per neighbour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import euler_derivatives

__all__ = [
    "AX",
    "BJ",
    "CHUNK_POINTS",
    "CUT_NEIGHBOURS",
    "CUT_POINTS",
    "FOUND",
    "JBJ",
    "NEAREST",
    "NEGLIGIBLE_EXPONENT",
    "NEIGHBOURS",
    "NOTHING",
    "SCORE",
    "SUMS",
    "A",
    "B",
    "Evaluation",
    "Gauss",
    "gauss_for",
    "search_columns",
    "total",
]

# Where what lies in a row of sums.
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
SUMS: Final = 40  # a row, padded to whole cache lines

CHUNK_POINTS: Final = 128  # summed in one go; fixed, so that the number of threads changes nothing
NEGLIGIBLE_EXPONENT: Final = 36.7  # exp(-36.7) is less than half a unit in the last place of 1

_OUTLIER_RATIO: Final = 0.55


@dataclass(frozen=True, slots=True)
class Gauss:
    """Constants d1 and d2 of the score, eq. 6.8 of Magnusson 2009."""

    d1: float
    d2: float


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
    """What one pose is worth.

    Attributes
    ----------
    score
        Sum over points and neighbours of -d1 exp(...).
    gradient : (6,) float64
    hessian : (6, 6) float64
        Of the score after the pose vector.
    nearest
        Sum over points of the best neighbour's share.
    found
        Points with at least one neighbour.
    neighbours
        Neighbours over all points.
    cut_points, cut_neighbours
        Points that had more neighbours than the limit, and how many were left out.
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
"""What a pose without any neighbour is worth."""


def total(rows: NDArray[np.float64], pose: NDArray[np.float64], pitch_sign: float) -> Evaluation:
    """Add rows of sums, in their order, and contract them to an evaluation.

    Parameters
    ----------
    rows : (chunks, `SUMS`) float64
    pose : (6,) float64
    pitch_sign
        As in `euler_derivatives`.
    """
    sums = np.add.accumulate(rows, axis=0)[-1] if len(rows) else np.zeros(SUMS)
    contracted = (euler_derivatives(pose, pitch_sign).reshape(9, 9) @ sums[AX]).tolist()
    a, b, bj, jbj = sums[A].tolist(), sums[B].tolist(), sums[BJ].tolist(), sums[JBJ].tolist()
    gradient = np.array([*a, *contracted[:3]])
    rotation = [value + second for value, second in zip(jbj, contracted[3:], strict=True)]
    rr, rp, ry, pp, py, yy = rotation
    hessian = np.array(
        [
            [b[0], b[1], b[2], bj[0], bj[1], bj[2]],
            [b[1], b[3], b[4], bj[3], bj[4], bj[5]],
            [b[2], b[4], b[5], bj[6], bj[7], bj[8]],
            [bj[0], bj[3], bj[6], rr, rp, ry],
            [bj[1], bj[4], bj[7], rp, pp, py],
            [bj[2], bj[5], bj[8], ry, py, yy],
        ]
    )
    return Evaluation(
        score=float(sums[SCORE]),
        gradient=gradient,
        hessian=hessian,
        nearest=float(sums[NEAREST]),
        found=int(sums[FOUND]),
        neighbours=int(sums[NEIGHBOURS]),
        cut_points=int(sums[CUT_POINTS]),
        cut_neighbours=int(sums[CUT_NEIGHBOURS]),
    )
