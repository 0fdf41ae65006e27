# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt align``: one scan, one map, one guess; no daemon."""

from __future__ import annotations

import argparse
from typing import Any

from shmmap_clients.command_line import add_json_option, add_scan_option, numbers, print_json

__all__ = ["add_alignment_options", "add_backend_options", "add_parser", "matcher_from", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "align",
        help="align one scan with one map, both files",
        description="Align one scan with one map file; no daemon is needed.  What is left out of the options"
        " is the convention's own default.",
        epilog="JSON: T_map_base (4x4, metres), iterations, converged, transform_probability, nvtl,"
        " oscillations, evaluations, covariance (6x6 or null, after x y z roll pitch yaw), cut (points,"
        " neighbor_points, neighbors, voxels that caps left out), worst_case_ms (predicted from the caps"
        " for this machine), align_ms (wall time of the alignment),"
        " points, voxels, convention, neighbors, backend.",
    )
    parser.add_argument("--map", required=True, metavar="FILE", help="PCD, NPZ or any cloud file")
    add_scan_option(parser)
    parser.add_argument(
        "--guess",
        type=numbers(6),
        default=(0.0,) * 6,
        metavar="X,Y,Z,ROLL,PITCH,YAW",
        help="metres, radians, R = Rx Ry Rz (default: zeros)",
    )
    parser.add_argument("--leaf", type=float, default=2.0, metavar="M", help="voxel edge (default 2.0)")
    add_alignment_options(parser)
    add_json_option(parser)
    parser.set_defaults(run=run)


def add_alignment_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how to align."""
    group = parser.add_argument_group("alignment")
    group.add_argument("--convention", choices=("autoware", "pclomp", "pcl"), default="autoware")
    group.add_argument("--neighbors", choices=("direct1", "direct7", "radius"))
    group.add_argument("--epsilon", type=float, metavar="E", help="a smaller step ends it")
    group.add_argument("--max-iterations", type=int, metavar="N")
    group.add_argument("--step-size", type=float, default=0.1, metavar="M", help="longest step (default 0.1)")
    group.add_argument(
        "--line-search",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="More-Thuente's (default: as the convention's program)",
    )
    group.add_argument(
        "--fine", action="store_true", help="go on with the true covariances: several times more accurate"
    )
    group.add_argument(
        "--steady",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="steps that never swing to and fro, unlike the originals' (default: with --fine)",
    )
    add_backend_options(group)
    caps = parser.add_argument_group("caps (what exceeds one is left out and reported)")
    caps.add_argument("--max-points", type=int, metavar="N", help="points of a scan")
    caps.add_argument("--max-neighbors", type=int, metavar="N", help="voxels per point, the nearest")
    caps.add_argument("--max-voxels", type=int, metavar="N", help="voxels of the map, whole cells")


def add_backend_options(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the options that say what computes."""
    parser.add_argument("--backend", default="numba", metavar="NAME", help="numba (default) or numpy")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="results do not depend on it")


def matcher_from(args: argparse.Namespace) -> Any:
    """Return the matcher that the options ask for."""
    from shmmap_clients.ndt_scan_matcher.matching.limits import Caps
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher, Settings

    settings = Settings(
        convention=args.convention,
        neighbors=args.neighbors,
        epsilon=args.epsilon,
        max_iterations=args.max_iterations,
        step_size=args.step_size,
        line_search=args.line_search,
        mode="coarse_fine" if args.fine else "single",
        steady=args.steady,
    )
    given = {
        "source_points": args.max_points,
        "neighbors": args.max_neighbors,
        "voxels": args.max_voxels,
    }
    caps = Caps(**{name: value for name, value in given.items() if value is not None})
    return NdtMatcher(settings, caps=caps, backend=args.backend, threads=args.threads)


def run(args: argparse.Namespace) -> int:
    """Align and print; exit code 1 where the alignment did not converge."""
    import time

    import numpy as np

    from shmmap import BadRequest
    from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
    from shmmap_clients.ndt_scan_matcher.matching.euler_derivatives import matrix_from_pose
    from shmmap_clients.ndt_scan_matcher.matching.time_bound import predict_worst_case
    from shmmap_clients.scans.scan_file import read_scan

    if not args.leaf > 0:
        raise BadRequest(f"--leaf must be positive, it is {args.leaf}")
    cloud, scan = read_scan(args.map), read_scan(args.scan)
    with matcher_from(args) as matcher:
        voxel_map = VoxelMap({args.map: voxel_cell(cloud, args.leaf)}, max_voxels=matcher.caps.voxels)
        matcher.set_map(matcher.prepare(voxel_map))
        begin = time.perf_counter()
        result = matcher.align(scan, matrix_from_pose(np.array(args.guess)))
        took_ms = (time.perf_counter() - begin) * 1e3
        worst = predict_worst_case(matcher, scan, result.T_map_base)
        document = {
            "T_map_base": result.T_map_base.tolist(),
            "iterations": result.iterations,
            "converged": result.converged,
            "transform_probability": result.transform_probability,
            "nvtl": result.nvtl,
            "oscillations": result.oscillations,
            "evaluations": result.evaluations,
            "covariance": None if result.covariance is None else result.covariance.tolist(),
            "cut": {
                "points": result.cut.points,
                "neighbor_points": result.cut.neighbor_points,
                "neighbors": result.cut.neighbors,
                "voxels": result.cut.voxels,
            },
            "worst_case_ms": worst.total_ms,
            "align_ms": took_ms,
            "points": len(scan) - result.cut.points,
            "voxels": voxel_map.voxels,
            "convention": args.convention,
            "neighbors": matcher.neighbors,
            "backend": matcher.backend_name,
        }
    if args.json:
        print_json(document)
    else:
        _print(document, worst.describe())
    return 0 if result.converged else 1


def _print(document: dict[str, Any], worst: str) -> None:
    rows = document.pop("T_map_base")
    print("T_map_base")
    for row in rows:
        print("  " + " ".join(f"{value:12.6f}" for value in row))
    names = ("iterations", "converged", "transform_probability", "nvtl", "oscillations", "evaluations")
    for name in (*names, "points", "voxels"):
        value = document[name]
        print(f"{name:24}{value:.6f}" if isinstance(value, float) else f"{name:24}{value}")
    cut = {name: count for name, count in document["cut"].items() if count}
    print(f"{'left out by caps':24}{', '.join(f'{n} {c}' for n, c in cut.items()) or 'nothing'}")
    print(f"{'time':24}{document['align_ms']:.2f} ms; {worst}")
