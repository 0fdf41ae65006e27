# SPDX-License-Identifier: Apache-2.0
"""Clouds that the NDT benchmarks share; ``SHMMAP_TEST_DATA`` names where they lie."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose

from shmmap import read_cloud

Points = NDArray[np.floating]


@dataclass(frozen=True)
class Pair:
    """A map, a scan, a guess: as in the reference alignments."""

    name: str
    target: Points
    source: Points
    leaf: float
    guess: tuple[float, float, float, float]  # x, y, z, yaw

    @property
    def T_guess(self) -> NDArray[np.float64]:
        """The guess as a matrix."""
        x, y, z, yaw = self.guess
        return matrix_from_pose(np.array([x, y, z, 0.0, 0.0, yaw]))


def data_dir() -> Path:
    """Where the data lies."""
    path = os.environ.get("SHMMAP_TEST_DATA", "")
    if not path:
        raise SystemExit("SHMMAP_TEST_DATA must name the directory of maps and scans")
    return Path(path)


def real_pair() -> Pair:
    """Two real scans, sampled at 0.1 m, of koide3's benchmark."""
    folder = data_dir() / "ndt"
    with np.load(folder / "target_ds0.1_points.npz") as a, np.load(folder / "source_ds0.1_points.npz") as b:
        return Pair("pair", a["xyz"], b["xyz"], 1.0, (0.0, 0.0, 0.0, 0.0))


def synthetic() -> Pair:
    """A generated city and a scan of 1500 points; the truth is (10.4, 5.2, 1.8), yaw 0.3."""
    folder = data_dir() / "ndt"
    city = read_cloud(folder / "synthetic_map.pcd").xyz
    return Pair(
        "synthetic", city, read_cloud(folder / "synthetic_scan1500.pcd").xyz, 2.0, (10.0, 5.0, 1.6, 0.29)
    )


def sampled(points: Points, edge: float, most: int | None = None, seed: int = 0) -> Points:
    """Mean of each voxel of ``edge`` metres, and of those a random ``most``."""
    index = np.floor(points / edge).astype(np.int64)
    index -= index.min(axis=0)
    key = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0) + 1))
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(group, points[:, axis].astype(np.float64)) for axis in range(3)]
    means = (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)
    if most is None or len(means) <= most:
        return means
    return np.asarray(means[np.random.default_rng(seed).choice(len(means), most, replace=False)], np.float32)
