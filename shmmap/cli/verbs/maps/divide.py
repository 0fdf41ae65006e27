# SPDX-License-Identifier: Apache-2.0
"""``shmmap divide`` and ``shmmap merge``: clouds of any size to a divided map, and back to one cloud."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from shmmap.cli.options import (
    Subparsers,
    add_cloud_options,
    add_json_option,
    add_verb,
    metres,
    numbers,
    size_bytes,
)
from shmmap.cli.program import hint_if_interrupted
from shmmap.cli.screens.output import counted, format_bytes
from shmmap.cli.screens.work_progress import StageProgress, fields_text, print_result

if TYPE_CHECKING:
    from shmmap.dividing.frame import Translation
    from shmmap.dividing.merge import MergedCloud
    from shmmap.origin.map_report import DividedMap

_DIVIDE_EPILOG = """\
IN is a file (.pcd in every encoding, .las .laz .copc.laz, .ply .pts .xyz .xyzn .xyzrgb, or a table of
numbers: .txt .csv .asc) or a directory of files, tables left out; all together become one map.  Files may
be larger than memory.
A cell has the points with x0 <= x < x0 + size and y0 <= y < y0 + size; points that are not finite, and
those that a LAS file flags withheld, are left out and counted.  All fields are kept, with their types,
unless --fields names those to keep.
OUT appears complete or not at all.  Autoware's map loader reads it.
Exit code: 0, 2 wrong usage or OUT exists, 65 bad data or no finite point, 66 no such input,
73 OUT cannot be written, 75 another run is making OUT."""


def add_divide(subparsers: Subparsers) -> None:
    """Add the verb ``divide``."""
    parser = add_verb(
        subparsers,
        "divide",
        run_divide,
        help="divide clouds into a map of square cells",
        description="Divide clouds of any size into a map of square cells that `serve` and Autoware read.",
        output="maps.outputs.divided_kind",
        epilog=_DIVIDE_EPILOG,
    )
    parser.add_argument("inputs", metavar="IN", nargs="+", help="clouds, or directories of clouds")
    parser.add_argument("out", metavar="OUT", help="the map directory to make")
    cells = parser.add_argument_group("cells")
    cells.add_argument(
        "--cell-size", metavar="METRES", type=metres, default=20.0, help="side of a cell (default: 20)"
    )
    cells.add_argument(
        "--origin",
        metavar="X,Y",
        type=lambda text: numbers(text, "X,Y"),
        default=[0.0, 0.0],
        help="a corner of the lattice of cells, in the frame of the inputs (default: 0,0)",
    )
    cells.add_argument("--prefix", default="", help="start of the file names, before _<x>_<y>.pcd")
    points = parser.add_argument_group("points")
    points.add_argument(
        "--translate",
        metavar="X,Y,Z|auto|none",
        type=translation,
        default="auto",
        help="added to every point; auto (the default) shifts float64 and LAS clouds to the origin if "
        "float32 would lose more than 0.5 mm where they are, as `serve` does with a cloud; none keeps their "
        "frame, in float64 where needed",
    )
    add_cloud_options(points)
    points.add_argument(
        "--leaf",
        metavar="METRES",
        type=metres,
        default=0.0,
        help="thin out: one point, the mean, for each voxel of this side",
    )
    points.add_argument(
        "--encoding",
        choices=("binary", "binary_compressed", "ascii"),
        default="binary",
        help="encoding of the PCD files (default: binary)",
    )
    points.add_argument(
        "--fields",
        metavar="NAME,...",
        type=lambda text: [name.strip() for name in text.split(",")],
        action="extend",
        default=[],
        help="keep only these fields, such as x,y,z,intensity (default: all)",
    )
    points.add_argument(
        "--common-fields", action="store_true", help="keep only the fields that all inputs have"
    )
    work = parser.add_argument_group("work")
    work.add_argument(
        "--max-memory",
        metavar="BYTES",
        type=size_bytes,
        default="1G",
        help="most memory the process may take (default: 1G)",
    )
    work.add_argument("--force", action="store_true", help="replace a divided map that exists")
    work.add_argument(
        "--resume", action="store_true", help="continue where a killed run of the same command stopped"
    )
    work.add_argument(
        "--check", action="store_true", help="read the map back and verify it before it appears"
    )
    work.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_json_option(parser)


def run_divide(args: argparse.Namespace) -> int:
    """Divide clouds, and print the result."""
    from shmmap.dividing.divide import divide
    from shmmap.dividing.settings import DivideSettings

    origin_x, origin_y = args.origin
    settings = DivideSettings(
        cell_size=args.cell_size,
        origin=(origin_x, origin_y),
        translate=args.translate,
        unit=args.unit or "",
        vertical_unit=args.vertical_unit or "",
        drop_noise=args.drop_noise,
        leaf=args.leaf,
        prefix=args.prefix,
        encoding=args.encoding,
        memory_bytes=args.max_memory,
        common_fields=args.common_fields,
        fields=tuple(dict.fromkeys(args.fields)),
        force=args.force,
        resume=args.resume,
        check=args.check,
    )
    began_s = time.monotonic()
    with hint_if_interrupted("the same command with --resume continues"):
        made = divide(args.inputs, args.out, settings, progress=StageProgress(quiet=args.quiet))
    seconds = time.monotonic() - began_s
    print_result(made, _divided_lines(made, checked=args.check), seconds=seconds, as_json=args.json)
    return 0


def translation(text: str) -> Translation:
    """Parse the translation to add to points."""
    if text == "auto":
        return "auto"
    if text == "none":
        return "none"
    x, y, z = numbers(text, "X,Y,Z")
    return x, y, z


def _divided_lines(made: DividedMap, *, checked: bool) -> list[tuple[str, str]]:
    left_out = f", {made.dropped:,} left out" if made.dropped else ""
    lines = [
        ("map", made.path),
        ("cells", f"{made.cells:,}, side {made.cell_size:g} m"),
        ("points", f"{made.points:,} of {made.points_read:,} read{left_out}"),
        ("fields", fields_text(made.fields)),
    ]
    if checked:
        lines.append(("check", f"passed: {made.points:,} points read back, each in its cell"))
    if made.crs:
        lines.append(("crs", made.crs))
    if made.resumed_points:
        lines.append(("resumed", f"after {made.resumed_points:,} points"))
    return [*lines, *(("note", note) for note in made.notes)]


_MERGE_EPILOG = """\
IN is a divided map, a directory of clouds or a cloud of any format that is read.  Points that `divide`
shifted return to where they were, in float64.  Files are merged in the order of their paths.
Exit code: 0, 2 wrong usage or OUT exists, 65 bad data or no point in the inputs, 66 no such input,
73 OUT cannot be written."""


def add_merge(subparsers: Subparsers) -> None:
    """Add the verb ``merge``."""
    parser = add_verb(
        subparsers,
        "merge",
        run_merge,
        help="merge a divided map, or clouds, into one PCD file",
        description="Merge divided maps and clouds of any size into one PCD file: the inverse of `divide`.",
        output="maps.outputs.merged_kind",
        epilog=_MERGE_EPILOG,
    )
    parser.add_argument("inputs", metavar="IN", nargs="+", help="divided maps, directories, clouds")
    parser.add_argument("out", metavar="OUT", help="the PCD file to make")
    parser.add_argument(
        "--encoding",
        choices=("binary", "ascii"),
        default="binary",
        help="encoding of the PCD file (default: binary)",
    )
    parser.add_argument(
        "--keep-frame",
        action="store_true",
        help="keep points where the map has them, also if `divide` shifted them",
    )
    parser.add_argument(
        "--common-fields", action="store_true", help="keep only the fields that all inputs have"
    )
    parser.add_argument("--force", action="store_true", help="replace a file that exists")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    add_json_option(parser)


def run_merge(args: argparse.Namespace) -> int:
    """Merge a map into one cloud, and print the result."""
    from shmmap.dividing.merge import merge

    began_s = time.monotonic()
    made = merge(
        args.inputs,
        args.out,
        encoding=args.encoding,
        keep_frame=args.keep_frame,
        common_fields=args.common_fields,
        force=args.force,
        progress=StageProgress(quiet=args.quiet),
    )
    seconds = time.monotonic() - began_s
    print_result(made, _merged_lines(made), seconds=seconds, as_json=args.json)
    return 0


def _merged_lines(made: MergedCloud) -> list[tuple[str, str]]:
    notes = [
        ("note", f"moved by ({', '.join(f'{v:.12g}' for v in origin)}) m, to the frame before {path}")
        for path, origin in made.origin.items()
    ]
    notes += [("note", note) for note in made.notes]
    return [
        ("cloud", f"{made.path} ({format_bytes(made.bytes)})"),
        ("points", f"{made.points:,} from {counted(made.files, 'file')}"),
        ("fields", fields_text(made.fields)),
        *notes,
    ]
