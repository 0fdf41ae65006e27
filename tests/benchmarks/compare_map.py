# SPDX-License-Identifier: Apache-2.0
"""The compare-map filter against KD-trees over the same window, and over a drive with labelled objects.

A vehicle drives through a generated town with moving cars and people, or, with ``--street``, along the
street in SHMMAP_TEST_DATA.  A scan of 100 000 points is compared with the window around it, on one thread, by
shmmap (``search`` layers out of shared memory) and by what a process does that keeps its own copy: a
KD-tree (scipy's and Open3D's) over the window's points, rebuilt at each map update.  The voxel rule's
peer is a tree over the same centroids, by the largest difference along an axis.  All give the same
answer, which is checked.  Times are CPU times of the process, medians; "a scan with its update" is the
scan after the window has changed, and "per scan" has one update in ten scans (10 m at 10 m/s and 10 Hz).

    python -m tests.benchmarks.compare_map [--updates 5] [--points 100000] [--street] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.compare_map_filter import CompareMapFilter, CompareRule
from shmmap_clients.compare_map_filter.rule import to_map
from shmmap_clients.scans.scan_sequence import ScanSequence
from shmmap_clients.scans.trajectory import matrix_of, read_trajectory

import shmmap
from shmmap.dividing.map_writer import MapWriter
from shmmap.simulation.lidar import Lidar, Traffic
from shmmap.simulation.town import Town
from tests.benchmarks.street_data import street
from tests.support.daemon_process import DaemonProcess

SCANS_PER_UPDATE = 10
Scene = tuple[NDArray[np.float32], NDArray[np.float64], "NDArray[np.bool_] | None"]


def town_drive(directory: Path, updates: int) -> tuple[Path, Iterator[Scene]]:
    """Write a town; return it and scans 12 m apart, with what is an object in them."""
    town = Town(seed=5, blocks=(4, 4), density=40.0)
    town.write(directory / "town")
    surfaces = np.concatenate([t["xyz"] for t in Town(seed=5, blocks=(4, 4), density=160.0).tiles()])
    route = town.route(length=12.0 * updates + 60.0, step=1.0)
    traffic = Traffic(town, route, seed=1)

    def scans() -> Iterator[Scene]:
        rng = np.random.default_rng(2)
        for n in range(updates):
            x, y, heading = route[20 + 12 * n]
            z = float(town.ground_height(np.array(x), np.array(y))) + 1.8
            T = matrix_of((x, y, z), (0, 0, np.sin(heading / 2), np.cos(heading / 2)))
            near = np.hypot(*(surfaces[:, :2] - (x, y)).T) < 80.0
            scene = np.concatenate([surfaces[near].astype(np.float64), traffic.points(1.2 * n)])
            scan = Lidar(azimuth_deg=0.13, rings=80).scan(scene, T, rng)
            yield scan.xyz, T, scan.source >= np.count_nonzero(near)

    return directory / "town", scans()


def street_drive(directory: Path, updates: int) -> tuple[Path, Iterator[Scene]]:
    """Divide the street's map; return it and the drive's scans."""
    drive = street()
    cloud = shmmap.read_cloud(drive.map_file).xyz
    with MapWriter(directory / "map", durable=False) as writer:
        writer.add({"xyz": cloud})
        writer.finish()
    trajectory = read_trajectory(drive.scan_poses_file)

    def scans() -> Iterator[Scene]:
        for n, scan in enumerate(ScanSequence(drive.scan_folder, trajectory)):
            if n < updates and scan.T_map_sensor is not None:
                yield scan.xyz, scan.T_map_sensor, None

    return directory / "map", scans()


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result and milliseconds of CPU time of this process, all threads."""
    begin = time.process_time()
    result = function(*arguments)
    return result, (time.process_time() - begin) * 1e3


def scipy_tree(cloud: NDArray[np.float64], rule: CompareRule) -> Callable[[NDArray[np.float64]], Any]:
    """Build scipy's tree; return what says which points are explained."""
    from scipy.spatial import cKDTree

    if rule.mode == "voxel":
        scale = np.array([1.0, 1.0, 1.0 / rule.z_ratio])
        tree = cKDTree(cloud * scale)
        return lambda p: (
            tree.query(p * scale, p=np.inf, distance_upper_bound=rule.distance)[0] < rule.distance
        )
    tree = cKDTree(cloud)
    bound = np.nextafter(rule.distance, np.inf)
    return lambda p: tree.query(p, distance_upper_bound=bound)[0] <= rule.distance


def open3d_tree(cloud: NDArray[np.float64], rule: CompareRule) -> Callable[[NDArray[np.float64]], Any]:
    """Build Open3D's index for nearest neighbours; Euclidean alone."""
    import open3d as o3d

    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(cloud))
    search.knn_index()

    def explained(p: NDArray[np.float64]) -> Any:
        _, squares = search.knn_search(o3d.core.Tensor.from_numpy(p), 1)
        return squares.numpy().reshape(-1) <= rule.distance**2

    return explained


