# SPDX-License-Identifier: Apache-2.0
"""``shmmap demo``: a demonstration on a generated town, without a map or any configuration."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

from shmmap.cli.options import Subparsers, add_json_option, add_verb, number_of
from shmmap.cli.program import write_bytes, write_text
from shmmap.cli.screens.output import print_json, print_line
from shmmap.errors import CannotWrite

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
   "svg", "png": paths of the pictures, of cells and of points, "seconds"}
  DRIVE: {"consumers", "processes": with the daemon and its workers,
          "cells", "points", "map_bytes": of one consumer's window,
          "start_s": until all have their first window,
          "follow_max_s": how long a control loop waited after that at most,
          "cpu_s": user and system time of all processes,
          "daemon_start_cpu_s": of it, the daemon's before the drive,
          "process_bytes": memory of the processes without shared memory,
          "private_bytes": of it, pages that one process alone maps,
          "shm_bytes": shared memory, counted once, "total_bytes": both}
  Exit code 1 where a scan is not to be trusted."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``demo``."""
    parser = add_verb(
        subparsers,
        "demo",
        run,
        help="see it work: no map needed, about a minute",
        description="Build a town and drive through it with one process, then with eight: each with a private"
        " copy of the map, then all on one copy that shmmap shares.  Kill the daemon, and see the processes"
        " continue.  Localize simulated LiDAR scans, and compare the poses with the true ones.",
        json=_JSON,
    )
    parser.add_argument(
        "--svg",
        metavar="FILE",
        help="where the picture goes (default: ./shmmap-demo.svg)",
    )
    parser.add_argument("--keep-map", metavar="DIR", help="build the map in DIR, and leave it there")
    parser.add_argument(
        "--density",
        metavar="POINTS",
        type=number_of("2 to 1000 points per square metre", 2.0, 1000.0),
        help="points per square metre of ground, 2 to 1000; fewer are quicker (default: 100, or what fits)",
    )
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Run the demonstration and print its measurements."""
    from shmmap.cli.screens.demo import demo_document, draw_town, print_report, progress_for
    from shmmap.demo.demo import run_demo
    from shmmap.demo.demo_town import PICTURE_FROM, DemoSettings
    from shmmap.processes.interrupts import signals_interrupt

    picture = _picture_path(args.svg)
    started_s = time.monotonic()
    if not args.json:
        _note_of_compiling()
    with signals_interrupt(), progress_for(quiet=args.json) as progress:
        settings = DemoSettings() if args.density is None else DemoSettings(density=args.density)
        result = run_demo(settings, progress, map_dir=args.keep_map)
    duration_s = time.monotonic() - started_s
    write_text(picture, draw_town(result))
    points, picture_png = picture.with_suffix(".png"), result.town.picture_png
    if picture_png and points != picture:
        write_bytes(points, picture_png)
    if args.json:
        pictures = {"svg": str(picture), **({"png": str(points)} if picture_png else {})}
        print_json({**demo_document(result), **pictures, "seconds": round(duration_s, 3)})
    else:
        print_report(result, _shown(picture), duration_s)
        if args.keep_map:
            print_line(f"Serve the town yourself: shmmap serve {args.keep_map}")
        if picture_png:
            place = args.keep_map or "TOWN"
            how = "Draw" if args.keep_map else "With --keep-map TOWN, draw"
            print_line(f"The points: {_shown(points)}.  {how} them yourself:")
            print_line(f"  shmmap view {place} --from {PICTURE_FROM} --image {_shown(points)}")
    found = result.localization
    return 0 if found is None or found.trustworthy == found.scans else 1


def _note_of_compiling() -> None:
    """Say that kernels compile beside the demonstration, if they are not kept yet."""
    import importlib.util

    from shmmap.kernel_cache import are_compiled

    if importlib.util.find_spec("numba") is not None and not are_compiled():
        print_line("compiling kernels meanwhile, once for this version", flush=True)


def _picture_path(named: str | None) -> Path:
    """Return the path of the picture, checked before the work begins."""
    path = Path(named or "shmmap-demo.svg").absolute()
    if (
        path.parent.is_dir()
        and not path.is_dir()
        and os.access(path if path.exists() else path.parent, os.W_OK)
    ):
        return path
    if named:
        raise CannotWrite(f"{path} cannot be written", hint="give another --svg FILE")
    return Path(tempfile.mkdtemp(prefix="shmmap-"), path.name)  # a name in /tmp could be another's link


def _shown(path: Path) -> str:
    """Return a path as the user sees it from here."""
    near = os.path.relpath(path)
    return str(path) if near.startswith("..") else near
