# SPDX-License-Identifier: Apache-2.0
"""``shmmap-rolling run``: map scan after scan into a live map of the daemon."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    announce_scans,
    complain,
    connect,
    nothing_found,
    output_file,
    print_json,
    print_line,
    seconds,
    write_text,
)
from shmmap_clients.rolling_map.cli.map_options import (
    add_filter_options,
    add_params_option,
    add_show_option,
    parameters_from,
    scan_filter_from,
    shown_from,
)
from shmmap_clients.shared_options import add_quiet_option, add_scans_option, reader_from

if TYPE_CHECKING:
    from shmmap import LiveMap, LiveMapper
    from shmmap_clients.rolling_map.parameters import Parameters, Shown
    from shmmap_clients.rolling_map.statistics import DriveStatistics

__all__ = ["add_parser", "run"]

_NAME: Final = "shmmap-rolling"
_EPILOG: Final = """\
JSON (fields may be added, none is removed):
  {"map", "scans", "points",
   "counts": {"near": in range, "far": beyond it, "too_near", "outside_z",
              "not_finite": left out},
   "first_scan", "last_scan": their numbers, or null,
   "applied", "durable": number of the newest scan in memory, on the disk,
   "add_ms": {"p50", "p99", "max"}, or null,
   "usage": {"active": voxels that are known, "bytes", "chunks",
             "waiting_bytes"},
   "chunks": {state: how many}}

Exit code: 0; 1 when there was no scan, no point of any scan counted, or the
last scan was not on the disk after --wait."""


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "run",
        run,
        help="map scan after scan",
        description="Map scan after scan into a live map of the daemon (`shmmap serve --live NAME`).  The"
        " map's window follows the poses.",
        epilog=_EPILOG,
    )
    parser.add_argument("--live", required=True, metavar="NAME", help="name of the live map")
    add_scans_option(parser, min_range=False)
    parser.add_argument(
        "--poses",
        metavar="FILE",
        help="poses of the frame that the points are in, for the scans of a directory, TUM format; a"
        " publisher's scans bring theirs",
    )
    add_params_option(parser)
    parser.add_argument(
        "--mapper",
        default=_NAME,
        metavar="NAME",
        help=f"name under which scans are counted: each running program needs its own (default: {_NAME})",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="begin after the scans of this directory that are in the map already: where a run of the same"
        " command was killed, or ended by a restart",
    )
    parser.add_argument(
        "--frame",
        metavar="ID",
        help="frame of the poses: another one than the map's is refused (default: as --params says, else the"
        " map's)",
    )
    add_filter_options(parser)
    out = parser.add_argument_group("output")
    out.add_argument(
        "--picture",
        type=output_file,
        metavar="FILE",
        help="write an SVG of the map at the end",
    )
    add_show_option(out)
    out.add_argument(
        "--wait",
        type=seconds,
        default=30.0,
        metavar="SECONDS",
        help="how long to wait at the end until all scans are on the disk; 0: not at all (default: 30)",
    )
    add_quiet_option(out)
    add_allow_empty(parser)
    add_json_option(parser)
    add_daemon_options(parser, json=False)


def run(args: argparse.Namespace) -> int:
    """Map the scans to their end."""
    from shmmap import BadRequest
    from shmmap_clients.rolling_map.drive import map_drive
    from shmmap_clients.rolling_map.statistics import DriveStatistics
    from shmmap_clients.scans.scan_sequence import ScanSequence
    from shmmap_clients.scans.scan_source import open_scans
    from shmmap_clients.streams import is_endpoint

    parameters = parameters_from(args)
    shown = shown_from(args, parameters)
    scan_filter = scan_filter_from(args, parameters)
    if args.resume and is_endpoint(args.scans):
        raise BadRequest(
            "--resume is for a directory of scans",
            hint="leave it out: a publisher's scans count as they come",
        )
    statistics = DriveStatistics()
    with contextlib.ExitStack() as stack:
        # the map's own limits leave out points and count them
        scans = open_scans(args.scans, args.poses, stack, reader_from(args, _NAME, min_range=None))
        client = stack.enter_context(connect(args, _NAME))
        live = client.live(args.live, frame_id=_frame(args, parameters))
        if parameters is not None:
            parameters.check_map(live)
        mapper = stack.enter_context(live.mapper(args.mapper, scan_filter, resume=args.resume))
        if isinstance(scans, ScanSequence) and args.resume:
            if mapper.applied > len(scans):
                raise BadRequest(
                    f"{args.scans} has {len(scans)} scans, but {mapper.applied} of mapper {args.mapper} are"
                    " in the map",
                    hint="--resume is for the same directory as in the run before; leave it out for another",
                )
            scans.leave_out(mapper.applied)
            print_line(f"{mapper.applied} scans are in the map, {len(scans)} are left", file=sys.stderr)
        announce_scans(args)
        for mapped in map_drive(scans, mapper):
            statistics.add(mapped)
            if not args.quiet:
                usage = f"; {_usage_now(live)}" if shown.usage else ""
                print_line(statistics.line(mapped) + usage, file=sys.stderr)
        code = _settled(args, mapper, statistics)
        if args.picture:
            _draw(args, live, shown, statistics)
        _report(args, live, mapper, statistics)
    return code


def _frame(args: argparse.Namespace, parameters: Parameters | None) -> str:
    """Frame of the poses; empty for the map's."""
    if args.frame is not None:
        return str(args.frame)
    if parameters is not None and "map_frame" in parameters.origins:
        return parameters.live.frame_id
    return ""


