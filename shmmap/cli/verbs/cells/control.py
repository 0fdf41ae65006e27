# SPDX-License-Identifier: Apache-2.0
"""``shmmap reload``, ``evict`` and ``stop``: read the map again, free memory, end the daemon."""

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

__all__ = ["add_evict", "add_reload", "add_stop", "run_evict", "run_reload", "run_stop"]


_RELOAD_EXIT = """\
Exit code: 0; 1 when this user may not do it, 65 bad map: the map before stays, 66 no map there, 69 when no
daemon answers."""


def add_reload(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "reload",
        run_reload,
        help="read the map again: changed, new and deleted files",
        description="Make the daemon read the map's list of cells again, as SIGHUP does.  Clients get what "
        "changed with their next request; cells they have mapped stay readable.",
        output="cells.outputs.Reload",
        epilog=_RELOAD_EXIT,
    )
    add_daemon_options(parser)


def run_reload(args: argparse.Namespace) -> int:
    """Print what changed."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        answer = client.reload()
    if args.json:
        from shmmap.cli.verbs.cells import outputs

        print_json(
            outputs.Reload(
                f"{answer.map_version:016x}",
                answer.changed,
                answer.added,
                answer.removed,
                list(answer.problems),
            )
        )
        return 0
    print_line(
        f"{counted(answer.changed, 'cell')} changed, {answer.added:,} added, {answer.removed:,} removed;"
        f" map version {answer.map_version:016x}"
    )
    for problem in answer.problems:
        print_line(f"note: {problem}")
    return 0


_NAMED: Final = 20
"""Kept segments that are named one by one."""

_EVICT_EXIT = """\
Exit code: 0; 1 when an id is unknown, an area touches no cell, or this user may not do it."""


def add_evict(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "evict",
        run_evict,
        help="evict cells from memory",
        description="Retire cells from shared memory: no client gets them any more, and their memory is "
        "freed as soon as no process maps it.  The next request loads them again.",
        output="cells.outputs.Eviction",
        epilog=_EVICT_EXIT,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_evict(args: argparse.Namespace) -> int:
    """Evict, and print what became free."""
    from shmmap.cli.daemon_address import connect

    area = check_cells_argument(args, "evict")
    with connect(args) as client:
        cells = None if args.all else cells_meant(args, client, area)
        if area is not None and not cells:
            if args.json:
                from shmmap.cli.verbs.cells import outputs

                print_json(outputs.Eviction(0, 0, 0, []))
            return no_cell_there(args, client, area)
        answer = client.evict(cells)
        hint = near_cells_hint(client, answer.unknown)
        kept = _kept(client, cells) if answer.kept and not args.json else []
    if args.json:
        from shmmap.cli.verbs.cells import outputs

        print_json(outputs.Eviction(answer.freed, answer.pinned, answer.kept, list(answer.unknown)))
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


_STOP_EXIT = """\
Exit code: 0, or 1 when this user may not do it."""


def add_stop(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "stop",
        run_stop,
        help="end the daemon and free its memory",
        description="End the daemon, as SIGTERM does: a cell's memory is freed as soon as no "
        "process maps it.  The daemon's user, root and members of its --admin-group may do this; unlike "
        "a signal it works for other users than the daemon's.",
        output="cells.outputs.Stop",
        epilog=_STOP_EXIT,
    )
    add_daemon_options(parser)


def run_stop(args: argparse.Namespace) -> int:
    """Ask for the end."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        pid = client.welcome.pid
        client.shutdown()
    if args.json:
        from shmmap.cli.verbs.cells import outputs

        print_json(outputs.Stop(pid))
    else:
        print_line(f"daemon {pid} is stopping")
    return 0
