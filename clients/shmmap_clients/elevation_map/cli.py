# SPDX-License-Identifier: Apache-2.0
"""The program ``shmmap-elevation``: ``build`` the elevation of the whole map, one cell at a time."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shmmap_clients.command_line import (
    ProgressLine,
    add_allow_empty,
    add_daemon_options,
    add_json_option,
    add_verb,
    at_least,
    complain,
    connect,
    not_negative,
    nothing_found,
    output_file,
    positive,
    print_json,
    print_line,
    run_program,
    seconds,
    writing_errors,
)
from shmmap_clients.shared_options import add_quiet_option

if TYPE_CHECKING:
    from shmmap import Client
    from shmmap_clients.elevation_map.build import BuildProgress, BuiltElevation
    from shmmap_clients.elevation_map.heights import ElevationRule

_ATTEMPTS = 3
_EVERY_S = 0.5
_NAMED: Final = 5  # number of omitted cells that are named
_NAME: Final = "shmmap-elevation"
_FEW: Final = 0.5
"""Share of the columns with points that should have a height; a map of sparse points has fewer."""
_JSON: Final = """\
JSON (fields may be added, none is removed):
  {"map_version": hex, "cells", "loaded": cells that this run loaded,
   "rows", "columns": of the grid, "resolution", "origin": south-west corner,
   "occupied": columns with a point, "measured": columns with a height from
   points,
   "measured_share": of the occupied ones, or null, "filled": columns whose
   height was filled in from others near,
   "stray": points outside their cell,
   "far": [{"id", "metres"}] cells left out, far from all others, "failed": [{"id", "code", "message"}],
   "files": [path]}
Exit code: 0; 1 when cells could not be loaded, or no column has a height."""


def _add_build(subparsers: Any) -> None:
    """Add ``build``."""
    parser = add_verb(
        subparsers,
        "build",
        _build,
        help="make an elevation map of the whole map",
        description="Make an elevation map of the daemon's whole map, one cell at a time, and write it.  What"
        " was made before is cached for each version of the map, and an interrupted run continues.",
        epilog=_JSON,
    )
    parser.add_argument(
        "--out",
        action="extend",
        nargs="+",
        default=[],
        type=output_file,
        metavar="FILE",
        help="write .npz, .tif (GeoTIFF) or .png files",
    )
    parser.add_argument(
        "--hillshade", type=output_file, metavar="FILE", help="write a shaded relief (PNG) and its world file"
    )
    _add_height_options(parser)
    parser.add_argument(
        "--epsg", type=at_least(1), metavar="CODE", help="coordinate system to name in a GeoTIFF"
    )
    parser.add_argument(
        "--cache", metavar="DIR", help="where heights are kept (default: $XDG_CACHE_HOME/shmmap/elevation)"
    )
    parser.add_argument(
        "--wait",
        type=seconds,
        default=60.0,
        metavar="SECONDS",
        help="how long to wait for one cell (default: 60)",
    )
    add_quiet_option(parser)
    add_allow_empty(parser)
    add_json_option(parser)
    add_daemon_options(parser, json=False)


def _add_height_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that define the height of a column."""
    rule = parser.add_argument_group("heights")
    rule.add_argument(
        "--rule",
        choices=("surface", "min", "mean", "max"),
        default="surface",
        help="height of a column: surface: its lowest cluster of points, as in Autoware; min, mean, max: of"
        " all its points (default: surface)",
    )
    rule.add_argument(
        "--resolution", type=positive, default=0.3, metavar="M", help="edge of a column (default: 0.3)"
    )
    rule.add_argument(
        "--tolerance",
        type=positive,
        default=0.2,
        metavar="M",
        help="surface: how near points of one cluster are to each other (default: 0.2)",
    )
    rule.add_argument(
        "--height-range",
        type=positive,
        default=1.0,
        metavar="M",
        help="surface: how far above the lowest cluster the chosen one may be (default: 1)",
    )
    rule.add_argument(
        "--min-points",
        type=at_least(1),
        default=3,
        metavar="N",
        help="surface: points that a cluster needs (default: 3)",
    )
    rule.add_argument(
        "--fill-radius",
        type=not_negative,
        default=1.0,
        metavar="M",
        help="fill in the height of columns without one, at most this far from columns with one (default: 1)",
    )


