# SPDX-License-Identifier: Apache-2.0
"""``shmmap live export DIR``: voxels of a live map to a cloud, or to a map that can be served."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.program import add_allow_empty, complain, nothing_found
from shmmap.cli.screens.output import counted, format_duration, print_json, print_pairs
from shmmap.cli.screens.work_result import fields_text
from shmmap.cli.verbs.divide import metres, translation
from shmmap.cli.verbs.live.directory import add_directory, directory_from

if TYPE_CHECKING:
    from shmmap.daemon.live.disk.exporting import ExportedVoxels, Format

__all__ = ["add_parser", "run"]

_EPILOG = """\
A point lies in the middle of its voxel, in metres; its field `intensity` is the probability that the voxel
is occupied.
A daemon may go on mapping meanwhile.  What it has not saved yet is in its memory alone, and left out: before
that, `shmmap live save` has everything saved.
OUT appears complete or not at all, and a damaged file ends the export.
JSON (fields may be added, none is removed):
  {"path", "format": "ply", "pcd" or "map", "voxels", "chunks", "cells": of a map, else 0,
   "resolution", "frame_id", "origin": [x, y, z] to add to come back to that frame,
   "fields": [[name, dtype]], "aside": [file]: damaged ones that were put aside before, "seconds"}
Exit code: 0; 1 no such voxel (then nothing is written), 2 wrong usage or OUT exists, 65 a damaged file,
66 no live map there, 73 OUT cannot be written."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the action."""
    parser = add_verb(
        subparsers,
        "export",
        run,
        help="write voxels to a cloud, or a map to serve",
        description="Write the voxels of a live map to a PLY or PCD file, or as a divided map that `shmmap "
        "serve` and Autoware read.",
        epilog=_EPILOG,
    )
    add_directory(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        required=True,
        help="a .ply or .pcd file, or the map directory to make",
    )
    parser.add_argument(
        "--voxels", choices=("occupied", "free", "both"), default="occupied", help="which (default: occupied)"
    )
    parser.add_argument(
        "--translate",
        metavar="X,Y,Z|auto|none",
        type=translation,
        default="auto",
        help="added to every point; auto (the default) shifts them to the origin if float32 would lose more "
        "than 0.5 mm where they are; none keeps their frame, in float64 where needed",
    )
    parser.add_argument(
        "--cell-size", metavar="METRES", type=metres, default=20.0, help="side of a map's cell (default: 20)"
    )
    parser.add_argument("--force", action="store_true", help="replace a file, or a divided map, that exists")
    add_allow_empty(parser)
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Export, and say what came out."""
    import time

    from shmmap.daemon.live.disk.exporting import export
    from shmmap.daemon.live.disk.stored_map import StoredMap, opened_folder_to_read

    path = directory_from(args)
    began_s = time.monotonic()
    with opened_folder_to_read(path) as files:
        made = export(
            StoredMap(files, path),
            args.output,
            _format(args.output),
            voxels=args.voxels,
            translate=args.translate,
            cell_size=args.cell_size,
            force=args.force,
        )
    if made is None:
        which = "known" if args.voxels == "both" else args.voxels
        return nothing_found(
            args,
            f"no {which} voxel in the files of {path}: nothing is written",
            "if a daemon maps there now, have it save first: `shmmap live save`",
        )
    seconds = time.monotonic() - began_s
    if args.json:
        import msgspec

        print_json({**msgspec.to_builtins(made), "seconds": seconds})
    else:
        print_pairs([*_lines(made), ("time", format_duration(seconds))])
    if made.aside:
        complain("shmmap", f"left out: {counted(len(made.aside), 'damaged file')} put aside before")
    return 0


def _format(out: str) -> Format:
    suffix = Path(out).suffix.lower()
    return "ply" if suffix == ".ply" else "pcd" if suffix == ".pcd" else "map"


def _lines(made: ExportedVoxels) -> list[tuple[str, str]]:
    lines = [
        (made.format, made.path),
        ("voxels", f"{made.voxels:,} of {counted(made.chunks, 'chunk')}, side {made.resolution:g} m"),
        ("fields", fields_text(made.fields)),
    ]
    if made.cells:
        lines.append(("cells", f"{made.cells:,}"))
    if any(made.origin):
        x, y, z = made.origin
        lines.append(("moved", f"({x:.12g}, {y:.12g}, {z:.12g}) m leads back to frame {made.frame_id}"))
    return [
        *lines,
        ("note", "as saved: not what is in a daemon's memory alone (`shmmap live save`)"),
    ]
