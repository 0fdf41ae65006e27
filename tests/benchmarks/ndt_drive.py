# SPDX-License-Identifier: Apache-2.0
"""A long drive over copies of a street beside a daemon that loads it: does any scan wait, does memory grow?

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.ndt_drive [--frames 2000] [--rate 10] [--copies 10]

The street is laid out ten times ten; the drive goes along a row, copy after copy, on the poses of its drive
(and straight on from where they end to where the next copy begins).  Every eighth pose has its scan, all
others a sample of the map around them with noise.  Limits: at least 50 map updates with cells added and
removed, no scan waits for one, p99 of the latency at most 3 times its median, no growth of memory.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shmmap_clients.ndt_scan_matcher import NdtMatcher, Settings
from shmmap_clients.ndt_scan_matcher.cli.machine import warmup_alignment
from shmmap_clients.ndt_scan_matcher.drive.drive_summary import DriveStatistics
from shmmap_clients.ndt_scan_matcher.drive.follower import Follower
from shmmap_clients.ndt_scan_matcher.drive.motion_prediction import Odometry
from shmmap_clients.ndt_scan_matcher.map.map_updater import MapRules, MapUpdater
from shmmap_clients.scans.scan_file import read_scan
from shmmap_clients.scans.scan_sequence import Scan
from shmmap_clients.scans.trajectory import Trajectory

from shmmap import read_cloud
from shmmap.demo.process_usage import process_memory
from shmmap.testing.daemon_process import DaemonProcess
from tests.benchmarks.street_data import TILE_M, Street, sampled, street
from tests.benchmarks.tile_map import tile_map

STEP_M = 0.9  # between the poses that lead to the next tile
REACH_M = 60.0
POINTS = 6000

Matrix = NDArray[np.float64]


def one_tile(way: Street) -> tuple[list[NDArray[np.float32]], Matrix]:
    """Scans and poses from a tile's first pose to just before the next tile's first."""
    driven = way.T_map_frames
    end, start = driven[-1], driven[0].copy()
    start[0, 3] += TILE_M
    gap = start[:3, 3] - end[:3, 3]
    steps = max(1, int(np.linalg.norm(gap) / STEP_M))
    between = np.tile(start, (steps - 1, 1, 1))
    between[:, :3, 3] = end[:3, 3] + gap * (np.arange(1, steps) / steps)[:, None]
    # the heading turns over with the way: no jump where the driven poses end
    poses = np.concatenate([driven, between])
    tile = read_cloud(way.thinned_map_file).xyz
    cloud = np.concatenate([tile, tile + np.array([TILE_M, 0, 0], np.float32)])
    taken = dict(zip(way.scan_frames, way.scans, strict=True))
    scans = []
    for number, T in enumerate(poses):
        if number in taken:
            scans.append(sampled(read_scan(taken[number]), 0.5, POINTS))
            continue
        rng = np.random.default_rng(number)
        near = cloud[((cloud - T[:3, 3]) ** 2).sum(axis=1) < REACH_M**2]
        near = near[rng.choice(len(near), min(POINTS, len(near)), replace=False)]
        xyz = (near - T[:3, 3]) @ T[:3, :3] + rng.normal(0.0, 0.02, near.shape)
        scans.append(xyz.astype(np.float32))
    return scans, poses


def main() -> None:
    """Drive and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--copies", type=int, default=10)
    parser.add_argument("--fine", action="store_true")
    args = parser.parse_args()
    way = street()
    scans, poses = one_tile(way)
    frames = min(args.frames, len(poses) * (args.copies - 1))
    warmup_alignment()
    settings = Settings(mode="coarse_fine") if args.fine else Settings(steady=True)

    def truth(number: int) -> Matrix:
        T = np.array(poses[number % len(poses)], np.float64)
        T[0, 3] += TILE_M * (number // len(poses))
        return T

    # odometry with one per cent of scale error: what a wheel encoder gives
    line = Trajectory(np.arange(frames) / args.rate, np.array([truth(number) for number in range(frames)]))
    drift = line.T_map_sensor.copy()
    drift[:, :3, 3] *= 1.01
    odometry = Trajectory(line.stamps_s, drift)
    statistics = DriveStatistics()
    memory: list[int] = []
    with tempfile.TemporaryDirectory() as scratch:
        made = tile_map(way.thinned_map_file, Path(scratch) / "map", copies=args.copies, pitch=TILE_M)
        print(f"load {os.getloadavg()[0]:.2f}; {made.cells} cells; {frames} scans at {args.rate} Hz")
        with (
            DaemonProcess(made.path) as daemon,
            NdtMatcher(settings) as matcher,
            MapUpdater(daemon.endpoint, MapRules(), prepare=matcher.prepare) as maps,
        ):
            follower = Follower(matcher, maps, Odometry(truth(0), lambda: odometry), thin=None)
            costs: list[float] = []
            begin = time.monotonic()
            for number in range(frames):
                scan = Scan(
                    str(number), number / args.rate, {"xyz": scans[number % len(scans)]}, truth(number)
                )
                if number:
                    time.sleep(max(0.0, begin + number / args.rate - time.monotonic()))
                cpu = time.thread_time()
                statistics.add(follower.follow(scan))
                costs.append((time.thread_time() - cpu) * 1e3)
                if number == 0:
                    begin = time.monotonic()  # the first waits for the map
                if number % 50 == 49:
                    memory.append(process_memory(os.getpid()).private_bytes)
        summary = statistics.summary(maps.statistics, maps.too_slow, matcher.trust)
    s, late = summary, summary.latency_ms
    print(
        f"map: {s.map_updates} updates, +{s.cells_added} -{s.cells_removed} cells; scans that waited after"
        f" the first: {s.waited - 1}; too slow: {s.too_slow}; made in {s.map_build_ms.p50:.1f} ms (max"
        f" {s.map_build_ms.max:.1f}) beside, own memory {s.map_private_bytes / 1e6:.2f} MB"
    )
    print(
        f"latency: p50 {late.p50:.2f} ms, p99 {late.p99:.2f} ms, max {late.max:.2f} ms, p99/p50"
        f" {late.p99 / late.p50:.2f}; taking a map p99 {s.map_ms.p99:.3f} ms"
    )
    p50, p99 = np.percentile(costs[1:], (50, 99))
    print(
        f"CPU time of a scan (what other programs on the machine do not change): p50 {p50:.2f} ms,"
        f" p99 {p99:.2f} ms, max {max(costs[1:]):.2f} ms, p99/p50 {p99 / p50:.2f}"
    )
    assert s.errors is not None
    print(
        f"poses: {s.trustworthy} of {s.frames} trusted; ATE {s.errors.ate_rmse_m:.3f} m RMSE, max"
        f" {s.errors.ate_m.max:.3f} m, {s.errors.ate_deg.max:.2f} deg; NVTL {s.nvtl.mean:.2f}"
    )
    third = max(1, len(memory) // 3)
    print(
        f"private memory: {memory[0] / 1e6:.1f} MB after 50 scans, median of the middle third"
        f" {np.median(memory[third : 2 * third]) / 1e6:.1f} MB, of the last"
        f" {np.median(memory[-third:]) / 1e6:.1f} MB; peak RSS"
        f" {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB"
    )


if __name__ == "__main__":
    main()
