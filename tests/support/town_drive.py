# SPDX-License-Identifier: Apache-2.0
"""A generated town as a divided map, and scans taken on a drive through it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.scans.trajectory import tum_line

from shmmap.testing.town import Town

_HEIGHT_M = 1.8
_REACH_M = 40.0
_NOISE_M = 0.02


@dataclass(frozen=True)
class TownDrive:
    """Files of a drive: the map's directory, the scans' directory, their poses."""

    map_dir: Path
    scans: Path
    truth: Path
    points: NDArray[np.float32]
    poses: NDArray[np.float64]  # (N, 6) pose vectors


def make_town_drive(
    folder: Path, *, blocks: tuple[int, int], density: float, frames: int, step: float, points: int = 4000
) -> TownDrive:
    """Write a town and ``frames`` scans taken every ``step`` metres; each a sample of what is near."""
    town = Town(seed=3, blocks=blocks, density=density)
    town.write(folder / "map")
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    route = town.route(length=frames * step, step=step)[:frames]
    heights = town.ground_height(route[:, 0], route[:, 1]) + _HEIGHT_M
    zeros = np.zeros(len(route))
    poses = np.stack([route[:, 0], route[:, 1], heights, zeros, zeros, route[:, 2]], axis=1)
    scans = folder / "scans"
    scans.mkdir()
    lines = []
    for number, pose in enumerate(poses):
        rng = np.random.default_rng(number)
        near = cloud[((cloud - pose[:3]) ** 2).sum(axis=1) < _REACH_M**2]
        near = near[rng.choice(len(near), min(points, len(near)), replace=False)]
        T = matrix_from_pose(pose)
        xyz = (near - pose[:3]) @ T[:3, :3] + rng.normal(0.0, _NOISE_M, near.shape)
        np.savez(scans / f"scan_{number:04}.npz", xyz=xyz.astype(np.float32))
        lines.append(tum_line(0.1 * number, T))
    (folder / "truth.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return TownDrive(folder / "map", scans, folder / "truth.txt", cloud, poses)
