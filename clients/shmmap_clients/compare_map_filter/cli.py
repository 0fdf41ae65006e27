# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-compare``: ``follow`` a drive on the daemon's map, ``apply`` to files, ``warmup``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    connect,
    not_negative,
    nothing_found,
    output_file,
    positive,
    print_json,
    run_program,
    seconds,
    write_text,
    writing_errors,
)
from shmmap_clients.shared_options import (
    add_backend_option,
    add_json_lines_option,
    add_pose_format_option,
    add_pose_option,
    add_poses_option,
    add_quiet_option,
    add_radius_option,
    add_scan_option,
    add_scans_option,
    bag_options_from,
    pose_from,
    reader_from,
)

if TYPE_CHECKING:
    from shmmap_clients.compare_map_filter.drive import DriveStatistics
    from shmmap_clients.compare_map_filter.rule import CompareRule

_NAME: Final = "shmmap-compare"
_FOLLOW_JSON: Final = """\
JSON (fields may be added, none is removed).
--json prints one document at the end:
  {"scans", "points", "kept", "too_near", "not_finite": points left out,
   "no_map_scans": without a map around them,
   "incomplete_scans": compared while cells around them were missing,
   "first_missing": the first of these and what it lacked, or null,
   "updates": how often the cells around the vehicle changed,
   "compare_ms", "update_ms": {"p50", "p99", "max"}, or null}
--json-lines writes a line for each scan:
  {"name", "stamp_s", "points", "kept", "cells", "no_map",
   "missing": text or null, "compare_ms", "update_ms"}

Exit code: 0; 1 when a scan had no map around it, cells were missing, there was
no scan, or no point was kept."""
_APPLY_JSON: Final = """\
JSON (fields may be added, none is removed):
  {"points", "kept", "no_map": bool, "too_near", "not_finite": points left out,
   "compare_ms"}
The file written has the kept points with all fields, and a column index: their
rows in the scan; with --mask all points, and a column kept (1: not explained by
the map).
Exit code: 0; 1 when there is no map around the scan, or no point is kept."""


def _add_rule_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("rule (Autoware's compare-map filters)")
    group.add_argument(
        "--mode",
        choices=("voxel", "voxel-distance", "distance"),
        default="voxel",
        help="a point is removed when voxel: a voxel's centroid is near it; voxel-distance: a map point is in"
        " its voxel or near it; distance: a map point is near it (default: voxel)",
    )
    group.add_argument(
        "--distance", type=positive, default=0.5, metavar="M", help="what near means (default: 0.5)"
    )
    group.add_argument(
        "--z-ratio",
        type=positive,
        default=0.5,
        metavar="R",
        help="height of a voxel, as a multiple of --distance (default: 0.5)",
    )
    add_backend_option(group)


def _rule_from(args: argparse.Namespace) -> CompareRule:
    """Return the rule of the options."""
    from shmmap_clients.compare_map_filter.rule import CompareRule

    return CompareRule(args.mode, args.distance, args.z_ratio)


def _add_follow(subparsers: Any) -> None:
    """Add ``follow``."""
    parser = add_verb(
        subparsers,
        "follow",
        _follow,
        help="filter scan after scan around the moving vehicle",
        description="Filter scan after scan with the daemon's map around their poses: what the map explains"
        " is removed.",
        epilog=_FOLLOW_JSON,
    )
    add_scans_option(parser)
    add_poses_option(parser)
    _add_rule_options(parser)
    window = parser.add_argument_group("map around the vehicle")
    add_radius_option(window)
    window.add_argument(
        "--update-distance",
        type=not_negative,
        default=10.0,
        metavar="M",
        help="distance after which the next map is asked for (default: 10)",
    )
    window.add_argument(
        "--wait",
        type=seconds,
        metavar="SECONDS",
        help="how long a scan may wait for cells (default: 30 for a directory, not at all for a publisher)",
    )
    out = parser.add_argument_group("output")
    out.add_argument(
        "--out", metavar="DIR|ENDPOINT", help="write PCD files, or publish scans at this ZeroMQ address"
    )
    out.add_argument(
        "--mask",
        action="store_true",
        help="give all points, with a column named kept (1: not explained by the map)",
    )
    out.add_argument(
        "--picture", type=output_file, metavar="FILE", help="write an SVG of kept and removed points"
    )
    add_json_lines_option(out)
    add_quiet_option(out)
    add_allow_empty(parser)
    add_json_option(parser)
    add_daemon_options(parser, json=False)


