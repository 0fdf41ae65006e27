# SPDX-License-Identifier: Apache-2.0
"""``shmmap evict``: retire cells from shared memory."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_cells_argument, add_daemon_options, add_verb, cells_or_all
from shmmap.cli.screens.output import print_json

__all__ = ["add_parser", "run"]

_JSON = """\
  {"freed": segments whose memory is free, "pinned": segments retired, but still mapped by somebody,
   "kept": segments left alone because they are pinned (`shmmap pin`),
   "unknown": [ids the map does not have]}
Exit code: 0, or 1 when an id is unknown."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "evict",
        run,
        help="free cells from memory",
        description="Retire cells from shared memory.  Those a process maps are freed when it lets go.",
        json=_JSON,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every cell")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print what became free."""
    from shmmap.cli.daemon_address import connect

    cells = cells_or_all(args, "evict")
    with connect(args) as client:
        answer = client.evict(cells)
    if args.json:
        print_json(
            {
                "freed": answer.freed,
                "pinned": answer.pinned,
                "kept": answer.kept,
                "unknown": list(answer.unknown),
            }
        )
    else:
        print(f"{answer.freed:,} segments freed, {answer.pinned:,} retired but still mapped")
        if answer.kept:
            print(f"{answer.kept:,} left alone: pinned by an operator (shmmap unpin)")
        for name in answer.unknown:
            print(f"unknown cell: {name}")
    return 1 if answer.unknown else 0
