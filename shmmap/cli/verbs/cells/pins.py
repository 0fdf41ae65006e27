# SPDX-License-Identifier: Apache-2.0
"""``shmmap pin`` and ``shmmap unpin``: keep cells in memory, list those kept, end that."""

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

__all__ = ["add_pin", "add_unpin", "run_pin", "run_unpin"]


_EXIT = """\
Exit code: 0; 1 when an id is unknown, an area touches no cell, or this user may not do it."""

_COLUMNS = (Column("CELL"), Column("LAYER"), Column("STATE"), Column("MEMORY", "right"))


def add_pin(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "pin",
        run_pin,
        help="keep cells in memory",
        description="Load cells and keep them in shared memory until `shmmap unpin` or until the daemon "
        "ends, whatever else needs memory.  Without cells: list what is pinned.",
        output="cells.outputs.Pins",
        epilog=_EXIT,
    )
    add_cells_argument(parser)
    add_layer_option(parser, "layers to keep (default: points)")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_pin(args: argparse.Namespace) -> int:
    """Pin, and print the pinned cells."""
    from shmmap.cli.daemon_address import connect

    area = check_cells_argument(args, "pin", optional=True)
    with connect(args) as client:
        cells = cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                from shmmap.cli.verbs.cells import outputs

                print_json(outputs.Pins([], []))
            return no_cell_there(args, client, area)
        answer = client.pin(cells, layers_from(args))
        hint = near_cells_hint(client, answer.unknown)
    return _print_pins(answer, hint, as_json=args.json)


def _print_pins(answer: Pinned, hint: str, *, as_json: bool) -> int:
    """Print what is pinned, and a hint about unknown ids; returns the exit code."""
    if as_json:
        from shmmap.cli.verbs.cells import outputs

        rows = [outputs.Pin(cell.id, cell.layer, cell.state, cell.bytes) for cell in answer.cells]
        print_json(outputs.Pins(rows, list(answer.unknown)))
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


def add_unpin(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "unpin",
        run_unpin,
        help="undo pin",
        description="Pinned cells become ordinary ones: they stay in memory until it is needed for others.  "
        "Prints what stays pinned.",
        output="cells.outputs.Pins",
        epilog=_EXIT,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every pinned cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_unpin(args: argparse.Namespace) -> int:
    """End pins, and print what stays pinned."""
    from shmmap.cli.daemon_address import connect

    area = check_cells_argument(args, "unpin")
    with connect(args) as client:
        cells = None if args.all else cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                from shmmap.cli.verbs.cells import outputs

                print_json(outputs.Pins([], []))
            return no_cell_there(args, client, area)
        answer = client.unpin(cells)
        hint = near_cells_hint(client, answer.unknown)
    return _print_pins(answer, hint, as_json=args.json)
