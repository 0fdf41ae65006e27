# SPDX-License-Identifier: Apache-2.0
"""``shmmap ls``: the segments the daemon keeps, read from its statistics segment."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.screens.output import Column, format_bytes, format_duration, print_json, print_table
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.statistics.cell_rows import CellRow

__all__ = ["add_parser", "run"]

_JSON = """\
  {"state": as in `shmmap status`, "epoch": hex, "not_listed": segments the table has no room for,
   "cells": [{"id", "version": hex, "layer", "state": "resident" | "stale" | "zombie", "segment",
              "bytes", "points", "box": [minx, miny, maxx, maxy] in metres, "hits", "idle_s", "load_s"}]}
An id of more than 104 bytes is cut at its start, and begins with an ellipsis then.
Exit code: 0, or 69 when the daemon is dead or was never started."""

_COLUMNS = (
    Column("CELL"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("SIZE", "right", spare=6),
    Column("STATE", spare=4),
    Column("LAYER", spare=3),
    Column("POINTS", "right"),
    Column("MEMORY", "right"),
    Column("HITS", "right", spare=5),
    Column("USED", "right", spare=1),
    Column("LOAD", "right", spare=7),
)


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "ls",
        run,
        help="the cells in shared memory",
        description="List the segments the daemon keeps: lower corner and size in metres, time since the "
        "last use, time the load took.  Asks nobody: works while the daemon is stopped.",
        json=_JSON,
    )
    parser.add_argument(
        "--sort",
        choices=("id", "bytes", "points", "hits", "used", "load"),
        default="id",
        help="largest first",
    )
    parser.add_argument("--state", choices=("resident", "stale", "zombie"), help="only these")
    add_statistics_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    import gc

    gc.disable()  # a look for cycles among thousands of rows takes a quarter of the time
    try:
        return _list(args)
    finally:
        gc.enable()


def _list(args: argparse.Namespace) -> int:
    import time

    from shmmap.cli.daemon_address import snapshot

    found, identity = snapshot(args)
    rows = [row for row in found.cells if args.state in (None, row.state)]
    if args.sort != "id":
        name = {"used": "last_use_monotonic_ns", "load": "load_ns"}.get(args.sort, args.sort)
        rows.sort(key=lambda row: int(getattr(row, name)), reverse=True)
    now_ns = time.monotonic_ns()
    if args.json:
        print_json(
            {
                "state": found.state,
                "epoch": f"{identity.epoch:016x}",
                "not_listed": found.rows_missing,
                "cells": [_as_json(row, identity.id_prefix, identity.instance, now_ns) for row in rows],
            }
        )
    else:
        print_table(_COLUMNS, [_as_text(row, now_ns) for row in rows])
        if found.rows_missing:
            print(f"and {found.rows_missing:,} more that the statistics have no room for")
    return DaemonUnreachable.exit_code if found.state == "dead" else 0


def _idle_s(row: CellRow, now_ns: int) -> float | None:
    return max(now_ns - row.last_use_monotonic_ns, 0) * 1e-9 if row.last_use_monotonic_ns else None


def _as_json(row: CellRow, id_prefix: str, instance: str, now_ns: int) -> dict[str, object]:
    from shmmap.segment.names import segment_prefix, zombie_name

    idle_s = _idle_s(row, now_ns)
    segment = segment_prefix(instance) + row.segment
    return {
        "id": f"…{row.id}" if row.id_cut else id_prefix + row.id,
        "version": f"{row.version:016x}",
        "layer": row.layer,
        "state": row.state,
        "segment": zombie_name(segment) if row.state == "zombie" else segment,
        "bytes": row.bytes,
        "points": row.points,
        "box": list(row.box),
        "hits": row.hits,
        "idle_s": None if idle_s is None else round(idle_s, 3),
        "load_s": round(row.load_ns * 1e-9, 6),
    }


def _as_text(row: CellRow, now_ns: int) -> list[str]:
    idle_s = _idle_s(row, now_ns)
    return [
        f"…{row.id}" if row.id_cut else row.id,
        f"{row.box[0]:g}",
        f"{row.box[1]:g}",
        f"{max(row.box[2] - row.box[0], row.box[3] - row.box[1]):g} m",
        row.state,
        row.layer,
        f"{row.points:,}",
        format_bytes(row.bytes),
        f"{row.hits:,}",
        "never" if idle_s is None else format_duration(idle_s),
        format_duration(row.load_ns * 1e-9),
    ]
