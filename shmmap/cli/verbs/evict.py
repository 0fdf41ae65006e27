# SPDX-License-Identifier: Apache-2.0
"""``shmmap evict``: retire cells from shared memory."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.areas import add_cells_argument, cells_meant, check_cells_argument, no_cell_there
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import print_json, print_line

if TYPE_CHECKING:
    from shmmap.protocol.messages import Evicted

__all__ = ["add_parser", "run"]

_JSON = """\
  {"freed": segments whose memory is free, "pinned": segments retired, but still mapped by a client,
   "kept": segments left alone because they are pinned (`shmmap pin`),
   "unknown": [ids the map does not have]}
Exit code: 0; 1 when an id is unknown or an area touches no cell."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "evict",
        run,
        help="free cells from memory",
        description="Retire cells from shared memory: no client gets them any more, and their "
        "memory is freed "
        "as soon as no process maps it.  The next request loads them again.",
        json=_JSON,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Evict, and print what became free."""
    from shmmap.cli.daemon_address import connect
    from shmmap.protocol.messages import Evicted

    area = check_cells_argument(args, "evict")
    with connect(args) as client:
        cells = None if args.all else cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                print_json(_as_json(Evicted(0, 0, 0)))
            return no_cell_there(args, client, area)
        answer = client.evict(cells)
    if args.json:
        print_json(_as_json(answer))
    else:
        in_use = f", {answer.pinned:,} retired but still in use by clients" if answer.pinned else ""
        print_line(f"{answer.freed:,} segments freed{in_use}")
        if answer.kept:
            print_line(f"{answer.kept:,} left alone: pinned by an operator (see `shmmap unpin`)")
        for name in answer.unknown:
            print_line(f"unknown cell: {name}")
    return 1 if answer.unknown else 0


def _as_json(answer: Evicted) -> dict[str, object]:
    return {
        "freed": answer.freed,
        "pinned": answer.pinned,
        "kept": answer.kept,
        "unknown": list(answer.unknown),
    }
