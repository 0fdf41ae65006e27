# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare apply``: one scan, one map, both files; no daemon."""

from __future__ import annotations

import argparse
from typing import Any

from shmmap_clients.command_line import (
    add_json_option,
    add_scan_option,
    numbers,
    output_file,
    print_json,
    write_text,
    writing_errors,
)
from shmmap_clients.compare_map_filter.cli.rule_options import add_rule_options, rule_from

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "apply",
        help="filter one scan with one map, both files",
        description="Filter one scan with one map file; no daemon is needed.",
        epilog="JSON: points, kept, compare_ms.  The output has the kept points with all fields and a column"
        " index, their rows in the scan; with --mask all points and a column kept.",
    )
    parser.add_argument("--map", required=True, metavar="FILE", help="PCD, NPZ or any cloud file")
    add_scan_option(parser)
    parser.add_argument(
        "--pose",
        type=numbers(7),
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        metavar="X,Y,Z,QX,QY,QZ,QW",
        help="of the sensor in the map, metres (default: the scan is in the map frame)",
    )
    add_rule_options(parser)
    parser.add_argument("--out", metavar="DIR", help="write SCAN.pcd there")
    parser.add_argument("--mask", action="store_true", help="write all points, with a column kept")
    parser.add_argument(
        "--picture", type=output_file, metavar="FILE", help="write an SVG of kept and removed points"
    )
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Filter and print."""
    from pathlib import Path

    from shmmap import build_layer
    from shmmap_clients.compare_map_filter.drive import ComparedScan
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.numpy_path import to_map
    from shmmap_clients.compare_map_filter.output import PcdDirectory
    from shmmap_clients.compare_map_filter.picture import TopView
    from shmmap_clients.scans.scan_file import read_scan, read_scan_fields
    from shmmap_clients.scans.scan_sequence import Scan
    from shmmap_clients.scans.trajectory import matrix_of

    rule = rule_from(args)
    T = matrix_of(args.pose[:3], args.pose[3:])
    scan = Scan(Path(args.scan).stem, 0.0, read_scan_fields(args.scan), T)
    table = build_layer(rule.layer, read_scan(args.map))
    comparison = CompareMapFilter(rule, backend=args.backend).use_tables([table]).apply(scan.xyz, T)
    kept = int(comparison.kept.sum())
    if args.out:
        with writing_errors(args.out):
            PcdDirectory(Path(args.out), mask=args.mask).write(ComparedScan(scan, comparison))
    if args.picture:
        view = TopView()
        view.add(to_map(scan.xyz, T), comparison.kept, (float(T[0, 3]), float(T[1, 3])))
        note = f"{len(scan.xyz)} points, {kept} kept; {args.mode}, {args.distance:g} m"
        write_text(args.picture, view.svg(scan.name, note))
    if args.json:
        milliseconds = comparison.compare_s * 1e3
        print_json({"points": len(scan.xyz), "kept": kept, "compare_ms": milliseconds})
    else:
        print(f"{len(scan.xyz)} points, {kept} kept, {comparison.compare_s * 1e3:.1f} ms")
    return 0