def _follow(args: argparse.Namespace) -> int:
    """Follow the scans to their end."""
    from contextlib import ExitStack

    from shmmap import MapWindow
    from shmmap_clients.compare_map_filter.drive import ComparedScan, DriveStatistics, ScanComparer
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.output import TopView, open_output
    from shmmap_clients.compare_map_filter.rule import to_map
    from shmmap_clients.map_extent import map_extent
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.scan_sequence import Scan
    from shmmap_clients.streams import is_endpoint

    rule = _rule_from(args)
    compare = CompareMapFilter(rule, backend=args.backend)  # compile before the first scan
    statistics, view = DriveStatistics(), TopView()
    wait_s = args.wait if args.wait is not None else (None if is_endpoint(args.scans) else 30.0)
    with ExitStack() as stack:
        drive = ScanDrive(args, _NAME, args.poses, stack)
        client = stack.enter_context(connect(args, _NAME))
        window = stack.enter_context(
            MapWindow(client, args.map_radius, layers=rule.layer, update_distance=args.update_distance)
        )
        comparer = ScanComparer(window, compare, first_wait_s=30.0, wait_s=wait_s)
        output = None
        if args.out:
            stack.enter_context(writing_errors(args.out))
            output = open_output(args.out, mask=args.mask, wait_s=30.0)
            stack.callback(output.close)

        def step(scan: Scan) -> ComparedScan:
            compared = comparer(scan)
            x, y = scan.pose[:2, 3].tolist()
            if output is not None:
                output.write(compared)
            if args.picture:
                view.add(to_map(scan.xyz, scan.pose), compared.comparison.kept, (x, y))
            if compared.comparison.no_map and not statistics.no_map:
                drive.say(f"no map around scan {scan.name}: {map_extent(client, (x, y))}")
            return compared

        drive.run(step, statistics, statistics.document)
        compare.use_cells(())
    if args.picture:
        note = (
            f"{statistics.scans} scans, {statistics.points} points, {statistics.kept} kept;"
            f" {args.mode}, {args.distance:g} m"
        )
        write_text(args.picture, view.svg(_NAME, note))
    if args.json:
        print_json({**statistics.summary(), **drive.reader.counts})
    else:
        _print(statistics, drive.reader.left_out)
    if not statistics.scans:
        return drive.no_scans()
    return _exit_code(args, statistics)


def _print(statistics: DriveStatistics, left_out: str) -> None:
    times = statistics.summary()["compare_ms"]
    spent = f" {times['p50']:.1f} ms each (p99 {times['p99']:.1f});" if times else ""
    print(
        f"{statistics.scans} scans, {statistics.points} points, {statistics.kept} kept;{spent}"
        f" {statistics.incomplete} scans with cells missing, {statistics.no_map} without a map"
        + (f"; left out: {left_out}" if left_out else "")
    )


def _exit_code(args: argparse.Namespace, statistics: DriveStatistics) -> int:
    code = 1 if statistics.incomplete or (statistics.no_map and not args.allow_empty) else 0
    if not statistics.kept:
        explained = f"the map explains all {statistics.points} points"
        return max(code, nothing_found(args, f"no point was kept: {explained}", name=_NAME))
    return code


