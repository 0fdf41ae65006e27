# SPDX-License-Identifier: Apache-2.0
"""``shmmap-compare follow``: filter scan after scan with the daemon's map."""

from __future__ import annotations

import argparse
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
    print_json,
    seconds,
    write_text,
    writing_errors,
)
from shmmap_clients.compare_map_filter.cli.rule_options import add_rule_options, rule_from
from shmmap_clients.shared_options import (
    add_json_lines_option,
    add_poses_option,
    add_quiet_option,
    add_radius_option,
    add_scans_option,
)

if TYPE_CHECKING:
    from shmmap_clients.compare_map_filter.drive import DriveStatistics

__all__ = ["add_parser", "run"]

_NAME: Final = "shmmap-compare"
_EPILOG: Final = """\
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


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "follow",
        run,
        help="filter scan after scan around the moving vehicle",
        description="Filter scan after scan with the daemon's map around their poses: what the map explains"
        " is removed.",
        epilog=_EPILOG,
    )
    add_scans_option(parser)
    add_poses_option(parser)
    add_rule_options(parser)
    window = parser.add_argument_group("map around the vehicle")
    add_radius_option(window)
    window.add_argument(
        "--update-distance",
        type=not_negative,
        default=10.0,
        metavar="M",
        help="ask for the next map after so many metres (default: 10)",
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


def run(args: argparse.Namespace) -> int:
    """Follow the scans to their end."""
    from contextlib import ExitStack

    from shmmap import MapWindow
    from shmmap_clients.compare_map_filter.drive import ComparedScan, DriveStatistics, ScanComparer
    from shmmap_clients.compare_map_filter.filter import CompareMapFilter
    from shmmap_clients.compare_map_filter.numpy_path import to_map
    from shmmap_clients.compare_map_filter.output import open_output
    from shmmap_clients.compare_map_filter.picture import TopView
    from shmmap_clients.map_extent import map_extent
    from shmmap_clients.scan_drive import ScanDrive
    from shmmap_clients.scans.scan_sequence import Scan
    from shmmap_clients.streams import is_endpoint

    rule = rule_from(args)
    compare = CompareMapFilter(rule, backend=args.backend)  # compiles before any scan waits
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
