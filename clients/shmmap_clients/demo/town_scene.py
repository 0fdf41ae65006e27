# SPDX-License-Identifier: Apache-2.0
"""The generated town as a map and scans of it, for who compares scan matchers without any data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap.simulation.lidar_drive import LidarDrive
from shmmap.simulation.town import Town

__all__ = ["TownScan", "town_scene"]


@dataclass(frozen=True, slots=True, eq=False)
class TownScan:
    """A scan, (N, 3) float32, sensor frame, metres; and the (4, 4) pose that it was taken from."""

    xyz: NDArray[np.float32]
    T_map_sensor: NDArray[np.float64]


def town_scene(
    *, scans: int = 3, origin: tuple[float, float] = (0.0, 0.0), seed: int = 1
) -> tuple[NDArray[np.float32], list[TownScan]]:
    """Return the cloud of a town of 160 m x 160 m, (N, 3) float32, metres, and scans along a street.

    Parameters
    ----------
    scans
        How many, 20 m from one to the next.
    origin
        The town's lower left corner in the map, multiples of 20 m.
    seed
        Which town.
    """
    town = Town(seed=seed, blocks=(2, 2), origin=origin)
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    drive = LidarDrive(town, length=20.0 * (scans - 1), step=20.0, seed=seed)
    return cloud, [TownScan(scan.xyz, scan.T_map_sensor) for scan in drive.scans()][:scans]
