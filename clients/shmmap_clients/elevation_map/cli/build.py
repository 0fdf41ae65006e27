# SPDX-License-Identifier: Apache-2.0
"""``shmmap-elevation build``: the whole map, one cell at a time."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shmmap_clients.command_line import (
    add_daemon_options,
    add_json_option,
    at_least,
    connect,
    output_file,
    print_json,
    seconds,
    writing_errors,
)

if TYPE_CHECKING:
    from shmmap_clients.elevation_map.build import BuildProgress

__all__ = ["add_parser", "run"]

_ATTEMPTS = 3
_EVERY_S = 0.5


def add_parser(subparsers: Any) -> None:
    """Add the verb."""
    parser = subparsers.add_parser(
        "build",
        help="make an elevation map of the whole map",
        description="Make the elevation of the daemon's whole map, one cell at a time, and write it."
        "  What was made before is kept by the map's version and the rule, and an interrupted run goes on.",
        epilog="JSON: map_version, cells, loaded (cells that this run loaded), rows and columns of the grid,"
        " resolution, origin (its south-west corner), measured and filled columns, stray points outside"
        " their cell, failed (cells that could not be had), files.  Exit code: 0, or 1 where cells failed.",
    )
    parser.add_argument(
        "--out", action="append", default=[], type=output_file, metavar="FILE",
        help=".npz, .tif or .png; may be given again",
    )  # fmt: skip
    parser.add_argument(
        "--hillshade", type=output_file, metavar="FILE", help="a shaded picture (PNG) and its world file"
    )
    rule = parser.add_argument_group("heights")
    rule.add_argument(
        "--rule", choices=("surface", "min", "mean", "max"), default="surface",
        help="lowest surface as Autoware makes it from points (default); the others from elevation layers",
    )  # fmt: skip
    rule.add_argument("--resolution", type=float, default=0.3, metavar="M", help="default 0.3")
    rule.add_argument("--tolerance", type=float, default=0.2, metavar="M", help="within a cluster (0.2)")
    rule.add_argument("--height-range", type=float, default=1.0, metavar="M", help="above the lowest (1.0)")
    rule.add_argument("--min-points", type=int, default=3, metavar="N", help="of a cluster (3)")
    rule.add_argument(
        "--fill-radius", type=float, default=1.0, metavar="M", help="fill holes this near to heights (1.0)"
    )
    parser.add_argument("--epsg", type=at_least(1), metavar="CODE", help="coordinate system of a GeoTIFF")
    parser.add_argument("--cache", metavar="DIR", help="default: $XDG_CACHE_HOME/shmmap/elevation")
    parser.add_argument("--wait", type=seconds, default=60.0, metavar="SECONDS", help="for one cell (60)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_json_option(parser)
    add_daemon_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Build and write."""
    import numpy as np

    from shmmap import BadRequest
    from shmmap_clients.elevation_map.build import MapChanged, build_elevation_map
    from shmmap_clients.elevation_map.grid import FILLED, MEASURED
    from shmmap_clients.elevation_map.holes import fill_reach
    from shmmap_clients.elevation_map.output import check_output, write_elevation, write_hillshade
    from shmmap_clients.elevation_map.rule import ElevationRule

    rule = ElevationRule(args.rule, args.resolution, args.tolerance, args.height_range, args.min_points)
    files: list[Path] = args.out
    for path in files:
        check_output(path, args.epsg)
    if args.hillshade and Path(args.hillshade).suffix.lower() != ".png":
        raise BadRequest(f"{args.hillshade}: a hillshade is written as .png")
    fill_reach(args.fill_radius / rule.resolution)
    with _ProgressLine(quiet=args.quiet) as progress:
        with connect(args, "shmmap-elevation") as client:
            for attempt in range(_ATTEMPTS):
                try:
                    with writing_errors("the cache of elevation maps"):
                        built = build_elevation_map(
                            client, rule, _cache(args.cache), wait_s=args.wait, progress=progress
                        )
                    break
                except MapChanged:
                    if attempt == _ATTEMPTS - 1:
                        raise
        grid = built.grid
        document = {
            "map_version": f"{built.map_version:016x}",
            "rule": rule.document,
            "fill_radius": args.fill_radius,
        }
        for path in files:
            progress.say(f"writing {path}")
            with writing_errors(str(path)):
                write_elevation(path, grid, args.fill_radius, document, epsg=args.epsg)
        if args.hillshade:
            progress.say(f"writing {args.hillshade}")
            with writing_errors(str(args.hillshade)):
                write_hillshade(args.hillshade, grid, args.fill_radius)
        counts = np.zeros(3, np.int64)
        for _, _, kind in grid.blocks(args.fill_radius):
            counts += np.bincount(kind.ravel(), minlength=3)
    written = [*files, *([args.hillshade] if args.hillshade else [])]
    summary = {
        "map_version": document["map_version"],
        "cells": built.cells,
        "loaded": built.loaded,
        "rows": grid.shape[0],
        "columns": grid.shape[1],
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "measured": int(counts[MEASURED]),
        "filled": int(counts[FILLED]),
        "stray": built.stray,
        "failed": [
            {"id": error.cell_id, "code": error.code, "message": str(error)} for error in built.failed
        ],
        "files": [str(path) for path in written],
    }
    if args.json:
        print_json(summary)
    else:
        print(
            f"{built.cells} cells, {built.loaded} loaded: {grid.shape[1]} x {grid.shape[0]} columns of"
            f" {grid.resolution:g} m, {counts[MEASURED]} measured, {counts[FILLED]} filled"
        )
        print(f"wrote {', '.join(map(str, written))}" if written else "wrote nothing: name files with --out")
        for error in built.failed:
            print(f"missing: {error}", file=sys.stderr)
    return 1 if built.failed else 0


def _cache(named: str | None) -> Path:
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".cache") / "shmmap" / "elevation"


class _ProgressLine:
    """One line that is written over on a terminal, and a line now and then elsewhere."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._terminal = sys.stderr.isatty()
        self._next_s = 0.0
        self._shown = ""

    def __enter__(self) -> _ProgressLine:
        return self

    def __exit__(self, *_: object) -> None:
        if self._terminal and self._shown:
            print(file=sys.stderr)

    def __call__(self, progress: BuildProgress) -> None:
        now_s = time.monotonic()
        if now_s >= self._next_s or progress.done == progress.cells:
            self._next_s = now_s + (_EVERY_S if self._terminal else 10 * _EVERY_S)
            self.say(f"{progress.done} of {progress.cells} cells, {progress.rows} rows")

    def say(self, text: str) -> None:
        """Show what is being done."""
        if self._quiet:
            return
        if self._terminal:
            print("\r" + text.ljust(len(self._shown)), end="", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)
        self._shown = text
