# SPDX-License-Identifier: Apache-2.0
"""``shmmap reload``, ``evict``, ``pin``, ``unpin`` and ``stop``: commands that only operators may send."""

from __future__ import annotations

import argparse
import contextlib
from typing import TYPE_CHECKING, Final

from shmmap.cli.areas import act_on_cells, add_cells_argument
from shmmap.cli.daemon_address import connect, endpoint
from shmmap.cli.options import Subparsers, add_daemon_options, add_layer_option, add_verb, layers_from
from shmmap.cli.program import add_allow_empty
from shmmap.cli.screens.output import Column, counted, format_bytes, print_json, print_line, print_table
from shmmap.errors import ProtocolMismatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from shmmap.client.client import Client
    from shmmap.protocol.messages import Pinned

_RELOAD_EXIT = """\
Exit code: 0; 1 when this user may not do it, 65 bad map: the map before stays, 66 no map there, 69 when no
daemon answers."""


def add_reload(subparsers: Subparsers) -> None:
    """Add the verb ``reload``."""
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
    """Reload the map's metadata, and print what changed."""
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
"""Pinned segments that are named one by one, at most."""

_CELLS_EXIT = """\
Exit code: 0; 1 when an id is unknown, an area touches no cell, or this user may not do it."""


def add_evict(subparsers: Subparsers) -> None:
    """Add the verb ``evict``."""
    parser = add_verb(
        subparsers,
        "evict",
        run_evict,
        help="evict cells from memory",
        description="Retire cells from shared memory: no client gets them any more, and their memory is "
        "freed as soon as no process maps it.  The next request loads them again.",
        output="cells.outputs.Eviction",
        epilog=_CELLS_EXIT,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_evict(args: argparse.Namespace) -> int:
    """Evict cells, and print the bytes freed."""
    from shmmap.protocol.messages import Evicted

    kept: list[str] = []

    def ask(client: Client, cells: list[str] | None) -> Evicted:
        answer = client.evict(cells)
        if answer.kept and not args.json:
            kept.extend(_kept(client, cells))
        return answer

    def show(answer: Evicted) -> None:
        if args.json:
            from shmmap.cli.verbs.cells import outputs

            print_json(outputs.Eviction(answer.freed, answer.pinned, answer.kept, list(answer.unknown)))
            return
        print_line(f"{counted(answer.freed, 'segment')} freed")
        if answer.pinned:
            print_line(f"{counted(answer.pinned, 'segment')} retired, freed when no client maps them")
        if answer.kept:
            print_line(f"{counted(answer.kept, 'segment')} kept, pinned by an operator (see `shmmap unpin`):")
        for line in kept[:_NAMED]:
            print_line(f"  {line}")
        if len(kept) > _NAMED:
            print_line(f"  and {len(kept) - _NAMED:,} more, see `shmmap pin`")

    return act_on_cells(args, "evict", ask, show, nothing=Evicted(0, 0, 0))


def _kept(client: Client, cells: list[str] | None) -> list[str]:
    """Return the pinned segments of these cells or of all: ``"town_0_0.pcd: points"``."""
    names = {cell.removeprefix(client.welcome.id_prefix) for cell in cells or ()}
    return [
        f"{row.id.rpartition('/')[2]}: {row.layer}"
        for row in client.pin().cells
        if row.state in ("resident", "stale")
        and (cells is None or row.id in names or row.id.rpartition("/")[2] in names)
    ]


_CONNECT_S: Final = 1.0

_STOP_EXIT = """\
Exit code: 0, or 1 when this user may not do it."""


def add_stop(subparsers: Subparsers) -> None:
    """Add the verb ``stop``."""
    parser = add_verb(
        subparsers,
        "stop",
        run_stop,
        help="end the daemon and free its memory",
        description="End the daemon, as SIGTERM does: a cell's memory is freed as soon as no "
        "process maps it.  The daemon's user, root and members of its --admin-group may do this; unlike "
        "a signal it works for other users than the daemon's.  A daemon of another version of the protocol "
        "refuses it: the error names the process to send a signal to.",
        output="cells.outputs.Stop",
        epilog=_STOP_EXIT,
    )
    add_daemon_options(parser)


def run_stop(args: argparse.Namespace) -> int:
    """Ask the daemon to stop."""
    try:
        with connect(args) as client:
            pid = client.welcome.pid
            client.shutdown()
    except ProtocolMismatch as error:
        raise ProtocolMismatch(
            error.message, hint=f"a signal ends a daemon of any version: kill {_listener(args) or 'PID'}"
        ) from None
    if args.json:
        from shmmap.cli.verbs.cells import outputs

        print_json(outputs.Stop(pid))
    else:
        print_line(f"daemon {pid} is stopping")
    return 0


def _listener(args: argparse.Namespace) -> int:
    """Return the process that listens at the daemon's socket; 0 if it is a service manager, or unknown."""
    import socket
    import struct

    from shmmap.client.discovery import candidates

    for path in candidates(endpoint(args)):
        with socket.socket(socket.AF_UNIX) as peer, contextlib.suppress(OSError):
            peer.settimeout(_CONNECT_S)
            peer.connect(path)
            pid: int = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
            return pid if pid > 1 else 0
    return 0


_PIN_COLUMNS = (Column("CELL"), Column("LAYER"), Column("STATE"), Column("MEMORY", "right"))


def add_pin(subparsers: Subparsers) -> None:
    """Add the verb ``pin``."""
    parser = add_verb(
        subparsers,
        "pin",
        run_pin,
        help="keep cells in memory",
        description="Load cells and keep them in shared memory until `shmmap unpin` or until the daemon "
        "ends, whatever else needs memory.  Without cells: list what is pinned.",
        output="cells.outputs.Pins",
        epilog=_CELLS_EXIT,
    )
    add_cells_argument(parser)
    add_layer_option(parser, "layers to keep (default: points)")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_pin(args: argparse.Namespace) -> int:
    """Pin cells, and print all pins."""
    layers = layers_from(args)
    return _change_pins(args, "pin", lambda client, cells: client.pin(cells or (), layers), optional=True)


def _change_pins(
    args: argparse.Namespace,
    verb: str,
    ask: Callable[[Client, list[str] | None], Pinned],
    *,
    optional: bool = False,
) -> int:
    """Change pins, and print those that result; return the exit code."""
    from shmmap.protocol.messages import Pinned

    def show(answer: Pinned) -> None:
        if args.json:
            from shmmap.cli.verbs.cells import outputs

            rows = [outputs.Pin(cell.id, cell.layer, cell.state, cell.bytes) for cell in answer.cells]
            print_json(outputs.Pins(rows, list(answer.unknown)))
        elif answer.cells:
            table = [[cell.id, cell.layer, cell.state, format_bytes(cell.bytes)] for cell in answer.cells]
            print_table(_PIN_COLUMNS, table)
        elif not answer.unknown:
            print_line("nothing is pinned")

    return act_on_cells(args, verb, ask, show, nothing=Pinned(0, ()), optional=optional)


def add_unpin(subparsers: Subparsers) -> None:
    """Add the verb ``unpin``."""
    parser = add_verb(
        subparsers,
        "unpin",
        run_unpin,
        help="undo pin",
        description="Pinned cells become ordinary ones: they stay in memory until it is needed for others.  "
        "Prints what stays pinned.",
        output="cells.outputs.Pins",
        epilog=_CELLS_EXIT,
    )
    add_cells_argument(parser)
    parser.add_argument("--all", action="store_true", help="every pinned cell")
    add_allow_empty(parser)
    add_daemon_options(parser)


def run_unpin(args: argparse.Namespace) -> int:
    """Remove pins, and print those that remain."""
    return _change_pins(args, "unpin", lambda client, cells: client.unpin(cells))
