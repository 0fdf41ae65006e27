# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``: a demonstration on a generated town, without a map or any configuration."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import print_json, print_line
from shmmap.errors import BadRequest, CannotWrite

if TYPE_CHECKING:
    from shmmap.cli.screens.demo import DemoReport
    from shmmap.demo.program import Progress

__all__ = ["add_parser", "run"]

_JSON = """\
  {"town": {"cells", "points", "file_bytes", "build_s"},
   "rounds": [{"consumers", "shared": DRIVE, "private": DRIVE}], with 1 and with 8 processes,
   "one_more_bytes": {"shared", "private"}: memory that each further process needs,
   "outage": {"down_s": from SIGKILL until the daemon was ready again,
              "poses": answered in this time, "counted": [points that each process read in it],
              "longest_pause_s": of a control loop, until all was as before,
              "segments": in shared memory before, "adopted": taken over},
   "localization": {"scans", "trustworthy", "error_m", "error_max_m": from the truth, mean and
                    largest, "first_pose_s": from starting the daemon, and then shmmap-ndt}
                   or null,
   "svg": path, "seconds"}
  DRIVE: {"consumers", "processes": with the daemon and its workers,
          "cells", "points", "map_bytes": of one consumer's window,
          "start_s": until all have their first window,
          "follow_max_s": how long a control loop waited after that at most,
          "cpu_s": user and system time of all processes,
          "daemon_start_cpu_s": of it, the daemon's before the drive,
          "process_bytes": memory of the processes without shared memory,
          "private_bytes": of it, pages that one process alone maps,
          "shm_bytes": shared memory, counted once, "total_bytes": both}
  With --live instead of all this: {"scans", "points", "length_m", "budget_bytes", "mapping_s",
  "mapper_killed_at": scan, "mapper_resumed_at", "daemon_killed_at", "daemon_down_s",
  "daemon_chunks": that it found in memory, "evicted", "came_back": how often a chunk left memory,
  and came into it again, "max_bytes": memory of chunks in service,
  "active", "active_bytes": known voxels in memory in the end, and their memory,
  "chunks", "file_bytes": of the map on disk, "voxels", "differing": compared with a map without
  bounds, "svg", "seconds"}
  Exit code 1 where a scan is not to be trusted or a voxel differs."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``demo``."""
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
        help="where the picture goes (default: ./shmmap-demo.svg, with --live ./shmmap-demo-live.svg)",
    )
    parser.add_argument("--keep-map", metavar="DIR", help="build the map in DIR, and leave it there")
    parser.add_argument(
        "--density",
        metavar="POINTS",
        type=_density,
        help="points per square metre of ground, 2 to 1000; fewer are quicker (default: 100, or what fits)",
    )
    parser.add_argument(
        "--live",
        action="store_true",
        help="map a drive into a live map with too little memory, and kill daemon and mapping program on the"
        " way: no voxel is lost (less than a minute)",
    )
    parser.add_argument("--full", action="store_true", help=argparse.SUPPRESS)  # options of earlier versions
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
    """Run the demonstration and print its measurements."""
    from shmmap.cli.screens.demo import print_report, progress_for
    from shmmap.processes.interrupts import signals_interrupt

    if args.full:
        raise BadRequest(
            "demo has no --full any more: benchmarks measure what it did",
            hint="in the source tree: python -m tests.benchmarks.memory, and for three programs side by side"
            " python -m tests.benchmarks.three_programs",
        )
    if args.live and (args.keep_map or args.density):
        raise BadRequest("--live drives in a town of its own", hint="leave out --keep-map and --density")
    picture = _picture_path(args.svg, "shmmap-demo-live.svg" if args.live else "shmmap-demo.svg")
    started_s = time.monotonic()
    if not args.json:
        _note_of_compiling()
    with signals_interrupt(), progress_for(quiet=args.json) as progress:
        report = (_drive_live if args.live else _drive)(args, progress)
    duration_s = time.monotonic() - started_s
    picture.write_text(report.picture_svg, encoding="utf-8")
    if args.json:
        print_json({**report.document, "svg": str(picture), "seconds": round(duration_s, 3)})
    else:
        near = os.path.relpath(picture)
        print_report(report, str(picture) if near.startswith("..") else near, duration_s)
        if args.keep_map:
            print_line(f"Serve the town yourself: shmmap serve {args.keep_map}")
    return 0 if report.passed else 1


def _note_of_compiling() -> None:
    """Say that kernels compile beside the demonstration, if they are not kept yet."""
    import importlib.util

    from shmmap.kernel_cache import are_compiled

    if importlib.util.find_spec("numba") is not None and not are_compiled():
        print_line("compiling kernels meanwhile, once for this version", flush=True)


def _drive(args: argparse.Namespace, progress: Progress) -> DemoReport:
    """Drive on one shared copy of a town's map, and on private copies."""
    from dataclasses import replace

    from shmmap.cli.screens.demo import town_report
    from shmmap.demo.demo import run_demo
    from shmmap.demo.demo_town import DemoSettings

    settings = DemoSettings()
    if args.density is not None:
        settings = replace(settings, density=args.density)
    return town_report(run_demo(settings, progress, map_dir=args.keep_map))


def _drive_live(args: argparse.Namespace, progress: Progress) -> DemoReport:
    """Drive while a live map is recorded, and check that no voxel was lost."""
    from shmmap.cli.screens.demo import live_report
    from shmmap.demo.live_drive import LiveDriveSettings, run_live_drive

    del args
    return live_report(run_live_drive(LiveDriveSettings(), progress))


def _picture_path(named: str | None, usual: str) -> Path:
    """Return the path of the picture, checked before the work begins."""
    path = Path(named or usual).absolute()
    if (
        path.parent.is_dir()
        and not path.is_dir()
        and os.access(path if path.exists() else path.parent, os.W_OK)
    ):
        return path
    if named:
        raise CannotWrite(f"{path} cannot be written", hint="give another --svg FILE")
    return Path(tempfile.mkdtemp(prefix="shmmap-"), path.name)  # a name in /tmp could be another's link
