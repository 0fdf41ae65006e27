# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-pose-init``: one scan, one rough pose, the daemon's map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from shmmap_clients.command_line import (
    add_daemon_options,
    add_json_option,
    add_scan_option,
    at_least,
    connect,
    numbers,
    print_json,
    run_command,
)
from shmmap_clients.ndt_scan_matcher.cli.align import add_backend_options

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Find an initial pose and return the exit code."""
    return run_command(
        "shmmap-pose-init",
        "Find where a scan was taken, from a rough pose: the height from the map's ground, candidates scored"
        " and aligned by NDT.",
        _add_options,
        _run,
        argv,
        epilog="JSON: T_map_base (4x4), score (transform probability), nvtl, reliable, converged, ground_z"
        " (null where the map has no ground near), covariance (6x6 or null), alternatives (T_map_base, score,"
        " nvtl), candidates, map_ms, search_ms.  Exit code 1: the pose is not reliable.",
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_scan_option(parser)
    parser.add_argument("--pose", required=True, type=numbers(3), metavar="X,Y,YAW", help="metres, radians")
    parser.add_argument(
        "--z", type=float, default=0.0, metavar="M", help="where the map has no ground (default 0)"
    )
    parser.add_argument("--sigma", type=float, default=2.0, metavar="M", help="of x and y (default 2)")
    parser.add_argument(
        "--sigma-yaw", type=float, default=0.1745, metavar="RAD", help="default 0.1745 (10 deg)"
    )
    parser.add_argument(
        "--height", type=float, default=0.0, metavar="M", help="of the scanner above the ground (default 0)"
    )
    parser.add_argument("--map-radius", type=float, default=150.0, metavar="M", help="default 150")
    parser.add_argument("--leaf", type=float, default=2.0, metavar="M", help="voxel edge (default 2.0)")
    parser.add_argument("--candidates", type=int, default=200, metavar="N", help="poses scored (default 200)")
    parser.add_argument("--seed", type=at_least(0), default=0, metavar="N", help="of the search (default 0)")
    parser.add_argument(
        "--thin", type=float, default=1.0, metavar="M", help="one point per cube (default 1 m)"
    )
    add_backend_options(parser)
    add_json_option(parser)
    add_daemon_options(parser)


def _run(args: argparse.Namespace) -> int:
    from shmmap_clients.ndt_scan_matcher.drive.follower import thinned
    from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
    from shmmap_clients.scans.scan_file import read_scan

    x, y, yaw = args.pose
    rough = RoughPose(x, y, args.z, yaw=yaw, sigma_m=args.sigma, sigma_yaw=args.sigma_yaw)
    rules = InitializerRules(
        map_radius=args.map_radius,
        leaf=args.leaf,
        height=args.height,
        candidates=args.candidates,
        seed=args.seed,
    )
    scan = thinned(read_scan(args.scan), args.thin or None)
    with (
        connect(args, "shmmap-pose-init") as client,
        PoseInitializer(client, rules, backend=args.backend, threads=args.threads) as initializer,
    ):
        found = initializer.initialize(scan, rough)
    result = found.result
    if args.json:
        print_json(
            {
                "T_map_base": found.T_map_base.tolist(),
                "score": found.score,
                "nvtl": result.nvtl,
                "reliable": found.reliable,
                "converged": result.converged,
                "ground_z": found.ground_z,
                "covariance": None if result.covariance is None else result.covariance.tolist(),
                "alternatives": [
                    {"T_map_base": one.T_map_base.tolist(), "score": one.score, "nvtl": one.nvtl}
                    for one in found.alternatives
                ],
                "candidates": found.candidates,
                "map_ms": found.map_s * 1e3,
                "search_ms": found.search_s * 1e3,
            }
        )
    else:
        print("T_map_base")
        for row in found.T_map_base:
            print("  " + " ".join(f"{value:12.6f}" for value in row))
        verdict = "reliable" if found.reliable else "NOT reliable"
        print(f"score         {found.score:.3f}, NVTL {result.nvtl:.3f}: {verdict}")
        print(f"ground        {'none near' if found.ground_z is None else f'{found.ground_z:.3f} m'}")
        for one in found.alternatives:
            x, y, z = one.T_map_base[:3, 3]
            print(f"alternative   ({x:.2f}, {y:.2f}, {z:.2f}) score {one.score:.3f}, NVTL {one.nvtl:.3f}")
        print(f"time          map {found.map_s * 1e3:.0f} ms, search {found.search_s * 1e3:.0f} ms")
    return 0 if found.reliable else 1
