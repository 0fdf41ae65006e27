# SPDX-License-Identifier: Apache-2.0
"""``shmmap ls``: the segments the daemon keeps, read from its statistics segment."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.areas import add_area_options, area_from, around, those_in
from shmmap.cli.options import Subparsers, add_statistics_options, add_verb
from shmmap.cli.program import add_allow_empty, nothing_found
from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_duration,
    format_metres,
    print_json,
    print_line,
    print_table,
)
from shmmap.errors import DaemonUnreachable
from shmmap.lacking import area_text, extent_text

if TYPE_CHECKING:
    from shmmap.protocol.rows import CellRow

__all__ = ["add_parser", "run"]

_JSON = """\
  {"state": as in `shmmap status`, "epoch": hex, "not_listed": segments the table has no room for,
   "cells": [{"id", "version": hex, "layer", "state": "resident" | "stale" | "zombie", "segment",
              "ahead": bool, fetched ahead and not asked for yet, "bytes", "points",
              "box": [minx, miny, maxx, maxy] in metres, "hits", "idle_s", "load_s"}]}
A zombie is a retired segment: no client gets it any more, its memory is freed when nobody maps it.
An id of more than 104 bytes is cut at its start, and begins with an ellipsis then.
Exit code: 0, also when nothing is in memory; 1 when an area touches no cell in memory, 69 when the daemon
is dead or was never started."""

_COLUMNS = (
    Column("CELL"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("SIZE", "right", spare=6),
    Column("STATE", spare=4),
    Column("LAYER", spare=1),
    Column("ROWS", "right"),
    Column("MEMORY", "right"),
    Column("HITS", "right", spare=5),
    Column("LAST USED", "right", spare=3),
    Column("LOAD", "right", spare=7),
)


_STATES = ("resident", "ahead", "stale", "retired")
"""States as they are shown; JSON has ``zombie`` for the last, and ``ahead`` apart."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "ls",
        run,
        help="the cells in shared memory",
        description="List the cells in shared memory, one line for each layer of a cell.  Reads the daemon's "
        "statistics: works while the daemon is paused (SIGSTOP, a debugger) or hangs; not after "
        "`shmmap stop`.\n"
        "X, Y, SIZE: lower corner and side, metres, map frame.\n"
        "STATE: resident; ahead when it was fetched before a client asked for it, and none has yet; stale "
        "when a newer version exists that is not loaded yet; retired (in JSON: zombie) when it left service, "
        "to be freed when no process maps it.\n"
        "ROWS: points, or what a layer has instead, such as voxels.\n"
        "HITS, LAST USED: how often it was given to clients, and how long ago the last time.\n"
        "LOAD: how long loading took.",
        json=_JSON,
    )
    parser.add_argument(
        "--sort",
        choices=("id", "bytes", "points", "hits", "used", "load"),
        default="id",
        help="largest first, but for id (default: id)",
    )
    parser.add_argument("--state", choices=_STATES, help="only these")
    add_area_options(parser, parser.add_mutually_exclusive_group(), heights=False)
    add_allow_empty(parser)
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

    area = area_from(args)
    found, identity = snapshot(args)
    rows = found.cells
    there = around(row.box for row in rows)
    if area is not None:
        rows = [rows[index] for index in those_in(area, [row.box for row in rows])]
    nothing_there = there is not None and not rows
    if args.state is not None:
        rows = [row for row in rows if args.state in (_shown_state(row), row.state)]
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
        if rows:
            print_table(_COLUMNS, [_as_text(row, now_ns) for row in rows])
        elif not found.cells:
            print_line("nothing is in memory: cells are loaded when a client asks for them")
        elif not nothing_there:
            print_line(f"no cell in memory is {args.state}")
        if found.rows_missing:
            print_line(f"and {found.rows_missing:,} more that the statistics have no room for")
    if found.state == "dead":
        return DaemonUnreachable.exit_code
    if nothing_there and area is not None and there is not None:
        spans = f"those in memory span {extent_text(there)}"
        return nothing_found(args, f"no cell in memory {area_text(area)}; {spans}")
    return 0


def _shown_state(row: CellRow) -> str:
    if row.ahead:
        return "ahead"
    return "retired" if row.state == "zombie" else row.state


def _idle_s(row: CellRow, now_ns: int) -> float | None:
    return max(now_ns - row.last_use_monotonic_ns, 0) * 1e-9 if row.last_use_monotonic_ns else None


def _as_json(row: CellRow, id_prefix: str, instance: str, now_ns: int) -> dict[str, object]:
    from shmmap.segment.names import retired_name, segment_prefix

    idle_s = _idle_s(row, now_ns)
    segment = segment_prefix(instance) + row.segment
    return {
        "id": row.id if row.id.startswith("…") else id_prefix + row.id,
        "version": f"{row.version:016x}",
        "layer": row.layer,
        "state": row.state,
        "segment": retired_name(segment) if row.state == "zombie" else segment,
        "ahead": row.ahead,
        "bytes": row.bytes,
        "points": row.points,
        "box": list(row.box),
        "hits": row.hits,
        "idle_s": None if idle_s is None else round(idle_s, 3),
        "load_s": round(row.load_ns * 1e-9, 6),
    }


def _whole_seconds(span_s: float) -> str:
    return format_duration(span_s) if span_s >= 60 else f"{span_s:.0f} s"


def _as_text(row: CellRow, now_ns: int) -> list[str]:
    idle_s = _idle_s(row, now_ns)
    return [
        row.id,
        format_metres(row.box[0]),
        format_metres(row.box[1]),
        f"{format_metres(max(row.box[2] - row.box[0], row.box[3] - row.box[1]))} m",
        _shown_state(row),
        row.layer,
        f"{row.points:,}",
        format_bytes(row.bytes),
        f"{row.hits:,}",
        "never" if idle_s is None else f"{_whole_seconds(idle_s)} ago",
        format_duration(row.load_ns * 1e-9),
    ]
