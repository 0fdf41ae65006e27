# SPDX-License-Identifier: Apache-2.0
"""``shmmap show CELL``: everything about one cell, and which processes use it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.accounts import user_name
from shmmap.cli.screens.output import format_bytes, print_json, print_pairs, rows_text
from shmmap.cli.screens.refusals import holder_row
from shmmap.errors import UnknownCell
from shmmap.lacking import extent_text, near_cells_hint

if TYPE_CHECKING:
    from shmmap.protocol.messages import CellRow, Holder, ShownCell

__all__ = ["add_parser", "run"]

_JSON = """\
  {"id", "version": hex, "box": [minx, miny, maxx, maxy], "z": [min, max] or null before the first load,
   "source_bytes", "loading": [layer], "pinned": [layer an operator keeps],
   "failure": text of the last failure that still stands, or "",
   "segments": [{"layer", "version": hex, "segment", "state": "resident" | "stale" | "zombie", "bytes",
                 "points",
                 "holders": [{"session": hex, "pid", "uid", "user", "client", "command", "bytes"}]}]}
A zombie is a retired segment.  Session 0: a process that did not open the segment through the client
library.
Exit code: 0, or 1 when the map has no such cell."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "show",
        run,
        help="one cell: versions, memory, which processes use it",
        description="Show everything the daemon knows about one cell: its box, its segments in shared "
        "memory, which processes map them, its last failure.",
        json=_JSON,
    )
    parser.add_argument("cell", metavar="CELL", help="its id, or the file's name where that is unique")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the cell."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        try:
            cell = client.show(args.cell)
        except UnknownCell as error:
            error.hint = near_cells_hint(client, [args.cell])
            raise
    if args.json:
        print_json(_as_json(cell))
    else:
        print_pairs(_lines(cell))
    return 0


def _heights(cell: ShownCell) -> list[float] | None:
    return None if cell.z_min is None or cell.z_max is None else [cell.z_min, cell.z_max]


def _as_json(cell: ShownCell) -> dict[str, object]:
    return {
        "id": cell.id,
        "version": f"{cell.version:016x}",
        "box": [cell.min_x, cell.min_y, cell.max_x, cell.max_y],
        "z": _heights(cell),
        "source_bytes": cell.source_bytes,
        "loading": list(cell.loading),
        "pinned": list(cell.pinned),
        "failure": cell.failure,
        "segments": [
            {
                "layer": segment.layer,
                "version": f"{segment.version:016x}",
                "segment": segment.segment,
                "state": segment.state,
                "bytes": segment.bytes,
                "points": segment.points,
                "holders": [_holder_as_json(holder) for holder in segment.holders],
            }
            for segment in cell.segments
        ],
    }


def _holder_as_json(holder: Holder) -> dict[str, object]:
    return {**holder_row(holder), "user": user_name(holder.uid)}


def _lines(cell: ShownCell) -> list[tuple[str, str]]:
    z = _heights(cell)
    lines = [
        ("cell", cell.id),
        ("version", f"{cell.version:016x}"),
        ("box", extent_text((cell.min_x, cell.min_y, cell.max_x, cell.max_y))),
        ("heights", "known after the first load" if z is None else f"{z[0]:.2f} .. {z[1]:.2f} m"),
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
    state = "retired" if segment.state == "zombie" else segment.state
    rows = rows_text(segment.points, segment.layer)
    return (
        f"{segment.layer}, {state}, {rows}, {format_bytes(segment.bytes)},"
        f" version {segment.version:016x}, {segment.segment}"
    )


def _holder_line(holder: Holder) -> str:
    if not holder.session:
        return "an unidentified process (not through the client library)"
    command = f" ({holder.command})" if holder.command not in ("", holder.client) else ""
    who = f"{holder.client or 'client'}{command}, pid {holder.pid}, user {user_name(holder.uid)}"
    return f"{who}, {format_bytes(holder.bytes)}"
