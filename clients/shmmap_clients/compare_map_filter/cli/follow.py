# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare follow``: a drive through the daemon's map."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from shmmap_clients.command_line import (
    add_daemon_options,
    add_json_option,
    connect,
    output_file,
    print_json,
    seconds,
    write_text,
    writing_errors,
)
from shmmap_clients.compare_map_filter.cli.rule_options import add_rule_options, rule_from

__all__ = ["add_parser", "run"]

_JSON = (
    "JSON: scans, points, kept, incomplete_scans (compared while cells of the window were missing),"
    " first_missing (the first of them, and what it lacked), updates (how often the window's cells changed),"
    " compare_ms and update_ms (p50, p99, max; null without any)."
    "  Exit code: 0, or 1 where a scan was compared with cells missing."
)


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "follow",
        help="filter scan after scan around the moving vehicle",
        description="Filter scans with the daemon's map, in a window that follows their poses.",
        epilog=_JSON,
    )
    parser.add_argument(
        "--scans", required=True, metavar="DIR|ENDPOINT", help="a directory (PCD, NPZ, .bin), or a publisher"
    )
    parser.add_argument("--poses", metavar="FILE", help="T_map_sensor of each scan, TUM format")
    add_rule_options(parser)
    window = parser.add_argument_group("window")
    window.add_argument("--radius", type=float, default=150.0, metavar="M", help="default 150")
    window.add_argument("--update-distance", type=float, default=10.0, metavar="M", help="default 10")
    window.add_argument(
        "--wait", type=seconds, metavar="SECONDS",
        help="how long a scan may wait for cells (default: 30 for a directory, not at all for a publisher)",
    )  # fmt: skip
    output = parser.add_argument_group("output")
    output.add_argument("--out", metavar="DIR|ENDPOINT", help="PCD files, or a publisher's address to bind")
    output.add_argument(
        "--mask", action="store_true", help="all points with a column kept, not the kept ones"
    )
    output.add_argument(
        "--picture", type=output_file, metavar="FILE", help="an SVG of kept and removed points"
    )
    output.add_argument("--quiet", action="store_true", help="no line for each scan on stderr")
    add_json_option(output)
    add_daemon_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Follow the scans to their end."""
    from contextlib import ExitStack

    from shmmap import MapWindow
    from shmmap_clients.compare_map_filter.drive import compare_drive
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.numpy_path import to_map
    from shmmap_clients.compare_map_filter.output import open_output
    from shmmap_clients.compare_map_filter.picture import TopView
    from shmmap_clients.compare_map_filter.statistics import DriveStatistics
    from shmmap_clients.scans.scan_source import open_scans
    from shmmap_clients.streams import is_endpoint

    rule = rule_from(args)
    compare = CompareMapFilter(rule, backend=args.backend)  # compiles before anybody waits
    statistics, view = DriveStatistics(), TopView()
    wait_s = args.wait if args.wait is not None else (None if is_endpoint(args.scans) else 30.0)
    with ExitStack() as stack:
        scans = open_scans(args.scans, args.poses, stack)
        client = stack.enter_context(connect(args, "shmmap-compare"))
        window = stack.enter_context(
            MapWindow(client, args.radius, layers=rule.layer, update_distance=args.update_distance)
        )
        output = None
        if args.out:
            stack.enter_context(writing_errors(args.out))
            output = open_output(args.out, mask=args.mask, wait_s=30.0)
            stack.callback(output.close)
        for compared in compare_drive(scans, window, compare, first_wait_s=30.0, wait_s=wait_s):
            statistics.add(compared)
            if output is not None:
                output.write(compared)
            T = compared.scan.T_map_sensor
            if args.picture and T is not None:
                position = (float(T[0, 3]), float(T[1, 3]))
                view.add(to_map(compared.scan.xyz, T), compared.comparison.kept, position)
            if not args.quiet:
                print(statistics.line(compared), file=sys.stderr)
        compare.use_cells(())
    summary = statistics.summary()
    if args.picture:
        note = (
            f"{statistics.scans} scans, {statistics.points} points, {statistics.kept} kept;"
            f" {args.mode}, {args.distance:g} m"
        )
        write_text(args.picture, view.svg("shmmap-compare", note))
    if args.json:
        print_json(summary)
    else:
        times = summary["compare_ms"] or {"p50": 0.0, "p99": 0.0}
        print(
            f"{statistics.scans} scans, {statistics.points} points, {statistics.kept} kept;"
            f" {times['p50']:.1f} ms each (p99 {times['p99']:.1f});"
            f" {statistics.incomplete} scans with cells missing"
        )
    return 1 if statistics.incomplete or not statistics.scans else 0
