# SPDX-License-Identifier: Apache-2.0
"""``shmmap pin [CELL...]``: keep cells in memory, or list those that are kept."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.areas import (
    add_cells_argument,
    cells_meant,
    check_cells_argument,
    no_cell_there,
    print_near_cells,
)
from shmmap.cli.options import Subparsers, add_daemon_options, add_layer_option, add_verb, layers_from
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import Column, format_bytes, print_json, print_line, print_table
from shmmap.lacking import near_cells_hint

if TYPE_CHECKING:
    from shmmap.protocol.messages import Pinned

__all__ = ["PINS_JSON", "add_parser", "print_pins", "run"]

PINS_JSON = """\
  {"cells": [{"id", "layer", "state": "resident" | "stale" | "loading" | "absent" | code of its failure,
              "bytes"}],
   "unknown": [ids the map does not have]}
Exit code: 0; 1 when an id is unknown, an area touches no cell, or this user may not do it."""

_COLUMNS = (Column("CELL"), Column("LAYER"), Column("STATE"), Column("MEMORY", "right"))


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "pin",
        run,
        help="keep cells in memory",
        description="Load cells and keep them in shared memory until `shmmap unpin` or until the daemon "
        "ends, whoever else needs memory.  Without cells: list what is pinned.",
        json=PINS_JSON,
    )
    add_cells_argument(parser)
    add_layer_option(parser, "layers to keep (default: points)")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Pin, and print the pinned cells."""
    from shmmap.cli.daemon_address import connect

    area = check_cells_argument(args, "pin", optional=True)
    with connect(args) as client:
        cells = cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                print_json({"cells": [], "unknown": []})
            return no_cell_there(args, client, area)
        answer = client.pin(cells, layers_from(args))
        hint = near_cells_hint(client, answer.unknown)
    return print_pins(answer, hint, as_json=args.json)


def print_pins(answer: Pinned, hint: str, *, as_json: bool) -> int:
    """Print what is pinned, and a hint about unknown ids; returns the exit code."""
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
            print_line("nothing is pinned")
        for name in answer.unknown:
            print_line(f"unknown cell: {name}")
    print_near_cells(hint)
    return 1 if answer.unknown else 0
