# SPDX-License-Identifier: Apache-2.0
"""``shmmap clients``: connected clients, and how much memory each uses."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_duration,
    print_hanging,
    print_json,
    print_line,
    print_table,
    user_name,
)

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow

__all__ = ["add_parser", "run"]

_EXIT = """\
Exit code: 0, or 69 when no daemon answers."""

_COLUMNS = (
    Column("CLIENT"),
    Column("PID", "right"),
    Column("USER", spare=2),
    Column("CELLS", "right"),
    Column("GIVEN", "right"),
    Column("MAPPED", "right"),
    Column("OUTDATED", "right", spare=1),
    Column("REQUESTS", "right", spare=4),
    Column("IDLE", "right", spare=5),
    Column("AT", spare=3),
    Column("COMMAND", spare=6),
)


_LEGEND = """\
CELLS, GIVEN: cells it was given and has not returned, and their memory
MAPPED: mapped now, according to the kernel
OUTDATED: the part of MAPPED that is stale (a newer version exists) or retired (out of service; freed when \
the last client releases it)"""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "clients",
        run,
        help="connected clients, and the memory each uses",
        description="List connected clients, and memory mapped by unidentified processes.\n" + _LEGEND + "\n"
        "IDLE: time since its last request.  AT: where it said it is, metres, map frame.",
        output="look.outputs.Clients",
        epilog=_EXIT,
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        stats = client.stats()
    if args.json:
        from shmmap.cli.json_output import Client
        from shmmap.cli.verbs.look import outputs

        rows = [Client.of(row, time.monotonic_ns(), mapped=True) for row in stats.sessions]
        print_json(outputs.Clients(rows, stats.unknown_holders, stats.unknown_bytes))
        return 0
    print_table(_COLUMNS, [_as_text(row) for row in stats.sessions])
    if stats.unknown_holders:
        unknown = f"{stats.unknown_holders:,} segments, {format_bytes(stats.unknown_bytes)}"
        print_line(f"{unknown}: mapped by unidentified processes (not through the client library)")
    if sys.stdout.isatty():
        for line in _LEGEND.splitlines():
            names, meaning = line.split(": ", 1)
            print_hanging(f"{names}: ", meaning)
    return 0


def _as_text(row: ClientRow) -> list[str]:
    return [
        row.client or "-",
        str(row.pid or "?"),
        user_name(row.uid),
        f"{row.cells:,}",
        format_bytes(row.bytes),
        format_bytes(row.mapped_bytes),
        format_bytes(row.superseded_bytes) if row.superseded else "-",
        f"{row.requests:,}",
        format_duration(row.idle_s(time.monotonic_ns())),
        "-" if row.pose is None else f"{row.pose[0]:.1f},{row.pose[1]:.1f}",
        row.command,
    ]
