# SPDX-License-Identifier: Apache-2.0
"""``shmmap unpin``: end the pins on cells."""

from __future__ import annotations

import argparse

from shmmap.cli.areas import add_cells_argument, cells_meant, check_cells_argument, no_cell_there
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import print_json
from shmmap.cli.verbs.pin import PINS_JSON, print_pins
from shmmap.lacking import near_cells_hint

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "unpin",
        run,
        help="undo pin",
        description="Pinned cells become ordinary ones: they stay in memory until it is needed for others.  "
        "Prints what stays pinned.",
        json=PINS_JSON,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every pinned cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """End pins, and print what stays pinned."""
    from shmmap.cli.daemon_address import connect

    area = check_cells_argument(args, "unpin")
    with connect(args) as client:
        cells = None if args.all else cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                print_json({"cells": [], "unknown": []})
            return no_cell_there(args, client, area)
        answer = client.unpin(cells)
        hint = near_cells_hint(client, answer.unknown)
    return print_pins(answer, hint, as_json=args.json)
