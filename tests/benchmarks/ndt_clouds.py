# SPDX-License-Identifier: Apache-2.0
"""Clouds to align that the NDT benchmarks share: recorded ones in ``SHMMAP_TEST_DATA``, else generated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import matrix_from_pose

from shmmap import read_cloud
from tests.benchmarks.street_data import data_dir, sampled, street

Points = NDArray[np.floating]
Matrix = NDArray[np.float64]

_CITY_EDGE_M = 0.2  # of the generated city's voxels: about as many points as PCL's example of a city has
_CITY_GUESS = (-0.4, -0.2, -0.2, 0.0, 0.0, -0.01)  # off the truth, as in the recorded reference alignments


@dataclass(frozen=True, eq=False)
class Pair:
    """A map, a scan, and where its alignment starts.

    Attributes
    ----------
    target, source
        (N, 3) points of the map, map frame, and of the scan, sensor frame, metres.
    leaf
        Edge of a voxel, metres.
    T_guess
        (4, 4) pose to start from.
    T_truth
        (4, 4) pose of the scan; None where it is not known.
    """

    name: str
    target: Points
    source: Points
    leaf: float
    T_guess: Matrix
    T_truth: Matrix | None = None


def scan_pair() -> Pair:
    """Two scans taken near one another, one point per 0.1 m, to align at the identity."""
    folder = data_dir() / "ndt"
    if folder.is_dir():
        files = (folder / "target_ds0.1_points.npz", folder / "source_ds0.1_points.npz")
    else:
        files = (data_dir() / "pair" / "target.npz", data_dir() / "pair" / "source.npz")
    with np.load(files[0]) as target, np.load(files[1]) as source:
        return Pair("pair", target["xyz"], source["xyz"], 1.0, np.eye(4))


def city() -> Pair:
    """A generated city and a scan of 1500 points, whose pose is known."""
    folder = data_dir() / "ndt"
    if folder.is_dir():
        target = read_cloud(folder / "synthetic_map.pcd").xyz
        source = read_cloud(folder / "synthetic_scan1500.pcd").xyz
        T_truth = matrix_from_pose(np.array([10.4, 5.2, 1.8, 0.0, 0.0, 0.3]))
        T_guess = matrix_from_pose(np.array([10.0, 5.0, 1.6, 0.0, 0.0, 0.29]))
        return Pair("city", target, source, 2.0, T_guess, T_truth)
    drive = street()
    middle = len(drive.scans) // 2
    source = sampled(drive.scan(middle), 1.0, 1500)
    T_truth = drive.T_map_scans[middle]
    off = matrix_from_pose(np.array(_CITY_GUESS))
    T_guess = T_truth @ off
    return Pair("city", sampled(read_cloud(drive.map_file).xyz, _CITY_EDGE_M), source, 2.0, T_guess, T_truth)
