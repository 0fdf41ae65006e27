# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``: the whole thing on a generated town, without a map or any configuration."""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import Column, format_bytes, format_duration, print_json, print_table
from shmmap.errors import CannotWrite

if TYPE_CHECKING:
    from shmmap_clients.demo.full_demo import FullDemoResult

    from shmmap.demo.demo import DemoResult, DriveResult

__all__ = ["add_parser", "run"]

_JSON = """\
  {"town": {"cells", "points", "file_bytes", "build_s"},
   "shared": DRIVE, "private": DRIVE,
   "wire": {"requests", "request_bytes", "reply_bytes", "handles"}, "svg": path, "seconds"}
  DRIVE: {"processes", "cells", "points", "map_bytes": of one consumer's window,
          "start_s": until all have their first window,
          "updates": how often a consumer got new cells after that; these are about updates only:
          "follow_s", "follow_max_s": how long its control loop waited, median and longest,
          "complete_s": until the new cells were there, median,
          "warm_updates", "warm_complete_s": those with all cells in memory already (null: none),
          "handed_bytes": columns that all consumers got,
          "process_bytes": memory of the processes without shared memory,
          "shm_bytes": shared memory, counted once, "total_bytes": both,
          "pss_bytes", "private_bytes": as the kernel counts them}
  With --full: {"town": {"cells", "points"}, "scans", "seconds", "shm_bytes", "programs":
  {"ndt", "compare", "elevation": what each printed}, "memory": {...: {"own_bytes",
  "growth_bytes": more in the last third of the drive than in the middle one,
  "shared_bytes": of the map, mapped}}, "svg"}; exit code 1 where a scan was lost or not trusted"""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "demo",
        run,
        help="see it work: no map needed, under a minute",
        description="Build a town, start a daemon, drive through it with four processes, and "
        "compare that with four private copies.",
        json=_JSON,
    )
    parser.add_argument("--svg", metavar="FILE", help="where the picture goes (default: ./shmmap-demo.svg)")
    parser.add_argument("--keep-map", metavar="DIR", help="build the map in DIR, and leave it there")
    parser.add_argument(
        "--density",
        metavar="POINTS",
        type=_density,
        help="points per square metre of ground; fewer are quicker (default: 100, or what fits)",
    )
    parser.add_argument(
        "--full",
        action="store_true",
        help="drive with the real programs instead: localization, compare filter and elevation map"
        " beside one another, on simulated scans among moving cars (a minute or two)",
    )
    add_json_option(parser)


def _density(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 2.0 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"expected 2 to 1000 points per square metre, not {text!r}")
    return value


def run(args: argparse.Namespace) -> int:
    """Run the demonstration and print what it measured."""
    import time

    from shmmap_clients.demo.full_demo import FullDemoResult, run_full_demo

    from shmmap.cli.screens.demo_progress import progress_for
    from shmmap.demo.demo import run_demo
    from shmmap.demo.demo_town import DemoSettings
    from shmmap.demo.interrupts import signals_interrupt

    picture = _picture_path(args.svg)
    started_s = time.monotonic()
    with signals_interrupt(), progress_for(quiet=args.json) as progress:
        settings = DemoSettings() if args.density is None else DemoSettings(density=args.density)
        result: DemoResult | FullDemoResult
        result = (run_full_demo if args.full else run_demo)(settings, progress, map_dir=args.keep_map)
    duration_s = time.monotonic() - started_s
    if isinstance(result, FullDemoResult):
        return _report_full(result, picture, duration_s, args)
    picture.write_text(_draw(result), encoding="utf-8")
    if args.json:
        print_json(_as_json(result, str(picture), duration_s))
    else:
        _print_text(result)
        print(f"{format_duration(duration_s)} in all.  Picture of town, route and resident cells: {picture}")
        _tell_kept_map(args)
    return 0


def _report_full(result: FullDemoResult, picture: Path, duration_s: float, args: argparse.Namespace) -> int:
    """Print what the three programs did; exit code 1 where a scan was lost or could not be trusted."""
    from shmmap_clients.demo.three_programs import table

    picture.write_text(result.picture_svg, encoding="utf-8")
    runs = result.programs.programs
    documents = {name: run.document for name, run in runs.items()}
    scans = result.programs.scans
    if args.json:
        memory = {
            name: {
                "own_bytes": max(run.own_bytes, default=0),
                "growth_bytes": run.growth_bytes,
                "shared_bytes": run.shared_bytes,
            }
            for name, run in runs.items()
        }
        print_json(
            {
                "town": {"cells": result.town.cells, "points": result.town.points},
                "scans": scans,
                "seconds": round(result.programs.seconds, 3),
                "shm_bytes": max(result.programs.segment_bytes, default=0),
                "programs": documents,
                "memory": memory,
                "svg": str(picture),
            }
        )
    else:
        print()
        print("\n".join(table(result.programs)))
        print(
            f"{format_duration(duration_s)} in all.  Kept by the compare filter (red) and removed: {picture}"
        )
        _tell_kept_map(args)
    good = documents["ndt"]["trustworthy"] == documents["compare"]["scans"] == scans
    return 0 if good and not documents["compare"]["incomplete_scans"] else 1


def _tell_kept_map(args: argparse.Namespace) -> None:
    if args.keep_map:
        print(f"Serve the town yourself: shmmap serve {args.keep_map}")


