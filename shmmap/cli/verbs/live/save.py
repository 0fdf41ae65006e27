# SPDX-License-Identifier: Apache-2.0
"""``shmmap live save``: have a live map written to the disk now."""

from __future__ import annotations

import argparse
import time

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import format_duration, print_json, print_line

__all__ = ["add_parser", "run"]

_JSON = """\
  {"map", "files": chunks on the disk, "seconds"}
Exit code: 0, 1 when this user may not, 2 when there is no such map, 69 when no daemon answers in time."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "save",
        run,
        help="write a live map to the disk now",
        description="Have all changed chunks of a live map written to the disk; ends when everything that "
        "was applied before is there.",
        json=_JSON,
    )
    parser.add_argument("name", metavar="NAME", help="the live map")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for it, and wait."""
    from shmmap.cli.daemon_address import connect

    begin_s = time.monotonic()
    with connect(args) as client:
        files = client.live(args.name).save()
    took_s = time.monotonic() - begin_s
    if args.json:
        print_json({"map": args.name, "files": files, "seconds": round(took_s, 3)})
    else:
        print_line(f"{args.name}: saved, {files:,} chunks on the disk ({format_duration(took_s)})")
    return 0
