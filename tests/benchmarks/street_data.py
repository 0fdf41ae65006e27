# SPDX-License-Identifier: Apache-2.0
"""The street that benchmarks of localization drive along: its map, scans and poses.

``SHMMAP_TEST_DATA`` names the directory: of generated data, which ``python -m tests.benchmarks.make_data
DIRECTORY`` makes, or of recorded data (BENCHMARKS.md says where that comes from), which is used if both are
there:

    kitti0005_map/map_static_v005.pcd            the map without moving objects, one point per 5 cm
    kitti0005_map/map_static_v010.pcd            the same, one point per 10 cm
    kitti0005_scans/scan_0001.npz ...            scans that are not in the map, by frame: xyz in metres, or
                                                 xyz_4mm in units of 4 mm
    kitti0005_scans/poses_heldout_tum.txt        pose of each scan (TUM: t x y z qx qy qz qw)
    kitti0005_scans/poses_all_tum.txt            pose of each frame
    ndt/target_ds0.1_points.npz, source_ds0.1_points.npz
                                                 two scans, one point per 10 cm (pcl::VoxelGrid), array xyz

The map has the even frames of the drive, the scans are odd ones.  Their poses came from registering the
frames with GICP (small_gicp): each to the model of those before, then three rounds of the even frames against
the odd ones' model and back.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.trajectory import read_trajectory

SENSOR_HEIGHT_M = 1.73  # above the ground, of KITTI's scanner and of the simulated one
TILE_M = 220.0  # both maps fit into a square of this side; copies of them are laid out at this distance

Points = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Street:
    """A drive along a street of about 140 m.

    Attributes
    ----------
    recorded
        Whether it was driven; else it is generated and simulated.
    map_file, thinned_map_file
        PCD: the map as dense as it is (5 cm), and with one point per 10 cm.
    scan_folder, scan_poses_file
        Scans that are not part of the map, in the order of their names, and a TUM file of their poses.
    scans
        File of each scan.
    """

    recorded: bool
    map_file: Path
    thinned_map_file: Path
    scan_folder: Path
    scan_poses_file: Path
    scans: tuple[Path, ...]

    @property
    def T_map_scans(self) -> NDArray[np.float64]:
        """(N, 4, 4) pose of the sensor at each scan."""
        return read_trajectory(self.scan_poses_file).T_map_sensor

    def scan(self, number: int) -> Points:
        """Points of a scan, (N, 3), sensor frame, metres."""
        return read_scan(self.scans[number])


def data_dir() -> Path:
    """Return the directory of maps and scans; ends the program where none is named."""
    path = os.environ.get("SHMMAP_TEST_DATA", "")
    if not path:
        raise SystemExit(
            "SHMMAP_TEST_DATA must name a directory of maps and scans\n"
            "hint: python -m tests.benchmarks.make_data DIRECTORY makes one"
        )
    return Path(path)


def street() -> Street:
    """Return the street in the data directory: the recorded one, where it is there."""
    folder = data_dir()
    recorded = (folder / "kitti0005_map").is_dir()
    if recorded:
        maps = folder / "kitti0005_map"
        map_file, thinned = maps / "map_static_v005.pcd", maps / "map_static_v010.pcd"
        scans = folder / "kitti0005_scans"
        held_out = scans / "poses_heldout_tum.txt"
    else:
        maps = folder / "street"
        map_file, thinned = maps / "map.pcd", maps / "map_thinned.pcd"
        scans = maps / "scans"
        held_out = maps / "scan_poses.txt"
    if not map_file.is_file():
        raise SystemExit(f"{folder} has neither a folder kitti0005_map nor a folder street with a map.pcd")
    files = tuple(sorted(scans.glob("scan_*.npz")))
    return Street(recorded, map_file, thinned, scans, held_out, files)


def sampled(points: Points, edge: float, most: int | None = None, seed: int = 0) -> NDArray[np.float32]:
    """Mean of each voxel of ``edge`` metres, and of those a random ``most``: (N, 3) float32."""
    index = np.floor(points / edge).astype(np.int64)
    index -= index.min(axis=0)
    key = np.ravel_multi_index(tuple(index.T), tuple(index.max(axis=0) + 1))
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(group, points[:, axis].astype(np.float64)) for axis in range(3)]
    means = (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)
    if most is None or len(means) <= most:
        return means
    return np.asarray(means[np.random.default_rng(seed).choice(len(means), most, replace=False)], np.float32)
