# SPDX-License-Identifier: Apache-2.0
"""A street of walls, ground and poles, cut into cells; scans of it with known poses; frames of a drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import (
    Backend,
    Evaluation,
    NdtMatcher,
    Scoring,
    VoxelCell,
    VoxelMap,
    matrix_from_pose,
    voxel_cell,
)
from shmmap_clients.ndt_scan_matcher.drive.follower import Frame

Points = NDArray[np.float64]

TRUTH = np.array([1.3, 0.4, 1.8, 0.02, -0.03, 0.4])
"""Pose of a scan in the street."""
NEAR = TRUTH + np.array([0.2, -0.15, 0.1, 0.01, 0.02, -0.03])
GUESS = matrix_from_pose(TRUTH + np.array([0.4, -0.3, 0.2, 0.01, 0.02, -0.04]))


def street(seed: int = 1) -> Points:
    """Points of a street of 60 m x 24 m about the origin, 1 cm of noise, (N, 3), metres."""
    rng = np.random.default_rng(seed)
    n = 12_000
    ground = np.stack([rng.uniform(-30, 30, n), rng.uniform(-12, 12, n), np.zeros(n)], axis=1)
    left = np.stack([rng.uniform(-30, 30, n), np.full(n, 9.0), rng.uniform(0, 6, n)], axis=1)
    right = np.stack([rng.uniform(-30, 30, n), np.full(n, -8.0), rng.uniform(0, 5, n)], axis=1)
    # fronts that stand out: without them nothing holds a scan along the street
    parts = [ground, left, right]
    for x in range(-28, 29, 7):
        m = 900
        face = [np.full(m, float(x)), rng.uniform(6.5, 9, m), rng.uniform(0, 6, m)]
        back = [np.full(m, x + 2.5), rng.uniform(-8, -5.5, m), rng.uniform(0, 5, m)]
        pole = [rng.normal(x + 1.0, 0.05, 300), rng.normal(4.0, 0.05, 300), rng.uniform(0, 4, 300)]
        parts += [np.stack(face, axis=1), np.stack(back, axis=1), np.stack(pole, axis=1)]
    points = np.concatenate(parts)
    return points + rng.normal(0, 0.01, points.shape)


def squares_of(points: NDArray[np.floating], edge: float = 20.0) -> dict[str, NDArray[np.floating]]:
    """Cut a cloud into square cells."""
    index = np.floor(points[:, :2] / edge).astype(int)
    return {
        f"{i}_{j}": points[(index == (i, j)).all(axis=1)]
        for i, j in sorted({(int(i), int(j)) for i, j in index})
    }


def cells_of(points: NDArray[np.floating], leaf: float, edge: float = 20.0) -> dict[str, VoxelCell]:
    """Cut a cloud into square cells and compute the Gaussians of each."""
    return {name: voxel_cell(cloud, leaf) for name, cloud in squares_of(points, edge).items()}


def map_of(points: NDArray[np.floating], leaf: float, edge: float = 20.0) -> VoxelMap:
    """The cells as a map."""
    return VoxelMap(cells_of(points, leaf, edge))


def scan_from(points: Points, pose: NDArray[np.float64], count: int, seed: int = 2) -> Points:
    """Sample of the points within 25 m of a pose, in its own frame."""
    rng = np.random.default_rng(seed)
    near = points[np.linalg.norm(points - pose[:3], axis=1) < 25.0]
    chosen = near[rng.choice(len(near), count, replace=False)]
    T = np.linalg.inv(matrix_from_pose(pose))
    return np.asarray(chosen @ T[:3, :3].T + T[:3, 3], np.float64)


def worth(backend: Backend, pose: NDArray[np.float64], scoring: Scoring) -> Evaluation:
    """The evaluation of one pose."""
    (at,) = backend.evaluate(pose[None], scoring)
    return at


def counts(at: Evaluation) -> tuple[int, int, int, int]:
    """Points and neighbours of an evaluation, used and cut off."""
    return at.found, at.neighbours, at.cut_points, at.cut_neighbours


def off(found: Evaluation, wanted: Evaluation) -> float:
    """The largest difference, relative to the largest element."""
    pairs = ((found.gradient, wanted.gradient), (found.hessian, wanted.hessian))
    scores = [abs(found.score / wanted.score - 1), abs(found.nearest / wanted.nearest - 1)]
    return max(*scores, *(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs))


def same_bits(a: Evaluation, b: Evaluation) -> bool:
    """Whether two evaluations are equal to the last bit."""
    plain = (a.score, a.nearest, *counts(a)) == (b.score, b.nearest, *counts(b))
    return plain and bool((a.gradient == b.gradient).all()) and bool((a.hessian == b.hessian).all())


def frame(number: int, T: NDArray[np.float64], truth: NDArray[np.float64] | None) -> Frame:
    """Return a frame of a drive without a map."""
    with NdtMatcher(backend="numpy") as matcher:
        matcher.set_map(VoxelMap({}))
        result = matcher.align(np.zeros((1, 3)), T)
    return Frame(
        name=f"scan_{number}",
        stamp_s=0.1 * number,
        result=result,
        T_guess=T,
        T_truth=truth,
        state="lost",
        relocalized=False,
        clock_jumped=False,
        thin_s=0.001,
        map_s=0.0,
        align_s=0.01 + number * 1e-3,
        relocalize_s=0.0,
        waited=number == 0,
    )
