# SPDX-License-Identifier: Apache-2.0
"""``shmmap clients``: who is connected, and what each holds."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.accounts import user_name
from shmmap.cli.screens.output import Column, format_bytes, format_duration, print_json, print_table

if TYPE_CHECKING:
    from shmmap.protocol.messages import SessionRow

__all__ = ["add_parser", "run"]

_JSON = """\
  {"clients": [{"session": hex, "pid": as the kernel says, 0 where it does not, "uid", "user", "gid",
                "client", "command", "cells": handed to it and not given back, "bytes": theirs, "requests",
                "idle_s", "pose": [x, y] or null, "mapped_bytes": what it maps by the kernel's word,
                "superseded": segments among those that nobody new gets, "superseded_bytes"}],
   "unknown_holders": segments mapped by nobody known, "unknown_bytes"}
The list includes this program itself."""

_COLUMNS = (
    Column("CLIENT"),
    Column("PID", "right"),
    Column("USER", spare=2),
    Column("CELLS", "right"),
    Column("HANDED", "right"),
    Column("MAPS", "right"),
    Column("OLD", "right", spare=1),
    Column("REQUESTS", "right", spare=4),
    Column("IDLE", "right", spare=5),
    Column("AT", spare=3),
    Column("COMMAND", spare=6),
)


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "clients",
        run,
        help="who is connected and holds what",
        description="List the sessions the daemon knows, and memory that nobody known holds.\n"
        "HANDED is what a client was given and did not say it dropped, MAPS what it has mapped by the\n"
        "kernel's word, OLD the part of that which was replaced or evicted and goes when it lets go.",
        json=_JSON,
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        stats = client.stats()
    if args.json:
        print_json(
            {
                "clients": [_as_json(row) for row in stats.sessions],
                "unknown_holders": stats.unknown_holders,
                "unknown_bytes": stats.unknown_bytes,
            }
        )
        return 0
    print_table(_COLUMNS, [_as_text(row) for row in stats.sessions])
    if stats.unknown_holders:
        print(
            f"{stats.unknown_holders:,} segments, {format_bytes(stats.unknown_bytes)}: held by nobody known"
        )
    return 0


def _as_json(row: SessionRow) -> dict[str, object]:
    return {
        "session": f"{row.session:016x}",
        "pid": row.pid,
        "uid": row.uid,
        "user": user_name(row.uid),
        "gid": row.gid,
        "client": row.client,
        "command": row.command,
        "cells": row.cells,
        "bytes": row.bytes,
        "requests": row.requests,
        "idle_s": round(row.idle_s, 3),
        "pose": None if row.pose is None else list(row.pose),
        "mapped_bytes": row.mapped_bytes,
        "superseded": row.superseded,
        "superseded_bytes": row.superseded_bytes,
    }


def _as_text(row: SessionRow) -> list[str]:
    return [
        row.client or "-",
        str(row.pid or "?"),
        user_name(row.uid),
        f"{row.cells:,}",
        format_bytes(row.bytes),
        format_bytes(row.mapped_bytes),
        format_bytes(row.superseded_bytes) if row.superseded else "-",
        f"{row.requests:,}",
        format_duration(row.idle_s),
        "-" if row.pose is None else f"{row.pose[0]:.1f},{row.pose[1]:.1f}",
        row.command,
    ]
