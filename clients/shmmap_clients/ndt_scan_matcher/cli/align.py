# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt align``: one scan, one map, one guess; no daemon."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from shmmap_clients.command_line import (
    add_allow_empty,
    add_json_option,
    add_verb,
    complain,
    nothing_found,
    print_json,
)
from shmmap_clients.ndt_scan_matcher.cli.alignment_options import add_alignment_options, matcher_from
from shmmap_clients.pose_option import add_pose_format_option, add_pose_option, pose_from, pose_text
from shmmap_clients.shared_options import (
    FAILED_LIMITS,
    add_leaf_option,
    add_scan_option,
    add_thin_option,
    reader_from,
)

__all__ = ["add_parser", "run"]

_JSON = f"""\
JSON (fields may be added, none is removed):
  {{"T_map_base": 4x4 in metres, "iterations", "converged",
   "transform_probability", "nvtl", "oscillations", "evaluations",
   "trustworthy": bool, "no_map": bool, "failed_limits": [name],
   "covariance": 6x6 of x y z roll pitch yaw, or null,
   "evidence": {{"points": matched, "distance": metres, "angle": degrees,
     "sharpness", "spread"}},
   "cut": {{"points", "neighbor_points", "neighbors", "voxels", "map_bytes"}}:
     left out by limits, and "deadline": whether time was up,
   "worst_case_ms": for the largest scan that the limits allow, estimated on
     this machine,
   "align_ms": measured, "points", "too_near", "not_finite": points left out,
   "voxels", "variant", "convention": the same, "neighbors", "backend"}}
{FAILED_LIMITS}
Exit code: 0; 1 when the alignment did not converge, or no point of the scan has
a voxel of the map near.  One that converged and is not trusted: 0; trustworthy
and the line "trusted" say so."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "align",
        run,
        help="align one scan with one map file; no daemon",
        description="Align one scan with one map file and print the pose of the frame that the points are in;"
        " no daemon is needed.",
        epilog=_JSON,
    )
    parser.add_argument("--map", required=True, metavar="FILE", help="map: PCD, NPZ or any other cloud file")
    add_scan_option(parser)
    add_pose_option(parser, "--guess", "pose to start from (default: zeros)", default=None)
    add_pose_format_option(parser)
    add_leaf_option(parser)
    add_thin_option(parser, default=0.0)
    add_alignment_options(parser)
    add_allow_empty(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Align and print; exit code 1 where the alignment did not converge."""
    import time

    import numpy as np

    from shmmap_clients.map_extent import extent_text
    from shmmap_clients.ndt_scan_matcher.map.voxel_cell import voxel_cell
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap
    from shmmap_clients.ndt_scan_matcher.matching.time_bound import predict_time_bound
    from shmmap_clients.scans.thinning import thinned

    T_guess = pose_from(args, "--guess") if args.guess is not None else np.eye(4)
    cloud = reader_from(args, "shmmap-ndt", min_range=0.0).points(args.map)
    reader = reader_from(args, "shmmap-ndt")
    scan = thinned(reader.points(args.scan), args.thin or None)
    with matcher_from(args) as matcher:
        voxel_map = VoxelMap(
            {args.map: voxel_cell(cloud, args.leaf)},
            max_voxels=matcher.limits.voxels,
            max_bytes=matcher.limits.most_map_bytes,
        )
        matcher.set_map(matcher.prepare(voxel_map))
        begin = time.perf_counter()
        result = matcher.align(scan, T_guess)
        took_ms = (time.perf_counter() - begin) * 1e3
        bound = predict_time_bound(matcher, scan, result.T_map_base)
        trust = matcher.trust
        document = {
            "T_map_base": result.T_map_base.tolist(),
            "iterations": result.iterations,
            "converged": result.converged,
            "transform_probability": result.transform_probability,
            "nvtl": result.nvtl,
            "oscillations": result.oscillations,
            "evaluations": result.evaluations,
            "trustworthy": result.trustworthy,
            "no_map": result.no_map,
            "failed_limits": list(result.failed_limits),
            "covariance": None if result.covariance is None else result.covariance.tolist(),
            "evidence": asdict(result.evidence),
            "cut": {
                "points": result.cut.points,
                "neighbor_points": result.cut.neighbor_points,
                "neighbors": result.cut.neighbors,
                "voxels": result.cut.voxels,
                "map_bytes": result.cut.map_bytes,
                "deadline": result.cut.deadline,
            },
            "worst_case_ms": bound.total_ms,
            "align_ms": took_ms,
            "points": len(scan) - result.cut.points,
            **reader.counts,
            "voxels": voxel_map.voxels,
            "variant": args.variant,
            "convention": args.variant,
            "neighbors": matcher.neighbors,
            "backend": matcher.backend_name,
        }
        fault = matcher.fault
    if fault is not None:
        complain("shmmap-ndt", f"{document['backend']} went on without the device: {fault}")
    if args.json:
        print_json(document)
    else:
        print(f"{'pose':24}{pose_text(result.T_map_base, args.pose_format)}")
        _print(document, [trust.describe(name) for name in result.failed_limits], bound.describe())
    if not len(scan):
        return nothing_found(args, f"{args.scan} has no points", name="shmmap-ndt")
    if result.no_map:
        bounds = [*cloud[:, :2].min(axis=0), *cloud[:, :2].max(axis=0)] if len(cloud) else None
        where = extent_text(bounds, result.T_map_base[:3, 3])
        found = f"no voxel of the map near any point of the scan: {where}"
        return nothing_found(args, found, name="shmmap-ndt")
    return 0 if result.converged else 1


def _print(document: dict[str, Any], failed: list[str], bound: str) -> None:
    rows = document.pop("T_map_base")
    print("T_map_base")
    for row in rows:
        print("  " + " ".join(f"{value:12.6f}" for value in row))
    names = ("iterations", "converged", "transform_probability", "nvtl", "oscillations", "evaluations")
    for name in (*names, "points", "too_near", "not_finite", "voxels"):
        value = document[name]
        print(f"{name:24}{value:.6f}" if isinstance(value, float) else f"{name:24}{value}")
    print(f"{'trusted':24}{'no: ' + ', '.join(failed) if failed else 'yes'}")
    cut = {name: count for name, count in document["cut"].items() if count}
    late = "the deadline ended it" if cut.pop("deadline", False) else ""
    left = ", ".join([*(f"{n} {c}" for n, c in cut.items()), *([late] if late else [])])
    print(f"{'left out by limits':24}{left or 'nothing'}")
    print(f"{'time':24}{document['align_ms']:.2f} ms; {bound}")