def _add_apply(subparsers: Any) -> None:
    """Add ``apply``."""
    parser = add_verb(
        subparsers,
        "apply",
        _apply,
        help="filter one scan with one map file; no daemon",
        description="Filter one scan with one map file; no daemon is needed.",
        epilog=_APPLY_JSON,
    )
    parser.add_argument("--map", required=True, metavar="FILE", help="map: PCD, NPZ or any other cloud file")
    add_scan_option(parser)
    add_pose_option(
        parser, "--pose", "pose of the frame that the points are in (default: they are in the map frame)"
    )
    add_pose_format_option(parser)
    _add_rule_options(parser)
    out = parser.add_argument_group("output")
    out.add_argument("--out", metavar="DIR", help="write SCAN.pcd into this directory")
    out.add_argument(
        "--mask",
        action="store_true",
        help="write all points, with a column named kept (1: not explained by the map)",
    )
    out.add_argument(
        "--picture", type=output_file, metavar="FILE", help="write an SVG of kept and removed points"
    )
    add_allow_empty(parser)
    add_json_option(parser)


def _apply(args: argparse.Namespace) -> int:
    """Filter the files, and print the results."""
    import dataclasses
    from pathlib import Path

    import numpy as np

    from shmmap.layers import build_layer
    from shmmap_clients.compare_map_filter.drive import ComparedScan
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.output import PcdDirectory, TopView
    from shmmap_clients.compare_map_filter.rule import to_map
    from shmmap_clients.map_extent import extent_text
    from shmmap_clients.scan_drive import read_one_scan

    rule = _rule_from(args)
    T = pose_from(args, "--pose") if args.pose is not None else np.eye(4)
    reader = reader_from(args, _NAME)
    scan = dataclasses.replace(read_one_scan(args.scan, reader, bag_options_from(args)), T_map_sensor=T)
    table = build_layer(rule.layer, reader_from(args, _NAME, min_range=0.0).points(args.map))
    compare = CompareMapFilter(rule, backend=args.backend).use_tables([table])
    comparison = compare.apply(scan.xyz, T)
    kept = int(comparison.kept.sum())
    if args.out:
        with writing_errors(args.out):
            PcdDirectory(Path(args.out), mask=args.mask).write(ComparedScan(scan, comparison))
    if args.picture:
        view = TopView()
        view.add(to_map(scan.xyz, T), comparison.kept, (float(T[0, 3]), float(T[1, 3])))
        note = f"{len(scan.xyz)} points, {kept} kept; {args.mode}, {args.distance:g} m"
        write_text(args.picture, view.svg(scan.name, note))
    milliseconds = comparison.compare_s * 1e3
    if args.json:
        found = {"points": len(scan.xyz), "kept": kept, "no_map": comparison.no_map}
        print_json({**found, **reader.counts, "compare_ms": milliseconds})
    else:
        left_out = f"; left out: {reader.left_out}" if reader.left_out else ""
        print(f"{len(scan.xyz)} points, {kept} kept, {milliseconds:.1f} ms{left_out}")
    if comparison.no_map:
        where = extent_text(compare.bounds, T[:2, 3])
        return nothing_found(args, f"no map around the scan: {where}", name=_NAME)
    if not kept:
        why = "the map explains all of them" if len(scan.xyz) else f"{args.scan} has none"
        return nothing_found(args, f"no point is kept: {why}", name=_NAME)
    return 0


def _add_warmup(subparsers: Any) -> None:
    """Add ``warmup``."""
    parser = subparsers.add_parser(
        "warmup",
        help="compile the kernel and cache it",
        description="Compile the kernel and keep it (~/.cache/shmmap/kernels, or NUMBA_CACHE_DIR), so"
        " that no filter has to wait for the compiler.",
    )
    parser.set_defaults(run=_warmup)


def _warmup(args: argparse.Namespace) -> int:
    """Import the kernel, which compiles it for all its types."""
    import time

    del args
    begin = time.perf_counter()
    from shmmap_clients.compare_map_filter import kernel

    variants = len(kernel.explain.signatures)  # type: ignore[attr-defined]
    print(f"{variants} variants ready after {time.perf_counter() - begin:.1f} s")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(
        _NAME,
        "Remove from LiDAR scans what a point-cloud map explains; what moved is left.",
        (_add_follow, _add_apply, _add_warmup),
        argv,
    )