def _build(args: argparse.Namespace) -> int:
    """Build the elevation map, and write it."""
    import numpy as np

    from shmmap import BadRequest
    from shmmap_clients.elevation_map.grid import FILLED, MEASURED
    from shmmap_clients.elevation_map.heights import ElevationRule
    from shmmap_clients.elevation_map.holes import fill_reach
    from shmmap_clients.elevation_map.output import check_output, write_elevation, write_hillshade
    from shmmap_clients.map_extent import map_extent

    rule = ElevationRule(args.rule, args.resolution, args.tolerance, args.height_range, args.min_points)
    files: list[Path] = args.out
    for path in files:
        check_output(path, args.epsg)
    if args.hillshade and Path(args.hillshade).suffix.lower() != ".png":
        raise BadRequest(f"{args.hillshade}: a hillshade is written as .png")
    fill_reach(args.fill_radius / rule.resolution)
    with ProgressLine(quiet=args.quiet, written_over=sys.stderr.isatty()) as line:
        with connect(args, _NAME) as client:
            built = _built(
                args, client, rule, _Progress(line, "points" if args.rule == "surface" else "columns")
            )
            extent = map_extent(client)
        grid = built.grid
        document = {
            "map_version": f"{built.map_version:016x}",
            "rule": rule.document,
            "fill_radius": args.fill_radius,
        }
        for path in files:
            line.show(f"writing {path}")
            with writing_errors(str(path)):
                write_elevation(path, grid, args.fill_radius, document, epsg=args.epsg)
        if args.hillshade:
            line.show(f"writing {args.hillshade}")
            with writing_errors(str(args.hillshade)):
                write_hillshade(args.hillshade, grid, args.fill_radius)
        counts = np.zeros(3, np.int64)
        for _, _, kind in grid.blocks(args.fill_radius):
            counts += np.bincount(kind.ravel(), minlength=3)
    measured = int(counts[MEASURED])
    written = [*files, *([args.hillshade] if args.hillshade else [])]
    _report(args, built, measured, int(counts[FILLED]), [str(path) for path in written])
    code = 1 if built.failed else 0
    if not measured:
        why = "no cell has a point" if not built.occupied else _sparse(rule, measured, built.occupied)
        return max(code, nothing_found(args, f"no column has a height: {why}; {extent}", name=_NAME))
    if measured < _FEW * built.occupied:
        complain(_NAME, f"warning: {_sparse(rule, measured, built.occupied)}")
    return code


def _built(
    args: argparse.Namespace, client: Client, rule: ElevationRule, progress: Callable[[BuildProgress], None]
) -> BuiltElevation:
    """Return the elevation of the whole map; build again if the map changes meanwhile."""
    from shmmap_clients.elevation_map.build import MapChanged, build_elevation_map

    def build() -> BuiltElevation:
        with writing_errors("the cache of elevation maps"):
            return build_elevation_map(client, rule, _cache(args.cache), wait_s=args.wait, progress=progress)

    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(MapChanged):
            return build()
    return build()


def _report(
    args: argparse.Namespace, built: BuiltElevation, measured: int, filled: int, written: list[str]
) -> None:
    """Print the summary, and report missing data on stderr."""
    grid = built.grid
    if args.json:
        summary = {
            "map_version": f"{built.map_version:016x}",
            "cells": built.cells,
            "loaded": built.loaded,
            "rows": grid.shape[0],
            "columns": grid.shape[1],
            "resolution": grid.resolution,
            "origin": list(grid.origin),
            "occupied": built.occupied,
            "measured": measured,
            "measured_share": measured / built.occupied if built.occupied else None,
            "filled": filled,
            "stray": built.stray,
            "failed": [
                {"id": error.cell_id, "code": error.code, "message": str(error)} for error in built.failed
            ],
            "far": [{"id": cell, "metres": metres} for cell, metres in built.far],
            "files": written,
        }
        print_json(summary)
    else:
        print(
            f"{built.cells} cells, {built.loaded} loaded: {grid.shape[1]} x {grid.shape[0]} columns of"
            f" {grid.resolution:g} m, {built.occupied} with points, {measured} with a height,"
            f" {filled} more with heights filled in"
        )
        print_line(f"wrote {', '.join(written)}" if written else "wrote nothing: name files with --out")
        for error in built.failed:
            print_line(f"missing: {error}", file=sys.stderr)
    for cell, metres in built.far[:_NAMED]:
        complain(
            _NAME,
            f"warning: {cell} lies {metres / 1000:.1f} km from all other cells and holds next to nothing:"
            " left out",
        )
    if len(built.far) > _NAMED:
        complain(_NAME, f"warning: {len(built.far) - _NAMED} more cells lie far from all others: left out")


def _sparse(rule: ElevationRule, measured: int, occupied: int) -> str:
    """Return a message that few columns have a height, with reason and remedy."""
    return (
        f"{measured} of {occupied} columns with points ({100 * measured / occupied:.1f} %) have a height;"
        f" a column of {rule.resolution:g} m needs {rule.min_points} points within {rule.tolerance:g} m of"
        " each other: try a larger --resolution, a larger --tolerance or --min-points 1"
    )


def _cache(named: str | None) -> Path:
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base.startswith("/") else Path.home() / ".cache") / "shmmap" / "elevation"


class _Progress:
    """Progress display of a build, at intervals, since cells are faster than a reader."""

    def __init__(self, line: ProgressLine, rows: str) -> None:
        self._line = line
        self._rows = rows
        self._next_s = 0.0

    def __call__(self, progress: BuildProgress) -> None:
        now_s = time.monotonic()
        if now_s >= self._next_s or progress.done == progress.cells:
            self._next_s = now_s + (_EVERY_S if self._line.written_over else 10 * _EVERY_S)
            self._line.show(f"{progress.done} of {progress.cells} cells, {progress.rows} {self._rows}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    return run_program(_NAME, "Make the elevation map of a point-cloud map of any size.", (_add_build,), argv)
