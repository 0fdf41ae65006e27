# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``: the whole thing on a generated town, without a map or any configuration."""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import print_json, print_line
from shmmap.errors import BadRequest, CannotWrite

if TYPE_CHECKING:
    from shmmap.demo.demo import DemoResult
    from shmmap.demo.drive import DriveResult

__all__ = ["add_parser", "run"]

_JSON = """\
  {"town": {"cells", "points", "file_bytes", "build_s"},
   "shared": DRIVE, "private": DRIVE: those of 8 processes,
   "rounds": [{"consumers", "shared": DRIVE, "private": DRIVE}],
   "one_more_bytes": {"shared", "private"}: what one process more costs in memory,
   "outage": {"consumers", "down_s": from SIGKILL until the daemon was ready again,
              "poses": answered in this time, "counted": [points that each process read in it],
              "follow_max_s", "longest_pause_s": of a control loop, until all was as before,
              "pace_s": between poses, "current_s": from ready until all had all their cells,
              "segments": in shared memory before, "adopted": taken over},
   "localization": {"scans", "trustworthy", "error_m", "error_max_m": from the truth, mean and
                    largest, "scan_s": per scan, median, "first_pose_s": from starting the daemon,
                    and then shmmap-ndt, "layers", "layers_cpu_s": that the daemon computed for it,
                    and its CPU time, "ndt": what shmmap-ndt says} or null,
   "wire": {"requests", "request_bytes", "reply_bytes", "handles"}, "svg": path, "seconds"}
  DRIVE: {"consumers", "processes": with the daemon and its workers,
          "cells", "points", "map_bytes": of one consumer's window,
          "start_s": until all have their first window,
          "updates": how often a consumer got new cells after that; these are about updates only:
          "follow_s", "follow_max_s": how long its control loop waited, median and longest,
          "complete_s": until the new cells were there, median,
          "warm_updates", "warm_complete_s": those with all cells in memory already (null: none),
          "handed_bytes": columns that all consumers got,
          "cpu_s": user and system time of all processes,
          "process_bytes": memory of the processes without shared memory,
          "shm_bytes": shared memory, counted once, "total_bytes": both,
          "pss_bytes", "private_bytes": as the kernel counts them}
  With --full also: {"scans", "shm_bytes", "programs": {"ndt", "compare", "elevation": what each
  printed}, "memory": {...: {"own_bytes", "growth_bytes": more in the last third of the drive than
  in the middle one, "shared_bytes": of the map, mapped}}, "errors": {"ndt": {"mean_m", "max_m"},
  "compare": {"moving_kept", "still_kept": shares of points}, "elevation": {"mean_m", "max_m",
  "places"}}}; exit code 1 where a scan was lost or not trusted
  With --live instead of all this: {"scans", "points", "length_m", "mapping_s",
  "chunks", "file_bytes": of the map on disk, "budget_bytes", "most_bytes": memory of chunks in service,
  "given_up", "came_back": how often a chunk left memory, and came into it again,
  "active", "active_bytes": known voxels in memory in the end, and their memory,
  "daemon": {"killed_at": scan, "down_s", "chunks": that it found in memory},
  "mapper": {"killed_at", "resumed_at"}, "voxels", "differing": compared with a map without
  bounds, "svg", "seconds"}; exit code 1 where a voxel differs"""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "demo",
        run,
        help="see it work: no map needed, about a minute",
        description="Build a town and drive through it with one process, then with eight: each with a private"
        " copy of the map, then all on one copy that shmmap shares.  Kill the daemon, and see the processes"
        " continue.  Localize simulated LiDAR scans, and compare the poses with the true ones.  With"
        " --live: map a drive.",
        json=_JSON,
    )
    parser.add_argument(
        "--svg",
        metavar="FILE",
        help="where the picture goes (default: ./shmmap-demo.svg, with --full or --live"
        " ./shmmap-demo-full.svg or ./shmmap-demo-live.svg)",
    )
    parser.add_argument("--keep-map", metavar="DIR", help="build the map in DIR, and leave it there")
    parser.add_argument(
        "--density",
        metavar="POINTS",
        type=_density,
        help="points per square metre of ground, 2 to 1000; fewer are quicker (default: 100, or what fits)",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--live",
        action="store_true",
        help="map a drive into a live map with too little memory, and kill daemon and mapping program on the"
        " way: no voxel is lost (less than a minute)",
    )
    instead.add_argument(
        "--full",
        action="store_true",
        help="1, 2, 4, 8 and 16 processes, and three programs beside one another: localization, compare"
        " filter and elevation map, with their errors (a few minutes)",
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
    if args.live:
        return _run_live(args)
    import time
    from dataclasses import replace

    from shmmap.cli.screens.demo_progress import progress_for
    from shmmap.cli.screens.demo_report import draw, print_report
    from shmmap.demo.demo import FULL_COUNTS, run_demo
    from shmmap.demo.demo_town import DemoSettings
    from shmmap.processes.interrupts import signals_interrupt

    picture = _picture_path(args.svg, "shmmap-demo-full.svg" if args.full else "shmmap-demo.svg")
    started_s = time.monotonic()
    with signals_interrupt(), progress_for(quiet=args.json) as progress:
        settings = DemoSettings()
        if args.density is not None:
            settings = replace(settings, density=args.density)
        if args.full:
            settings = replace(settings, counts=FULL_COUNTS)
        result = run_demo(settings, progress, map_dir=args.keep_map, full=args.full)
    duration_s = time.monotonic() - started_s
    picture.write_text(result.programs.picture_svg if result.programs else draw(result), encoding="utf-8")
    if args.json:
        print_json(_as_json(result, str(picture), duration_s))
    else:
        print_report(result, _near(picture), duration_s)
        if args.keep_map:
            print_line(f"Serve the town yourself: shmmap serve {args.keep_map}")
    return 0 if _complete(result) else 1


def _run_live(args: argparse.Namespace) -> int:
    """Map a drive, and say whether a voxel was lost."""
    import time

    from shmmap.cli.screens.demo_progress import progress_for
    from shmmap.cli.screens.live_demo_report import live_demo_json, print_live_report
    from shmmap.demo.live_drive import LiveDriveSettings, run_live_drive
    from shmmap.processes.interrupts import signals_interrupt

    if args.keep_map or args.density:
        raise BadRequest("--live drives in a town of its own", hint="leave out --keep-map and --density")
    picture = _picture_path(args.svg, "shmmap-demo-live.svg")
    started_s = time.monotonic()
    with signals_interrupt(), progress_for(quiet=args.json) as progress:
        result = run_live_drive(LiveDriveSettings(), progress)
    duration_s = time.monotonic() - started_s
    picture.write_text(result.picture_svg, encoding="utf-8")
    if args.json:
        print_json(live_demo_json(result, str(picture), duration_s))
    else:
        print_live_report(result, _near(picture), duration_s)
    return 1 if result.differing else 0


def _near(picture: Path) -> str:
    """Its path, as short as it can be told from here."""
    near = os.path.relpath(picture)
    return str(picture) if near.startswith("..") else near


def _complete(result: DemoResult) -> bool:
    """Whether no scan was lost, and all could be trusted."""
    if result.programs is not None:
        document = result.programs.document
        ndt, compare = document["programs"]["ndt"], document["programs"]["compare"]
        good = ndt["trustworthy"] == compare["scans"] == document["scans"]
        return bool(good and not compare["incomplete_scans"])
    found = result.localization
    return found is None or found.trustworthy == found.scans


def _picture_path(named: str | None, usual: str) -> Path:
    """Find out before the work begins where the picture can be written."""
    path = Path(named or usual).absolute()
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
    out, found = result.outage, result.localization
    more_shared, more_private = result.one_more_bytes
    localization: dict[str, Any] | None = None
    if found is not None:
        localization = {
            "scans": found.scans,
            "trustworthy": found.trustworthy,
            "error_m": found.error_m,
            "error_max_m": found.error_max_m,
            "scan_s": round(found.scan_s, 6),
            "first_pose_s": round(found.first_pose_s, 3),
            "layers": found.layers,
            "layers_cpu_s": round(found.layers_cpu_s, 3),
            "ndt": found.document,
        }
    return {
        "town": {
            "cells": result.town.cells,
            "points": result.town.points,
            "file_bytes": result.town.file_bytes,
            "build_s": round(result.town.build_s, 3),
        },
        "shared": _drive_as_json(result.many.shared),
        "private": _drive_as_json(result.many.private),
        "rounds": [
            {
                "consumers": count,
                "shared": _drive_as_json(each.shared),
                "private": _drive_as_json(each.private),
            }
            for count, each in result.rounds.items()
        ],
        "one_more_bytes": {"shared": round(more_shared), "private": round(more_private)},
        "outage": {
            "consumers": out.consumers,
            "down_s": round(out.down_s, 6),
            "poses": out.poses,
            "counted": list(out.counted),
            "follow_max_s": round(out.follow_max_s, 6),
            "longest_pause_s": round(out.longest_pause_s, 6),
            "pace_s": out.pace_s,
            "current_s": round(out.current_s, 6),
            "segments": out.segments,
            "adopted": out.adopted,
        },
        "localization": localization,
        "wire": {
            "requests": result.traffic.requests,
            "request_bytes": result.traffic.request_bytes,
            "reply_bytes": result.traffic.reply_bytes,
            "handles": result.traffic.handles,
        },
        **(result.programs.document if result.programs is not None else {}),
        "svg": picture,
        "seconds": round(duration_s, 3),
    }


def _drive_as_json(drive: DriveResult) -> dict[str, object]:
    return {
        "consumers": drive.consumers,
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
        "cpu_s": round(drive.cpu_s, 3),
        "process_bytes": drive.memory.own_bytes,
        "shm_bytes": drive.shm_bytes,
        "total_bytes": drive.total_bytes,
        "pss_bytes": drive.memory.pss_bytes,
        "private_bytes": drive.memory.private_bytes,
    }


def _seconds(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)
