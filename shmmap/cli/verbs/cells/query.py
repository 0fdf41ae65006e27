# SPDX-License-Identifier: Apache-2.0
"""``shmmap query``: request cells as a client does, and print the answer."""

from __future__ import annotations

import argparse
import contextlib
import re
from typing import TYPE_CHECKING

from shmmap.cli.areas import add_area_or_ids, area_from, no_cell_there, print_near_cells
from shmmap.cli.compiling_lines import saying_what_the_daemon_does
from shmmap.cli.daemon_address import connect, snapshot
from shmmap.cli.options import (
    Subparsers,
    add_daemon_options,
    add_layer_option,
    add_verb,
    layers_from,
    seconds,
)
from shmmap.cli.program import add_allow_empty, complain, nothing_found
from shmmap.cli.screens.output import (
    Column,
    counted,
    format_bytes,
    format_metres,
    print_hanging,
    print_json,
    print_line,
    print_table,
    rows_text,
)
from shmmap.errors import BadRequest, ShmmapError
from shmmap.lacking import (
    PREPARE_HINT,
    empty_layers,
    failure_lines,
    near_cells_hint,
    not_covered,
    pending_lines,
    unknown_ids,
)

if TYPE_CHECKING:
    from shmmap.client.cell_set import CellSet
    from shmmap.client.client import Client
    from shmmap.geometry import Area

_EXIT = """\
Codes of failures: unknown_cell, load_failed, load_timeout, over_budget, no_space, offline.
Exit code: 0; 1 when a cell is pending, failed or unknown, when the daemon does not know yet all that lies in
the area, when the area touches no cell, or when a layer is empty in every cell.
With --held, 0 when nothing is new."""


_COLUMNS = (
    Column("CELL"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("LAYER", spare=1),
    Column("ROWS", "right"),
    Column("MEMORY", "right"),
    Column("VERSION", spare=4),
    Column("SEGMENT", spare=5),
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``query``."""
    parser = add_verb(
        subparsers,
        "query",
        run,
        help="what a client would get for an area or for ids",
        description="Ask the daemon for cells, as a client does: it loads those that are not in "
        "memory.  Prints "
        "where each of them lies in shared memory.\n"
        "ROWS: points, or what a layer has instead, such as voxels.",
        output="cells.outputs.Found",
        epilog=_EXIT,
    )
    add_area_or_ids(parser)
    add_layer_option(parser, "what to have of each cell (default: points)")
    parser.add_argument(
        "--held",
        metavar="ID[@VERSION]",
        nargs="+",
        action="extend",
        help="print only what changes for a client that has these cells; a cell without @VERSION counts as "
        "current",
    )
    parser.add_argument(
        "--wait",
        metavar="SECONDS|none",
        type=lambda text: None if text == "none" else seconds(text),
        default=10.0,
        help="how long to wait for cells that have to be loaded; none: do not wait: print what is in memory, "
        "the rest is loaded in the background (default: 10)",
    )
    add_allow_empty(parser)
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Request cells and print the answer."""
    area = area_from(args)
    held_given = args.held is not None
    held = [held_cell(text) for text in args.held or ()]
    if held and area is None:
        raise BadRequest("--held needs an area", hint="add --circle, --square or --box")
    layers = layers_from(args)
    with connect(args) as client:
        with saying_what_the_daemon_does(client):
            if area is None:
                found = client.selected(args.id, layers, wait=args.wait, strict=None)
            elif held_given:
                found = client.differential(area, held, layers, wait=args.wait, strict=None)
            else:
                found = client.area(area, layers, wait=args.wait, strict=None)
        welcome = client.welcome
        if args.json:
            from shmmap.cli.verbs.cells import outputs

            print_json(outputs.Found.of(found, welcome.frame_id))
        else:
            _print_text(found, welcome.id_prefix, summed=bool(found.cells) or held_given)
        if not found.complete:
            if not found.covered:
                complain("shmmap", *not_covered(found))
            if found.pending and args.wait is not None:
                complain("shmmap", *_still_pending(args, found))
            print_near_cells(near_cells_hint(client, unknown_ids(found.failed)))
            return 1
        return _judge_empty(args, client, area, found)


def _still_pending(args: argparse.Namespace, found: CellSet) -> tuple[str, str]:
    """Return why layers are pending after the wait, as far as the statistics show it, and what to do."""
    layers = counted(len(found.pending), "layer")
    what = (
        f"{layers} of cells {'is' if len(found.pending) == 1 else 'are'} still pending after {args.wait:g} s"
    )
    with contextlib.suppress(ShmmapError):
        counts = snapshot(args)[0].counters
        queued, loaders = counts.get("load_queue", 0), counted(counts.get("workers", 0), "loader")
        if counts.get("origin_out", 0):
            return f"{what}: the map's files are out of reach", "shmmap doctor"
        if queued:
            what += f": {counted(queued, 'load')} waiting for {loaders}"
        elif counts.get("loaders_compiling", 0):
            what += ": the daemon compiles kernels, once for this version"
        else:
            what += f": {loaders} at work"
    hint = "ask again, or wait longer: --wait SECONDS; `shmmap top` shows loads"
    return what, f"{hint}; {PREPARE_HINT}" if any(one.layer != "points" for one in found.pending) else hint


def _judge_empty(args: argparse.Namespace, client: Client, area: Area | None, found: CellSet) -> int:
    """Return the exit code of a complete answer; report if it has no cells."""
    if found.cells:
        if args.held is None and (empty := empty_layers(found)):
            return nothing_found(args, empty)
    elif area is not None and (args.held is None or not len(client.metadata(area))):
        return no_cell_there(args, client, area)
    return 0


def held_cell(text: str) -> str | tuple[str, int]:
    """Parse ``ID`` or ``ID@VERSION``, split at the last @; the version is 1 to 16 hex digits."""
    cell_id, at, version = text.rpartition("@")
    if not at or "/" in version or "." in version:
        return text  # the @ is part of the id
    if not cell_id or not re.fullmatch("[0-9a-fA-F]{1,16}", version):
        raise BadRequest(
            f"--held: {text!r} is not ID@VERSION",
            hint="a version is up to 16 hex digits, as `query` prints it",
        )
    return cell_id, int(version, 16)


def _print_text(found: CellSet, id_prefix: str, *, summed: bool) -> None:
    if found.cells:
        print_table(
            _COLUMNS,
            [
                [
                    cell.id.removeprefix(id_prefix),
                    format_metres(cell.box[0]),
                    format_metres(cell.box[1]),
                    cell.layer,
                    f"{cell.points:,}",
                    format_bytes(cell.nbytes),
                    cell.version_hex + (" stale" if cell.stale else ""),
                    cell.segment,
                ]
                for cell in found.cells
            ],
        )
    for cell_id in found.removed:
        print_line(f"removed: {cell_id}")
    for line in pending_lines(found.pending):
        print_line(line)
    for line in failure_lines(found.failed):
        indent = len(line) - len(line.lstrip())
        print_hanging(line[:indent], line[indent:])
    if not summed:
        return
    rows, nbytes = (sum(getattr(cell, name) for cell in found.cells) for name in ("points", "nbytes"))
    other = next((cell.layer for cell in found.cells if cell.layer != "points"), "points")
    cells = counted(len({cell.id for cell in found.cells}), "cell")
    print_line(f"{cells}, {rows_text(rows, other)}, {format_bytes(nbytes)}")
