# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-pose-init``: one scan, one rough pose, the daemon's map."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    at_least,
    complain,
    connect,
    nothing_found,
    print_json,
    run_command,
)
from shmmap_clients.shared_options import (
    FAILED_LIMITS,
    add_height_option,
    add_leaf_option,
    add_pose_format_option,
    add_pose_option,
    add_radius_option,
    add_scan_option,
    add_scoring_options,
    add_sigma_options,
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
    from shmmap_clients.pose_initializer import InitialPose

_NAME: Final = "shmmap-pose-init"
_JSON: Final = f"""\
JSON (fields may be added, none is removed):
  {{"T_map_base": 4x4 in metres, "score": transform probability, "nvtl",
   "reliable", "converged", "no_map": bool, "failed_limits": [name],
   "ground_z": height of the map's ground there, or null,
   "grounds": [heights of all grounds at the rough pose], "level_doubt": text
   or null,
   "evidence": {{"points": matched, "distance": metres, "angle": degrees,
     "sharpness", "spread"}},
   "covariance": 6x6 of x y z roll pitch yaw, or null,
   "alternatives": [{{"T_map_base", "score", "nvtl"}}] other poses, best first,
   "candidates", "map_ms", "search_ms",
   "too_near", "not_finite": points of the scan left out}}
  Where there is no map, "no_map" is true and the others are null, false, 0 or
  empty.
{FAILED_LIMITS} Here also level: the map has several
grounds there (a bridge, a car park), and which one is in doubt.
Exit code: 0; 1 when the pose is not reliable, or there is no map around it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Find an initial pose and return the exit code."""
    return run_command(
        _NAME,
        "Find where a scan was taken, from a pose that is metres and degrees off: the map's ground gives the"
        " height, many candidate poses are scored, and the best are aligned by NDT.",
        _add_options,
        _run,
        argv,
        epilog=_JSON,
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_scan_option(parser)
    add_pose_option(
        parser,
        "--pose",
        "rough pose; the height comes from the map's ground, of several above each other from that which is"
        " clearly nearest to z (with --pose-format xyyaw, each is tried)",
        required=True,
    )
    add_pose_format_option(parser)
    add_sigma_options(parser)
    add_height_option(parser, default=0.0, shown="0, a frame on the ground, such as base_link")
    parser.add_argument(
        "--candidates", type=at_least(1), default=200, metavar="N", help="poses to score (default: 200)"
    )
    parser.add_argument(
        "--seed", type=at_least(0), default=0, metavar="N", help="seed of the random search (default: 0)"
    )
    add_thin_option(parser, default=1.0)
    add_leaf_option(parser)
    add_radius_option(parser)
    add_scoring_options(parser, all_processors=True)
    add_trust_options(parser)
    add_allow_empty(parser)
    add_json_option(parser)
    add_daemon_options(parser, json=False)


def _run(args: argparse.Namespace) -> int:
    from shmmap_clients.map_extent import NoMapHere
    from shmmap_clients.ndt_scan_matcher import pose_from_matrix
    from shmmap_clients.pose_initializer import InitializerRules, PoseInitializer, RoughPose
    from shmmap_clients.scan_drive import read_one_scan
    from shmmap_clients.scans.scan_file import thinned

    x, y, z, roll, pitch, yaw = pose_from_matrix(pose_from(args, "--pose")).tolist()
    known_z = None if args.pose_format == "xyyaw" else z
    rough = RoughPose(x, y, known_z, roll, pitch, yaw, sigma_m=args.sigma, sigma_yaw=args.sigma_yaw)
    rules = InitializerRules(
        map_radius=args.map_radius,
        leaf=args.leaf,
        height=args.height,
        candidates=args.candidates,
        seed=args.seed,
    )
    reader = reader_from(args, _NAME)
    scan = thinned(read_one_scan(args.scan, reader, bag_options_from(args)).xyz, args.thin or None)
    with (
        connect(args, _NAME) as client,
        PoseInitializer(
            client, rules, trust=trust_from(args), threads=args.threads, **scoring_settings(args)
        ) as initializer,
    ):
        try:
            found = initializer.initialize(scan, rough)
        except NoMapHere as error:
            if args.json:
                print_json(_document(None, reader.counts))
            return nothing_found(args, error.message, name=_NAME)
        if initializer.fault is not None:
            complain(_NAME, f"{args.fallback} went on without the device: {initializer.fault}")
    if args.json:
        print_json(_document(found, reader.counts))
    else:
        failed = [initializer.trust.describe(name) for name in found.result.failed_limits]
        failed += [] if found.level_doubt is None else [found.level_doubt]
        _print(found, args.pose_format, failed, reader.left_out)
    return 0 if found.reliable else 1


def _document(found: InitialPose | None, left_out: dict[str, int]) -> dict[str, Any]:
    """Return the result as JSON; None: there is no map."""
    result = None if found is None else found.result
    covariance = None if result is None else result.covariance
    return {
        "T_map_base": None if found is None else found.T_map_base.tolist(),
        "score": None if found is None else found.score,
        "nvtl": None if result is None else result.nvtl,
        "reliable": found is not None and found.reliable,
        "converged": result is not None and result.converged,
        "no_map": result is None or result.no_map,
        "failed_limits": ["no_map"] if found is None else list(found.failed_limits),
        "ground_z": None if found is None else found.ground_z,
        "grounds": [] if found is None else list(found.grounds),
        "level_doubt": None if found is None else found.level_doubt,
        "evidence": None if result is None else asdict(result.evidence),
        "covariance": None if covariance is None else covariance.tolist(),
        "alternatives": [
            {"T_map_base": one.T_map_base.tolist(), "score": one.score, "nvtl": one.nvtl}
            for one in (() if found is None else found.alternatives)
        ],
        "candidates": 0 if found is None else found.candidates,
        "map_ms": None if found is None else found.map_s * 1e3,
        "search_ms": None if found is None else found.search_s * 1e3,
        **left_out,
    }


def _print(found: InitialPose, pose_format: str, failed: list[str], left_out: str) -> None:
    result = found.result
    print(f"pose          {pose_text(found.T_map_base, pose_format)}")
    print("T_map_base")
    for row in found.T_map_base:
        print("  " + " ".join(f"{value:12.6f}" for value in row))
    verdict = "reliable" if found.reliable else f"NOT reliable ({', '.join(failed)})"
    print(f"score         {found.score:.3f}, NVTL {result.nvtl:.3f}: {verdict}")
    others = [f"{z:.1f}" for z in found.grounds if found.ground_z is not None and abs(z - found.ground_z) > 1]
    also = f"; also at {', '.join(others)} m" if others else ""
    print(f"ground        {'none near' if found.ground_z is None else f'{found.ground_z:.3f} m{also}'}")
    for one in found.alternatives:
        x, y, z = one.T_map_base[:3, 3]
        print(f"alternative   ({x:.2f}, {y:.2f}, {z:.2f}) score {one.score:.3f}, NVTL {one.nvtl:.3f}")
    if left_out:
        print(f"left out      {left_out}")
    print(f"time          map {found.map_s * 1e3:.0f} ms, search {found.search_s * 1e3:.0f} ms")
