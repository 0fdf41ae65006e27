# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare apply``: one scan, one map, both files; no daemon."""

from __future__ import annotations

import argparse
from typing import Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_json_option,
    add_verb,
    nothing_found,
    output_file,
    print_json,
    write_text,
    writing_errors,
)
from shmmap_clients.compare_map_filter.cli.rule_options import add_rule_options, rule_from
from shmmap_clients.pose_option import add_pose_format_option, add_pose_option, pose_from
from shmmap_clients.shared_options import add_scan_option, reader_from

__all__ = ["add_parser", "run"]

_EPILOG: Final = """\
JSON (fields may be added, none is removed):
  {"points", "kept", "no_map": bool, "too_near", "not_finite": points left out,
   "compare_ms"}
The file written has the kept points with all fields, and a column index: their
rows in the scan; with --mask all points, and a column kept (1: not explained by
the map).
Exit code: 0; 1 when there is no map around the scan, or no point is kept."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "apply",
        run,
        help="filter one scan with one map file; no daemon",
        description="Filter one scan with one map file; no daemon is needed.",
        epilog=_EPILOG,
    )
    parser.add_argument("--map", required=True, metavar="FILE", help="map: PCD, NPZ or any other cloud file")
    add_scan_option(parser)
    add_pose_option(
        parser, "--pose", "pose of the frame that the points are in (default: they are in the map frame)"
    )
    add_pose_format_option(parser)
    add_rule_options(parser)
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


def run(args: argparse.Namespace) -> int:
    """Filter and print."""
    from pathlib import Path

    import numpy as np

    from shmmap.layers import build_layer
    from shmmap_clients.compare_map_filter.drive import ComparedScan
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.numpy_path import to_map
    from shmmap_clients.compare_map_filter.output import PcdDirectory
    from shmmap_clients.compare_map_filter.picture import TopView
    from shmmap_clients.map_extent import extent_text
    from shmmap_clients.scans.scan_names import stem
    from shmmap_clients.scans.scan_sequence import Scan

    rule = rule_from(args)
    T = pose_from(args, "--pose") if args.pose is not None else np.eye(4)
    reader = reader_from(args, "shmmap-compare")
    columns, rows = reader.screened(reader.read(args.scan))
    scan = Scan(stem(Path(args.scan)), 0.0, columns, T, rows=rows)
    table = build_layer(rule.layer, reader_from(args, "shmmap-compare", min_range=0.0).points(args.map))
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
        return nothing_found(args, f"no map around the scan: {where}", name="shmmap-compare")
    if not kept:
        why = "the map explains all of them" if len(scan.xyz) else f"{args.scan} has none"
        return nothing_found(args, f"no point is kept: {why}", name="shmmap-compare")
    return 0
