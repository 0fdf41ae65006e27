# SPDX-License-Identifier: Apache-2.0
"""``shmmap pin`` and ``shmmap unpin``: keep cells in memory, list those kept, end that."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.areas import act_on_cells, add_cells_argument
from shmmap.cli.options import Subparsers, add_daemon_options, add_layer_option, add_verb, layers_from
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import Column, format_bytes, print_json, print_line, print_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from shmmap.client.client import Client
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
    layers = layers_from(args)
    return _change_pins(args, "pin", lambda client, cells: client.pin(cells or (), layers), optional=True)


def _change_pins(
    args: argparse.Namespace,
    verb: str,
    ask: Callable[[Client, list[str] | None], Pinned],
    *,
    optional: bool = False,
) -> int:
    """Change what is pinned, and print what is pinned then; returns the exit code."""
    from shmmap.protocol.messages import Pinned

    def show(answer: Pinned) -> None:
        if args.json:
            from shmmap.cli.verbs.cells import outputs

            rows = [outputs.Pin(cell.id, cell.layer, cell.state, cell.bytes) for cell in answer.cells]
            print_json(outputs.Pins(rows, list(answer.unknown)))
        elif answer.cells:
            table = [[cell.id, cell.layer, cell.state, format_bytes(cell.bytes)] for cell in answer.cells]
            print_table(_COLUMNS, table)
        elif not answer.unknown:
            print_line("nothing is pinned")

    return act_on_cells(args, verb, ask, show, nothing=Pinned(0, ()), optional=optional)


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
    return _change_pins(args, "unpin", lambda client, cells: client.unpin(cells))
