# SPDX-License-Identifier: Apache-2.0
"""``shmmap ls`` and ``shmmap show``: list the cells in shared memory, and describe one."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from shmmap.cli.areas import add_area_options, area_from, around, those_in
from shmmap.cli.daemon_address import connect, connect_to, snapshot
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty, nothing_found
from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_duration,
    format_metres,
    print_json,
    print_line,
    print_pairs,
    print_table,
    rows_text,
    user_name,
)
from shmmap.errors import UnknownCell
from shmmap.lacking import area_text, extent_text, near_cells_hint

if TYPE_CHECKING:
    from shmmap.protocol.messages import ShownCell
    from shmmap.protocol.rows import CellRow, Holder

_LS_EXIT = """\
Exit code: 0, also when nothing is in memory; 1 when an area touches no cell in memory, 69 when no daemon
answers."""

_COLUMNS = (
    Column("CELL"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("SIZE", "right", spare=6),
    Column("STATE", spare=4, looks={"stale": "yellow", "retired": "magenta", "ahead": "cyan"}),
    Column("LAYER", spare=1),
    Column("ROWS", "right"),
    Column("MEMORY", "right"),
    Column("HITS", "right", spare=5),
    Column("LAST USED", "right", spare=3),
    Column("LOAD", "right", spare=7),
)


_STATES = ("resident", "ahead", "stale", "retired")
"""States as printed; JSON says ``zombie`` for the last, and has ``ahead`` as a field of its own."""


def add_ls(subparsers: Subparsers) -> None:
    """Add the verb ``ls``."""
    parser = add_verb(
        subparsers,
        "ls",
        run_ls,
        help="the cells in shared memory",
        description="List the cells in shared memory, one line for each layer of a cell.\n"
        "X, Y, SIZE: lower corner and side, metres, map frame.\n"
        "STATE: resident; ahead when it was fetched before a client asked for it, and none has yet; stale "
        "when a newer version exists that is not loaded yet; retired (in JSON: `zombie`) when it left "
        "service, to be freed when no process maps it.\n"
        "ROWS: points, or what a layer has instead, such as voxels.\n"
        "HITS, LAST USED: how often it was given to clients, and how long ago the last time.\n"
        "LOAD: how long loading took.",
        output="look.outputs.Listed",
        epilog=_LS_EXIT,
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
    add_daemon_options(parser)


def run_ls(args: argparse.Namespace) -> int:
    """Print the table of cells."""
    import gc

    gc.disable()  # garbage collection among thousands of rows takes a quarter of the time
    try:
        return _list(args)
    finally:
        gc.enable()


def _list(args: argparse.Namespace) -> int:
    area = area_from(args)
    found, identity = snapshot(args)
    with connect_to(args, found) as client:
        rows = known = client.list_cells()
    there = around(row.box for row in rows)
    if area is not None:
        rows = [rows[index] for index in those_in(area, [row.box for row in rows])]
    nothing_there = there is not None and not rows
    if args.state is not None:
        rows = [row for row in rows if args.state in (row.shown_state, row.state)]
    if args.sort != "id":
        name = {"used": "last_use_monotonic_ns", "load": "load_ns"}.get(args.sort, args.sort)
        rows.sort(key=lambda row: int(getattr(row, name)), reverse=True)
    now_ns = time.monotonic_ns()
    if args.json:
        from shmmap.cli.json_output import Segment
        from shmmap.cli.verbs.look import outputs

        segments = [
            Segment.of(row, now_ns, id_prefix=identity.id_prefix, instance=identity.instance) for row in rows
        ]
        print_json(outputs.Listed(found.state, f"{identity.epoch:016x}", 0, segments))
    else:
        if rows:
            print_table(_COLUMNS, [_ls_row(row, now_ns) for row in rows])
        elif not known:
            print_line("nothing is in memory: cells are loaded when a client asks for them")
        elif not nothing_there:
            print_line(f"no cell in memory is {args.state}")
    if nothing_there and area is not None and there is not None:
        spans = f"those in memory span {extent_text(there)}"
        return nothing_found(args, f"no cell in memory {area_text(area)}; {spans}")
    return 0


def _whole_seconds(span_s: float) -> str:
    return format_duration(span_s) if span_s >= 60 else f"{span_s:.0f} s"


def _ls_row(row: CellRow, now_ns: int) -> list[str]:
    idle_s = row.idle_s(now_ns)
    return [
        row.id,
        format_metres(row.box[0]),
        format_metres(row.box[1]),
        f"{format_metres(max(row.box[2] - row.box[0], row.box[3] - row.box[1]))} m",
        row.shown_state,
        row.layer,
        f"{row.points:,}",
        format_bytes(row.bytes),
        f"{row.hits:,}",
        "never" if idle_s is None else f"{_whole_seconds(idle_s)} ago",
        format_duration(row.load_ns * 1e-9),
    ]


_SHOW_EXIT = """\
Exit code: 0, or 1 when the map has no such cell."""


def add_show(subparsers: Subparsers) -> None:
    """Add the verb ``show``."""
    parser = add_verb(
        subparsers,
        "show",
        run_show,
        help="one cell: versions, memory, which processes use it",
        description="Show everything the daemon knows about one cell: its box, its segments in shared "
        "memory, which processes map them, its last failure.",
        output="look.outputs.Shown",
        epilog=_SHOW_EXIT,
    )
    parser.add_argument("cell", metavar="CELL", help="its id, or the file's name where that is unique")
    add_daemon_options(parser)


def run_show(args: argparse.Namespace) -> int:
    """Print everything about one cell."""
    with connect(args) as client:
        try:
            cell = client.show(args.cell)
        except UnknownCell as error:
            error.hint = near_cells_hint(client, [args.cell])
            raise
    if args.json:
        from shmmap.cli.verbs.look import outputs

        print_json(outputs.Shown.of(cell))
    else:
        print_pairs(_show_lines(cell))
    return 0


def _show_lines(cell: ShownCell) -> list[tuple[str, str]]:
    z = (cell.z_min, cell.z_max)
    lines = [
        ("cell", cell.id),
        ("version", f"{cell.version:016x}"),
        ("box", extent_text((cell.min_x, cell.min_y, cell.max_x, cell.max_y))),
        ("heights", "known after the first load" if None in z else f"{z[0]:.2f} .. {z[1]:.2f} m"),
        ("file", format_bytes(cell.source_bytes)),
    ]
    lines += [("loading", layer) for layer in cell.loading]
    lines += [("pinned", f"{layer}, by an operator (see `shmmap unpin`)") for layer in cell.pinned]
    if cell.failure:
        lines.append(("failure", cell.failure))
    if not cell.segments:
        lines.append(("segments", "none: not in memory"))
    for segment in cell.segments:
        lines.append(("segment", _segment_line(segment)))
        lines += [("  in use by", _holder_line(holder)) for holder in segment.holders]
    return lines


def _segment_line(segment: CellRow) -> str:
    rows = rows_text(segment.points, segment.layer)
    return (
        f"{segment.layer}, {segment.shown_state}, {rows}, {format_bytes(segment.bytes)},"
        f" version {segment.version:016x}, {segment.segment}"
    )


def _holder_line(holder: Holder) -> str:
    if not holder.session:
        return "an unidentified process (not through the client library)"
    command = f" ({holder.command})" if holder.command not in ("", holder.client) else ""
    user = f"{holder.client or 'client'}{command}, pid {holder.pid}, user {user_name(holder.uid)}"
    return f"{user}, {format_bytes(holder.bytes)}"
