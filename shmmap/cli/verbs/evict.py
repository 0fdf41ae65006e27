# SPDX-License-Identifier: Apache-2.0
"""``shmmap evict``: retire cells from shared memory."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Final

from shmmap.cli.areas import (
    add_cells_argument,
    cells_meant,
    check_cells_argument,
    no_cell_there,
    print_near_cells,
)
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import counted, print_json, print_line
from shmmap.lacking import near_cells_hint

if TYPE_CHECKING:
    from shmmap.client.client import Client
    from shmmap.protocol.messages import Evicted

__all__ = ["add_parser", "run"]

_NAMED: Final = 20
"""Kept segments that are named one by one."""

_JSON = """\
  {"freed": segments whose memory is free, "still_mapped": segments retired, freed when no client maps them,
   "kept": segments kept in service because an operator pinned them (`shmmap pin`),
   "unknown": [ids the map does not have]}
Exit code: 0; 1 when an id is unknown, an area touches no cell, or this user may not do it."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "evict",
        run,
        help="free cells from memory",
        description="Retire cells from shared memory: no client gets them any more, and their memory is "
        "freed as soon as no process maps it.  The next request loads them again.",
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
        hint = near_cells_hint(client, answer.unknown)
        kept = _kept(client, cells) if answer.kept and not args.json else []
    if args.json:
        print_json(_as_json(answer))
    else:
        print_line(f"{counted(answer.freed, 'segment')} freed")
        if answer.pinned:
            print_line(f"{counted(answer.pinned, 'segment')} retired, freed when no client maps them")
        if answer.kept:
            print_line(f"{counted(answer.kept, 'segment')} kept, pinned by an operator (see `shmmap unpin`):")
        for line in kept[:_NAMED]:
            print_line(f"  {line}")
        if len(kept) > _NAMED:
            print_line(f"  and {len(kept) - _NAMED:,} more, see `shmmap pin`")
        for name in answer.unknown:
            print_line(f"unknown cell: {name}")
    print_near_cells(hint)
    return 1 if answer.unknown else 0


def _kept(client: Client, cells: list[str] | None) -> list[str]:
    """Return the segments that an operator keeps, of these cells or of all: ``"town_0_0.pcd: points"``."""
    names = {cell.removeprefix(client.welcome.id_prefix) for cell in cells or ()}
    return [
        f"{row.id.rpartition('/')[2]}: {row.layer}"
        for row in client.pin().cells
        if row.state in ("resident", "stale")
        and (cells is None or row.id in names or row.id.rpartition("/")[2] in names)
    ]


def _as_json(answer: Evicted) -> dict[str, object]:
    return {
        "freed": answer.freed,
        "still_mapped": answer.pinned,
        "kept": answer.kept,
        "unknown": list(answer.unknown),
    }
