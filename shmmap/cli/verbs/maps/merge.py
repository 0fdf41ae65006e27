# SPDX-License-Identifier: Apache-2.0
"""``shmmap merge IN... OUT``: a divided map back into one cloud."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import counted, format_bytes
from shmmap.cli.screens.work_progress import fields_text, print_result

if TYPE_CHECKING:
    from shmmap.dividing.merge import MergedCloud

__all__ = ["add_parser", "run"]

_EPILOG = """\
IN is a divided map, a directory of clouds or a cloud of any format that is read.  Points that `divide`
shifted return to where they were, in float64.  Files are merged in the order of their paths.
Exit code: 0, 2 wrong usage or OUT exists, 65 bad data or no point in the inputs, 66 no such input,
73 OUT cannot be written."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "merge",
        run,
        help="merge a divided map, or clouds, into one PCD file",
        description="Merge divided maps and clouds of any size into one PCD file: the inverse of `divide`.",
        output="maps.outputs.merged_kind",
        epilog=_EPILOG,
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


def run(args: argparse.Namespace) -> int:
    """Merge, and say what came out."""
    import time

    from shmmap.cli.screens.work_progress import StageProgress
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
    print_result(made, _lines(made), seconds=seconds, as_json=args.json)
    return 0


def _lines(made: MergedCloud) -> list[tuple[str, str]]:
    notes = [
        ("note", f"moved by ({', '.join(f'{v:.12g}' for v in origin)}) m, to the frame before {path}")
        for path, origin in made.origin.items()
    ]
    return [
        ("cloud", f"{made.path} ({format_bytes(made.bytes)})"),
        ("points", f"{made.points:,} from {counted(made.files, 'file')}"),
        ("fields", fields_text(made.fields)),
        *notes,
    ]
