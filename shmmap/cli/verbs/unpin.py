# SPDX-License-Identifier: Apache-2.0
"""``shmmap unpin``: keep cells no longer than others."""

from __future__ import annotations

import argparse

from shmmap.cli.options import Subparsers, add_cells_argument, add_daemon_options, add_verb, cells_or_all
from shmmap.cli.verbs.pin import PINS_JSON, print_pins

__all__ = ["add_parser", "run"]


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "unpin",
        run,
        help="undo pin",
        description="Let pinned cells go: they stay in memory only as long as others.  Prints what stays "
        "pinned.",
        json=PINS_JSON,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every pinned cell")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print what stays pinned."""
    from shmmap.cli.daemon_address import connect

    cells = cells_or_all(args, "unpin")
    with connect(args) as client:
        answer = client.unpin(cells)
    return print_pins(answer, as_json=args.json)