def compare(
    one: DaemonProcess, drive: list[Scene], rule: CompareRule, points: int, radius: float
) -> dict[str, Any]:
    """Run one rule over the drive, ours and the peers on the same windows."""
    peers = {"scipy": scipy_tree} | ({"open3d": open3d_tree} if rule.mode == "distance" else {})
    times: dict[str, dict[str, list[float]]] = {
        name: {"update": [], "scan": []} for name in ("shmmap", *peers)
    }
    mismatches: dict[str, int] = dict.fromkeys(peers, 0)
    counts = {
        "objects": 0,
        "objects_far": 0,
        "objects_far_kept": 0,
        "objects_kept": 0,
        "static": 0,
        "removed": 0,
    }
    window_points = 0
    filter_ = CompareMapFilter(rule)
    with shmmap.MapWindow(one.endpoint, radius, layers=rule.layer, update_distance=5.0) as window:
        for scan, T, is_object in drive:
            window.move_to(float(T[0, 3]), float(T[1, 3]), wait=120.0)
            part = np.ascontiguousarray(scan[:points])
            _, update_ms = timed(filter_.follow, window)
            got = None
            for _ in range(3):
                got, scan_ms = timed(filter_.apply, part, T)
                times["shmmap"]["scan"].append(scan_ms)
            times["shmmap"]["update"].append(update_ms)
            assert got is not None
            cloud = np.concatenate([cell.xyz for cell in window.cells]).astype(np.float64)
            window_points = max(window_points, len(cloud))
            places = to_map(part, T)
            for name, build in peers.items():
                explain, build_ms = timed(build, cloud, rule)
                explained, scan_ms = timed(explain, places)
                times[name]["update"].append(build_ms)
                times[name]["scan"].append(scan_ms)
                mismatches[name] += int(np.count_nonzero(explained == got.kept))
            if is_object is not None:
                kept = filter_.apply(scan, T).kept
                far = ~np.asarray(scipy_tree(cloud, rule)(to_map(scan, T)))
                counts["objects"] += int(is_object.sum())
                counts["objects_far"] += int((is_object & far).sum())
                counts["objects_far_kept"] += int((is_object & far & kept).sum())
                counts["objects_kept"] += int((is_object & kept).sum())
                counts["static"] += int((~is_object).sum())
                counts["removed"] += int((~is_object & ~kept).sum())
        filter_.use_cells(())
    return {
        "rule": f"{rule.mode} {rule.distance:g} m",
        "window_points": window_points,
        "times_ms": {
            name: {
                "update": float(np.median(t["update"])),
                "scan": float(np.median(t["scan"])),
                "scan_with_update": float(np.median(t["update"])) + float(np.median(t["scan"])),
                "per_scan": float(np.median(t["update"])) / SCANS_PER_UPDATE + float(np.median(t["scan"])),
            }
            for name, t in times.items()
        },
        "mismatches": mismatches,
        "labels": counts if counts["static"] else None,
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--updates", type=int, default=5)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--radius", type=float, default=150.0)
    parser.add_argument("--street", action="store_true", help="drive along the street in SHMMAP_TEST_DATA")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        if args.street:
            path, scans = street_drive(directory, args.updates)
        else:
            path, scans = town_drive(directory, args.updates)
        drive = list(scans)
        one = DaemonProcess(path).start()
        try:
            modes = ("voxel", "distance")
            results = [compare(one, drive, CompareRule(mode), args.points, args.radius) for mode in modes]
        finally:
            one.stop()
            one.dispose()
    if args.json:
        print(json.dumps({"load": os.getloadavg()[0], "results": results}, indent=1))
        return
    scan_points = min(args.points, min(len(scan) for scan, _, _ in drive))
    print(f"{scan_points} points a scan, load {os.getloadavg()[0]:.1f}; CPU ms, medians; ratio to shmmap")
    for result in results:
        print(f"\n{result['rule']}, {result['window_points']} points in the window")
        print(f"{'':10}{'scan':>10}{'update':>10}{'with update':>16}{'per scan':>16}")
        ours = result["times_ms"]["shmmap"]
        for peer, t in result["times_ms"].items():
            print(
                f"{peer:10}{t['scan']:10.1f}{t['update']:10.1f}"
                f"{t['scan_with_update']:10.1f} {t['scan_with_update'] / ours['scan_with_update']:4.0f}x"
                f"{t['per_scan']:10.1f} {t['per_scan'] / ours['per_scan']:4.1f}x"
            )
        print("answers that differ:", result["mismatches"])
        if result["labels"]:
            n = result["labels"]
            print(
                f"objects: {n['objects']} points, {100 * n['objects_kept'] / n['objects']:.1f} % kept;"
                f" of {n['objects_far']} that the map does not explain"
                f" {100 * n['objects_far_kept'] / n['objects_far']:.2f} % kept;"
                f" static: {n['static']} points, {100 * n['removed'] / n['static']:.2f} % removed"
            )


if __name__ == "__main__":
    main()
