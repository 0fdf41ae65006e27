# SPDX-License-Identifier: Apache-2.0
"""A generated town as a divided map, and scans taken on a drive through it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.scans.trajectory import tum_line

from shmmap.simulation.lidar import Lidar
from shmmap.simulation.town import Town

_HEIGHT_M = 1.8
_SEEN_DENSITY = 12.0
_LIDAR = Lidar(rings=32, azimuth_deg=0.6, farthest=45.0)


@dataclass(frozen=True)
class TownDrive:
    """Files of a drive: the map's directory, the scans' directory, their poses."""

    map_dir: Path
    scans: Path
    truth: Path
    points: NDArray[np.float32]
    poses: NDArray[np.float64]  # (N, 6) pose vectors


def make_town_drive(
    folder: Path, *, blocks: tuple[int, int], density: float, frames: int, step: float
) -> TownDrive:
    """Write a town and ``frames`` scans that the simulated LiDAR takes every ``step`` metres.

    The LiDAR looks at a denser sampling of the same town: no scan holds the map's own points.
    """
    town = Town(seed=3, blocks=blocks, density=density)
    town.write(folder / "map")
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    route = town.route(length=frames * step, step=step)[:frames]
    heights = town.ground_height(route[:, 0], route[:, 1]) + _HEIGHT_M
    zeros = np.zeros(len(route))
    poses = np.stack([route[:, 0], route[:, 1], heights, zeros, zeros, route[:, 2]], axis=1)
    dense = Town(seed=3, blocks=blocks, density=_SEEN_DENSITY)
    seen = np.concatenate([tile["xyz"] for tile in dense.tiles()])
    scans = folder / "scans"
    scans.mkdir()
    lines = []
    for number, pose in enumerate(poses):
        rng = np.random.default_rng(number)
        near = seen[(np.abs(seen[:, :2] - pose[:2]) < _LIDAR.farthest).all(axis=1)]
        T = matrix_from_pose(pose)
        np.savez(scans / f"scan_{number:04}.npz", xyz=_LIDAR.scan(near, T, rng).xyz)
        lines.append(tum_line(0.1 * number, T))
    (folder / "truth.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return TownDrive(folder / "map", scans, folder / "truth.txt", cloud, poses)