def _usage_now(live: LiveMap) -> str:
    """What the map takes; a daemon that is away keeps no scan from being read."""
    from shmmap import DaemonUnreachable, LiveInterrupted
    from shmmap_clients.rolling_map.statistics import usage_text

    try:
        return usage_text(live.status())
    except (DaemonUnreachable, LiveInterrupted):
        return "the daemon does not answer"


def _settled(args: argparse.Namespace, mapper: LiveMapper, statistics: DriveStatistics) -> int:
    """Wait until everything is in memory and on the disk; returns the exit code."""
    from shmmap import NoAnswer

    last = statistics.last
    if last is None and args.resume and mapper.applied:
        return 0  # an earlier run had come to the end
    if last is None:
        return nothing_found(args, f"no scan came from {args.scans}", name=_NAME)
    if args.wait > 0:
        end_s = time.monotonic() + args.wait
        with contextlib.suppress(NoAnswer):  # what is missing is told below
            mapper.wait_applied(args.wait)
            mapper.wait_durable(max(0.1, end_s - time.monotonic()))
        if mapper.durable < last:
            missing = f"scan {last} is not on the disk after {args.wait:g} s, but scan {mapper.durable}"
            complain(_NAME, missing, "the daemon goes on; `shmmap live show` says how far it is")
            return 1
    if not statistics.counted:
        why = f"of {statistics.points} points {statistics.left_out}" if statistics.points else "none had any"
        return nothing_found(args, f"no point of any scan counted: {why}", name=_NAME)
    return 0


def _draw(args: argparse.Namespace, live: LiveMap, shown: Shown, statistics: DriveStatistics) -> None:
    import numpy as np

    from shmmap_clients.rolling_map.picture import MapContent, map_picture
    from shmmap_clients.rolling_map.statistics import usage_text
    from shmmap_clients.rolling_map.voxel_parts import all_voxels

    nothing = np.empty((0, 3))
    content = MapContent(
        live.resolution,
        all_voxels(live, "occupied") if shown.occupied else nothing,
        all_voxels(live, "free") if shown.free else nothing,
        live.chunks(saved=True) if shown.chunks else (),
        statistics.path,
        usage_text(live.status()) if shown.usage else "",
    )
    note = f"{statistics.scans} scans, voxels of {live.resolution:g} m, frame {live.frame_id}"
    write_text(args.picture, map_picture(content, f"live map {live.name}", note))


def _report(args: argparse.Namespace, live: LiveMap, mapper: LiveMapper, statistics: DriveStatistics) -> None:
    from collections import Counter

    from shmmap_clients.rolling_map.statistics import states_text, usage_text

    usage, chunks = live.status(), live.chunks(saved=True)
    summary = statistics.summary(applied=mapper.applied, durable=mapper.durable)
    if args.json:
        fields = ("active", "bytes", "chunks", "waiting_bytes")
        print_json(
            {
                "map": live.name,
                **summary,
                "usage": {name: getattr(usage, name) for name in fields},
                "chunks": dict(Counter(row.state for row in chunks)),
            }
        )
        return
    times = summary["add_ms"]
    spent = f"; {times['p50']:.1f} ms each (p99 {times['p99']:.1f})" if times else ""
    left_out = f"; left out: {statistics.left_out}" if statistics.left_out else ""
    print(
        f"{statistics.scans} scans, {statistics.points} points, {statistics.counted} count{left_out}{spent}"
    )
    print(f"live map {live.name}: {usage_text(usage)}; {states_text(chunks)}")
