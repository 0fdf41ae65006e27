# SPDX-License-Identifier: Apache-2.0
"""``shmmap-ndt align``: one scan, one map, one guess, no daemon; also the options of all alignments."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import (
    add_allow_empty,
    add_json_option,
    add_verb,
    at_least,
    complain,
    nothing_found,
    positive,
    print_json,
)
from shmmap_clients.shared_options import (
    FAILED_LIMITS,
    add_leaf_option,
    add_pose_format_option,
    add_pose_option,
    add_scan_option,
    add_scoring_options,
    add_thin_option,
    add_trust_options,
    bag_options_from,
    pose_from,
    pose_text,
    reader_from,
    scoring_settings,
    trust_from,
)

if TYPE_CHECKING:
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher

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
    from shmmap_clients.ndt_scan_matcher.map.voxel_map import VoxelMap, voxel_cell
    from shmmap_clients.scan_drive import read_one_scan
    from shmmap_clients.scans.scan_file import thinned

    T_guess = pose_from(args, "--guess") if args.guess is not None else np.eye(4)
    cloud = reader_from(args, "shmmap-ndt", min_range=0.0).points(args.map)
    reader = reader_from(args, "shmmap-ndt")
    scan = thinned(read_one_scan(args.scan, reader, bag_options_from(args)).xyz, args.thin or None)
    with matcher_from(args) as matcher:
        voxel_map = VoxelMap(
            {args.map: voxel_cell(cloud, args.leaf)},
            max_voxels=matcher.limits.voxels,
            max_bytes=matcher.limits.max_map_bytes,
        )
        matcher.set_map(matcher.prepare(voxel_map))
        begin = time.perf_counter()
        result = matcher.align(scan, T_guess)
        took_ms = (time.perf_counter() - begin) * 1e3
        bound = matcher.time_bound(scan, result.T_map_base)
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
            "cut": asdict(result.cut),
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


def add_alignment_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("alignment")
    group.add_argument(
        "--variant",
        choices=("autoware", "pclomp", "pcl"),
        default="autoware",
        help="behave as this NDT program: its covariances, stop rule and neighbours (default: autoware)",
    )
    group.add_argument(
        "--neighbors",
        choices=("direct1", "direct7", "radius"),
        help="voxels that a point is scored against: its own, also the six beside it, or all whose mean is"
        " within one leaf (default: the variant's)",
    )
    group.add_argument(
        "--epsilon", type=positive, metavar="E", help="end when a step is shorter (default: the variant's)"
    )
    group.add_argument(
        "--max-iterations", type=at_least(1), metavar="N", help="Newton steps (default: the variant's)"
    )
    group.add_argument(
        "--step-size", type=positive, default=0.1, metavar="M", help="longest step (default: 0.1)"
    )
    group.add_argument(
        "--line-search",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="More-Thuente line search (default: the variant's)",
    )
    group.add_argument(
        "--fine",
        action="store_true",
        help="align once more after the variant's alignment, with the voxels' true covariances: several times"
        " more accurate",
    )
    group.add_argument(
        "--steady",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="steps that do not oscillate between two places, as the originals' can (default: if --fine)",
    )
    add_scoring_options(group)
    _add_limit_options(parser)
    add_trust_options(parser)


def _add_limit_options(parser: argparse.ArgumentParser) -> None:
    limits = parser.add_argument_group("limits (what exceeds one is left out and counted)")
    limits.add_argument(
        "--max-points", type=at_least(1), metavar="N", help="points of a scan (default: 131072)"
    )
    limits.add_argument(
        "--max-neighbors",
        type=at_least(1),
        metavar="N",
        help="voxels per point; the nearest are taken (default: 32)",
    )
    limits.add_argument(
        "--max-voxels",
        type=at_least(1),
        metavar="N",
        help="voxels of the map; whole cells are left out (default: 1000000)",
    )
    limits.add_argument(
        "--max-map-bytes",
        type=at_least(1),
        metavar="N",
        help="memory that matching needs of the map; whole cells are left out (default: 96 for each voxel"
        " that is allowed)",
    )
    limits.add_argument(
        "--deadline",
        type=positive,
        metavar="SECONDS",
        help="for one alignment: it ends then, not converged; a device that has not answered is not waited"
        " for (default: none)",
    )


def matcher_from(args: argparse.Namespace) -> NdtMatcher:
    """Return a matcher with the given options."""
    from shmmap_clients.ndt_scan_matcher.matching.matcher import NdtMatcher
    from shmmap_clients.ndt_scan_matcher.matching.settings import Limits, Settings

    settings = Settings(
        variant=args.variant,
        neighbors=args.neighbors,
        epsilon=args.epsilon,
        max_iterations=args.max_iterations,
        step_size=args.step_size,
        line_search=args.line_search,
        mode="coarse_fine" if args.fine else "single",
        steady=args.steady,
        **scoring_settings(args),
    )
    given: dict[str, Any] = {
        "source_points": args.max_points,
        "neighbors": args.max_neighbors,
        "voxels": args.max_voxels,
        "map_bytes": args.max_map_bytes,
        "deadline_s": args.deadline,
    }
    limits = Limits(**{name: value for name, value in given.items() if value is not None})
    return NdtMatcher(settings, limits=limits, trust=trust_from(args), threads=args.threads)
