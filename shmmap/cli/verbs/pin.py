# SPDX-License-Identifier: Apache-2.0
"""``shmmap pin [CELL...]``: keep cells resident, or list those that are kept."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_cells_argument, add_daemon_options, add_verb
from shmmap.cli.screens.output import Column, format_bytes, print_json, print_table

if TYPE_CHECKING:
    from shmmap.protocol.messages import Pinned

__all__ = ["PINS_JSON", "add_parser", "print_pins", "run"]

PINS_JSON = """\
  {"cells": [{"id", "layer", "state": "resident" | "stale" | "loading" | "absent" | code of its failure,
              "bytes"}],
   "unknown": [ids the map does not have]}
Exit code: 0, or 1 when an id is unknown or this user may not do it."""

_COLUMNS = (Column("CELL"), Column("LAYER"), Column("STATE"), Column("MEMORY", "right"))


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "pin",
        run,
        help="keep cells in memory",
        description="Load cells and keep them in shared memory, until `shmmap unpin` or the daemon's end.  "
        "Without cells: list what is pinned.",
        json=PINS_JSON,
    )
    add_cells_argument(parser)
    parser.add_argument(
        "--layer", metavar="SPEC", nargs="+", default=["points"], help="layers to keep (default: points)"
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the pins."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        answer = client.pin(args.cells, args.layer)
    return print_pins(answer, as_json=args.json)


def print_pins(answer: Pinned, *, as_json: bool) -> int:
    """Print what is pinned; returns the exit code."""
    if as_json:
        rows = [
            {"id": cell.id, "layer": cell.layer, "state": cell.state, "bytes": cell.bytes}
            for cell in answer.cells
        ]
        print_json({"cells": rows, "unknown": list(answer.unknown)})
    else:
        if answer.cells:
            table = [[cell.id, cell.layer, cell.state, format_bytes(cell.bytes)] for cell in answer.cells]
            print_table(_COLUMNS, table)
        elif not answer.unknown:
            print("nothing is pinned")
        for name in answer.unknown:
            print(f"unknown cell: {name}")
    return 1 if answer.unknown else 0
