# SPDX-License-Identifier: Apache-2.0
"""Make a street's map and the scans of a drive along it, for every benchmark that needs a map and scans.

    python -m tests.benchmarks.make_data OUT
    SHMMAP_TEST_DATA=OUT python -m tests.benchmarks.ndt_accuracy

Everything is generated (`shmmap.simulation`): four blocks of a town, 160 m x 160 m, and a LiDAR of 64 rings
that is driven along the street in their middle, with 2 cm of noise.  The LiDAR looks at another sampling of
the same surfaces, denser than the map, so no scan holds the map's own points.  The poses are exact.

    OUT/street/map.pcd             the map, as dense as generated
    OUT/street/map_thinned.pcd     one point per 10 cm
    OUT/street/scans/scan_0001.npz every eighth frame of the drive: array xyz, metres, sensor frame
    OUT/street/scan_poses.txt      where these were taken (TUM: t x y z qx qy qz qw)
    OUT/street/frame_poses.txt     all frames of the drive
    OUT/pair/target.npz, source.npz  two scans 0.9 m apart, one point per 10 cm
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose
from shmmap_clients.scans.trajectory import tum_line

from shmmap.formats.pcd.writer import write_pcd
from shmmap.simulation.lidar import Lidar
from shmmap.simulation.town import Town
from tests.benchmarks.street_data import SENSOR_HEIGHT_M, sampled

BLOCKS = (2, 2)
SEED = 3
STREET_Y_M = 78.5  # the right lane, driven towards +x
FIRST_X_M, LAST_X_M = 8.0, 152.0
FRAMES = 154  # as many as the recorded drive has
SCAN_EVERY = 8
FRAME_S = 0.1
DENSITY = 40.0  # points per m² of ground: with what stands on it, as many as a map of 10 cm voxels
SEEN_DENSITY = 120.0


def make_data(out: Path, *, density: float = DENSITY, seen_density: float = SEEN_DENSITY) -> None:
    """Write the files into ``out``.

    Parameters
    ----------
    density, seen_density
        Points per m² of ground, of the map and of what the LiDAR looks at.
    """
    town = Town(seed=SEED, blocks=BLOCKS, density=density)
    folder = out / "street"
    (folder / "scans").mkdir(parents=True)
    tiles = list(town.tiles())
    xyz = np.concatenate([tile["xyz"] for tile in tiles])
    intensity = np.concatenate([tile["intensity"] for tile in tiles])
    write_pcd(folder / "map.pcd", {"xyz": xyz, "intensity": intensity})
    write_pcd(folder / "map_thinned.pcd", {"xyz": sampled(xyz, 0.1)})
    surfaces = np.concatenate(
        [tile["xyz"] for tile in Town(seed=SEED, blocks=BLOCKS, density=seen_density).tiles()]
    )
    poses = frame_poses(town)
    lines = [tum_line(FRAME_S * number, T) for number, T in enumerate(poses)]
    (folder / "frame_poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    held = range(1, FRAMES, SCAN_EVERY)
    (folder / "scan_poses.txt").write_text("".join(f"{lines[n]}\n" for n in held), encoding="utf-8")
    for number in held:
        np.savez(folder / "scans" / f"scan_{number:04}.npz", xyz=scan(surfaces, poses[number], number))
    (out / "pair").mkdir()
    for name, number in (("target", 20), ("source", 21)):
        np.savez(out / "pair" / f"{name}.npz", xyz=sampled(scan(surfaces, poses[number], number), 0.1))


def frame_poses(town: Town) -> NDArray[np.float64]:
    """Return the sensor's pose in each frame: level, straight along the street, (FRAMES, 4, 4)."""
    x = np.linspace(FIRST_X_M, LAST_X_M, FRAMES)
    z = town.ground_height(x, np.full(FRAMES, STREET_Y_M)) + SENSOR_HEIGHT_M
    return np.array(
        [
            matrix_from_pose(np.array([at, STREET_Y_M, height, 0.0, 0.0, 0.0]))
            for at, height in zip(x, z, strict=True)
        ]
    )


def scan(surfaces: NDArray[np.float32], T_map_sensor: NDArray[np.float64], seed: int) -> NDArray[np.float32]:
    """Return what the LiDAR sees from a pose, (N, 3), sensor frame."""
    lidar = Lidar()
    near = np.hypot(*(surfaces[:, :2] - T_map_sensor[:2, 3]).T) < lidar.farthest
    return lidar.scan(surfaces[near], T_map_sensor, np.random.default_rng(seed)).xyz


def main() -> None:
    """Make the data and say what it is."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", metavar="OUT", type=Path, help="a new directory")
    parser.add_argument("--density", type=float, default=DENSITY, help="points per m² of ground in the map")
    arguments = parser.parse_args()
    if arguments.out.exists() and any(arguments.out.iterdir()):
        sys.exit(f"{arguments.out} exists and is not empty")
    began = time.perf_counter()
    make_data(arguments.out, density=arguments.density, seen_density=3 * arguments.density)
    scans = len(list((arguments.out / "street" / "scans").iterdir()))
    print(f"{arguments.out}: a map and {scans} scans in {time.perf_counter() - began:.0f} s")
    print(f"export SHMMAP_TEST_DATA={arguments.out.resolve()}")


if __name__ == "__main__":
    main()
