# SPDX-License-Identifier: Apache-2.0
"""``shmmap live reset DIR``: begin a live map anew."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_json_option, add_verb
from shmmap.cli.screens.output import counted, format_bytes, print_json, print_line
from shmmap.cli.verbs.live.directory import add_directory, directory_from
from shmmap.errors import BadRequest

__all__ = ["add_parser", "run"]

_JSON = """\
  {"path", "moved_to": directory, or "" if they were deleted, "files", "bytes"}
Exit code: 0, 2 without --yes, 66 no live map there, 73 a file cannot be moved, 75 somebody works with it."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the action."""
    parser = add_verb(
        subparsers,
        "reset",
        run,
        help="begin a live map anew",
        description="Move all files of a live map aside, into DIR/reset.1 or the next number that is free; "
        "the daemon's next start begins a new map in DIR.  What was moved is a live map as before.",
        json=_JSON,
    )
    add_directory(parser)
    parser.add_argument("--yes", action="store_true", help="do it; without, only say what would be done")
    parser.add_argument("--delete", action="store_true", help="delete the files instead of moving them")
    add_json_option(parser)


def run(args: argparse.Namespace) -> int:
    """Move or delete the files."""
    import msgspec

    from shmmap.daemon.live.disk.maintenance import files_of_map, reset
    from shmmap.daemon.live.disk.stored_map import opened_folder
    from shmmap.formats.durable_file import writing_errors

    path = directory_from(args)
    with opened_folder(path, "stop the daemon: it would go on with the files that it knows") as folder:
        if not args.yes:
            sizes = files_of_map(folder)
            what = f"{counted(len(sizes), 'file')} ({format_bytes(sum(sizes.values()))}) of the live map"
            raise BadRequest(
                f"{what} in {path} would be {'deleted' if args.delete else 'moved aside'}",
                hint="--yes does it",
            )
        with writing_errors(path):
            done = reset(folder, delete=args.delete)
    if args.json:
        print_json(msgspec.structs.asdict(done))
    else:
        where = f"moved to {done.moved_to}" if done.moved_to else "deleted"
        print_line(f"{counted(done.files, 'file')} ({format_bytes(done.bytes)}) {where}")
    return 0
