# SPDX-License-Identifier: Apache-2.0
"""The compare filter over a whole drive: labelled objects in a generated town, and a real map and scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shmmap_clients.compare_map_filter import CompareMapFilter, CompareRule
from shmmap_clients.compare_map_filter.rule import to_map
from shmmap_clients.scans.scan_sequence import ScanSequence
from shmmap_clients.scans.trajectory import matrix_of, read_trajectory

import shmmap
from shmmap.dividing.map_writer import MapWriter
from shmmap.simulation.lidar import Lidar, Traffic
from shmmap.simulation.town import Town
from tests.support.daemon_process import DaemonProcess

Factory = Callable[..., DaemonProcess]
LONG_S = 120.0


def farther_than(
    points: NDArray[np.float64], cloud: NDArray[Any], tree: Any, distance: float
) -> NDArray[np.bool_]:
    """Points with no cloud point within ``distance``: the nearest by a tree, its distance by arithmetic."""
    _, nearest = tree.query(points, distance_upper_bound=distance * 1.001)
    far = nearest == len(cloud)
    away = cloud[np.where(far, 0, nearest)].astype(np.float64) - points
    squares = away[:, 0] * away[:, 0] + away[:, 1] * away[:, 1] + away[:, 2] * away[:, 2]
    return np.asarray(far | (squares > distance * distance))


def test_objects_stay_and_the_town_goes(daemon: Factory, tmp_path: Path) -> None:
    town = Town(seed=5, blocks=(3, 3), density=15.0)
    town.write(tmp_path / "town")
    seen = Town(seed=5, blocks=(3, 3), density=70.0)  # the same surfaces, other points of them
    surfaces = np.concatenate([tile["xyz"] for tile in seen.tiles()])
    cloud = np.concatenate([tile["xyz"] for tile in town.tiles()])
    tree = cKDTree(cloud)
    route = town.route(length=90.0, step=1.0)
    traffic = Traffic(town, route, seed=1)
    one = daemon(tmp_path / "town")
    rule = CompareRule("distance", 0.5)
    compare = CompareMapFilter(rule)
    rng = np.random.default_rng(2)
    kept_far = far_objects = kept_objects = objects = removed_static = static = 0
    with shmmap.MapWindow(one.endpoint, 120.0, layers=rule.layer, update_distance=5.0) as window:
        for n, (x, y, heading) in enumerate(route[10:80:24]):
            z = float(town.ground_height(np.array(x), np.array(y))) + 1.8
            T = matrix_of((x, y, z), (0, 0, np.sin(heading / 2), np.cos(heading / 2)))
            near = np.hypot(*(surfaces[:, :2] - (x, y)).T) < 80.0
            moving = traffic.points(0.1 * n)
            scene = np.concatenate([surfaces[near].astype(np.float64), moving])
            scan = Lidar(azimuth_deg=0.35, rings=48).scan(scene, T, rng)
            is_object = scan.source >= np.count_nonzero(near)
            window.move_to(float(x), float(y), wait=LONG_S)
            assert window.complete
            kept = compare.follow(window).apply(scan.xyz, T).kept
            far = farther_than(to_map(scan.xyz, T), cloud, tree, 0.5)
            assert np.array_equal(kept, far)
            kept_far += int((kept & far & is_object).sum())
            far_objects += int((far & is_object).sum())
            kept_objects += int((kept & is_object).sum())
            objects += int(is_object.sum())
            removed_static += int((~kept & ~is_object).sum())
            static += int((~is_object).sum())
        compare.use_cells(())
    assert objects > 1000
    assert kept_far >= 0.99 * far_objects
    assert removed_static >= 0.97 * static
    assert kept_objects > 0.3 * objects  # what is near the road goes by the rule


def test_real_scans_on_a_real_map(daemon: Factory, data_dir: Path, tmp_path: Path) -> None:
    cloud = shmmap.read_cloud(data_dir / "kitti0005_map" / "map_static_v005.pcd").xyz
    with MapWriter(tmp_path / "map", durable=False) as writer:
        writer.add({"xyz": cloud})
        writer.finish()
    one = daemon(tmp_path / "map")
    trajectory = read_trajectory(data_dir / "kitti0005_scans" / "poses_heldout_tum.txt")
    places = cloud.astype(np.float64)
    scans = list(ScanSequence(data_dir / "kitti0005_scans", trajectory))[3::8]
    tree = cKDTree(cloud)
    rule = CompareRule("distance", 0.5)
    compare = CompareMapFilter(rule)
    with shmmap.MapWindow(one.endpoint, 200.0, layers=rule.layer, update_distance=0.0) as window:
        for scan in scans:
            T = scan.T_map_sensor
            assert T is not None
            window.move_to(float(T[0, 3]), float(T[1, 3]), wait=LONG_S)
            kept = compare.follow(window).apply(scan.xyz, T).kept
            points = to_map(scan.xyz, T)
            assert np.array_equal(kept, farther_than(points, cloud, tree, 0.5))
            assert 0.002 < kept.mean() < 0.08
            # no tree at all for a few: every point of the map
            for row in np.random.default_rng(1).choice(len(points), 20, replace=False):
                away = places - points[row]
                assert kept[row] == bool(((away**2).sum(axis=1) > 0.25).all())
        compare.use_cells(())