def _picture_path(named: str | None) -> Path:
    """Find out before the work begins where the picture can be written."""
    path = Path(named or "shmmap-demo.svg").absolute()
    if (
        path.parent.is_dir()
        and not path.is_dir()
        and os.access(path if path.exists() else path.parent, os.W_OK)
    ):
        return path
    if named:
        raise CannotWrite(f"{path} cannot be written", hint="give another --svg FILE")
    return Path(tempfile.gettempdir(), path.name)


def _as_json(result: DemoResult, picture: str, duration_s: float) -> dict[str, object]:
    return {
        "town": {
            "cells": result.town.cells,
            "points": result.town.points,
            "file_bytes": result.town.file_bytes,
            "build_s": round(result.town.build_s, 3),
        },
        "shared": _drive_as_json(result.shared),
        "private": _drive_as_json(result.private),
        "wire": {
            "requests": result.traffic.requests,
            "request_bytes": result.traffic.request_bytes,
            "reply_bytes": result.traffic.reply_bytes,
            "handles": result.traffic.handles,
        },
        "svg": picture,
        "seconds": round(duration_s, 3),
    }


def _drive_as_json(drive: DriveResult) -> dict[str, object]:
    return {
        "processes": drive.processes,
        "cells": drive.cells,
        "points": drive.points,
        "map_bytes": drive.map_bytes,
        "start_s": round(drive.start_s, 6),
        "updates": drive.updates,
        "follow_s": _seconds(drive.follow_s),
        "follow_max_s": _seconds(drive.follow_max_s),
        "complete_s": _seconds(drive.complete_s),
        "warm_updates": drive.warm_updates,
        "warm_complete_s": _seconds(drive.warm_complete_s),
        "handed_bytes": drive.handed_bytes,
        "process_bytes": drive.memory.own_bytes,
        "shm_bytes": drive.shm_bytes,
        "total_bytes": drive.total_bytes,
        "pss_bytes": drive.memory.pss_bytes,
        "private_bytes": drive.memory.private_bytes,
    }


def _seconds(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)


def _print_text(result: DemoResult) -> None:
    shared, private = result.shared, result.private
    wire_bytes = result.traffic.request_bytes + result.traffic.reply_bytes
    rows = [
        ["processes", f"4 and {shared.processes - 4} of the daemon", "4"],
        ["cells around the vehicle", f"{shared.cells}", f"{private.cells}"],
        ["points in them", f"{shared.points / 1e6:.1f} million", f"{private.points / 1e6:.1f} million"],
        ["shared memory, window and spare", format_bytes(shared.shm_bytes), "none"],
        [
            "memory of the processes",
            format_bytes(shared.memory.own_bytes),
            format_bytes(private.memory.own_bytes),
        ],
        ["all memory", format_bytes(shared.total_bytes), format_bytes(private.total_bytes)],
        ["until all four have a window", format_duration(shared.start_s), format_duration(private.start_s)],
        [
            "an update holds the vehicle up",
            format_duration(shared.follow_s),
            format_duration(private.follow_s),
        ],
        ["... at most", format_duration(shared.follow_max_s), format_duration(private.follow_max_s)],
        [
            "new cells are there after",
            format_duration(shared.complete_s),
            format_duration(private.complete_s),
        ],
    ]
    if shared.warm_updates:
        rows.append(["... if in shared memory already", format_duration(shared.warm_complete_s), "-"])
    rows.append(["messages, all together", format_bytes(wire_bytes), "-"])
    print()
    print_table(
        (Column(""), Column("ONE SHARED COPY", "right"), Column("FOUR PRIVATE COPIES", "right")), rows
    )
    print(
        f"In {len(result.town.route)} poses four processes got {format_bytes(shared.handed_bytes)} of points"
        f" through {format_bytes(wire_bytes)} of messages."
    )
    each_bytes = shared.memory.own_bytes / shared.processes
    print(
        f"One process more takes about {format_bytes(each_bytes)}, with a copy of its own"
        f" {format_bytes(private.total_bytes / 4)}."
    )
    print("Memory as the kernel counts it (/proc/PID/smaps_rollup), the daemon and its workers included.")


def _draw(result: DemoResult) -> str:
    from shmmap.cli.screens.picture import CellSquare, Raster, Vehicle, top_view_svg

    town = result.town
    states = {row.box: row for row in result.resident}
    cells = []
    for box in town.boxes:
        row = states.get(box)
        title = f"{box[0]:g}, {box[1]:g}" + (f": {row.points:,} points, {row.state}" if row else "")
        cells.append(CellSquare(box, row.state if row else "", title))
    last = town.route[-1]
    resident = sum(1 for cell in cells if cell.state == "resident")
    return top_view_svg(
        town.bounds,
        cells,
        title=f"A generated town: {town.cells} cells, {town.points / 1e6:.1f} million points",
        note=f"At the end of the drive {resident} cells are in shared memory, once for all processes:"
        f" {format_bytes(result.shared.shm_bytes)}.",
        raster=Raster(town.bounds, town.picture_png),
        driven=[(pose.x, pose.y) for pose in town.route],
        vehicle=Vehicle(last.x, last.y, last.heading, result.settings.radius),
    )
