# SPDX-License-Identifier: Apache-2.0
"""Write a live map while driving towards a wall, and read it.

    shmmap serve --live lidar=maps/lidar              # in another terminal
    python3 live_map.py lidar

Mapper and reader are in one program here; as a rule they are several, and any number of readers.
"""

from __future__ import annotations

import sys

import numpy as np

import shmmap


def wall(distance: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return what the sensor sees: a wall of 4 m x 2 m ahead, (N, 3), metres, sensor frame."""
    y, z = np.meshgrid(np.linspace(-2.0, 2.0, 81), np.linspace(-1.0, 1.0, 41))
    return np.column_stack([np.full(y.size, distance), y.ravel(), z.ravel()])


def main() -> int:
    """Map five scans, then ask what is occupied, free, and in a ray's way."""
    with shmmap.connect() as client:
        live = client.live(sys.argv[1])
        with live.mapper("example", shmmap.live.ScanFilter(max_range=5.0)) as mapper:
            for step in range(5):
                pose = np.eye(4)  # of the sensor in the map frame
                pose[0, 3] = 0.1 * step
                mapper.add(wall(3.0 - 0.1 * step), pose)
            mapper.wait_applied()  # from here on the scans survive the death of any process
        occupied = live.voxels("occupied", shmmap.live.Sphere(3.0, 0.0, 0.0, radius=2.0))
        free = live.log_odds([[1.0, 0.0, 0.0]])[0] < live.free_below
        (reach,) = live.first_hits([0.0, 0.0, 0.0], [5.0, 0.0, 0.0])
    print(f"{mapper.applied} scans, {len(occupied)} voxels, the first at {occupied.xyz[:, 0].min():.2f} m")
    print(f"free at 1 m: {free}; a ray gets {reach:.1f} m far")
    return 0


if __name__ == "__main__":
    sys.exit(main())
