# SPDX-License-Identifier: Apache-2.0
"""``shmmap query``: what a client would get."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from shmmap.cli.options import (
    Subparsers,
    add_area_options,
    add_daemon_options,
    add_verb,
    area_from,
    seconds,
)
from shmmap.cli.screens.output import Column, format_bytes, print_json, print_table
from shmmap.errors import BadRequest

if TYPE_CHECKING:
    from shmmap.client.cell_set import CellSet

__all__ = ["add_parser", "held_cell", "run"]

_JSON = """\
  {"epoch": hex, "map_version": hex, "frame_id",
   "cells": [{"id", "version": hex, "layer", "segment", "offset", "bytes", "points", "stale": bool,
              "box": [minx, miny, maxx, maxy] in metres}],
   "removed": [id], "pending": [{"id", "layer"}],
   "failed": [{"id", "layer", "code", "message", "holders": [text]}]}
Codes: unknown_cell, load_failed, load_timeout, over_budget, no_space.
Exit code: 0 when complete, 1 when anything asked for is pending, failed or unknown."""


_COLUMNS = (
    Column("CELL"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("LAYER", spare=3),
    Column("POINTS", "right"),
    Column("MEMORY", "right"),
    Column("VERSION", spare=4),
    Column("SEGMENT", spare=5),
)


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "query",
        run,
        help="what a client would get for an area or for ids",
        description="Ask the daemon for cells, as a client does, and print the handles; this loads them.",
        json=_JSON,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    add_area_options(parser, what)
    what.add_argument("--id", metavar="ID", nargs="+", help="cells by id, or by file name where unique")
    parser.add_argument(
        "--layer", metavar="SPEC", nargs="+", default=["points"], help="layers (default: points)"
    )
    parser.add_argument(
        "--held",
        metavar="ID[@VERSION]",
        nargs="+",
        help="answer only the difference to these cells; without @VERSION, the current one is held",
    )
    parser.add_argument(
        "--wait",
        metavar="SECONDS|none",
        type=lambda text: None if text == "none" else seconds(text),
        default=10.0,
        help="how long the answer may wait for loads; none: answer at once (default: 10)",
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the answer."""
    from shmmap.cli.daemon_address import connect

    area = area_from(args)
    held = [held_cell(text) for text in args.held or ()]
    if held and area is None:
        raise BadRequest("--held needs an area", hint="add --circle, --square or --box")
    with connect(args) as client:
        if area is None:
            found = client.selected(args.id, args.layer, wait=args.wait)
        elif args.held is not None:
            found = client.differential(area, held, args.layer, wait=args.wait)
        else:
            found = client.area(area, args.layer, wait=args.wait)
        welcome = client.welcome
        if args.json:
            print_json(_as_json(found, welcome.frame_id))
        else:
            _print_text(found, welcome.id_prefix)
    return 0 if found.complete else 1


def held_cell(text: str) -> str | tuple[str, int]:
    """Read ``ID`` or ``ID@VERSION``, split at the last @; the version is 1 to 16 hex digits."""
    cell_id, at, version = text.rpartition("@")
    if not at or "/" in version or "." in version:
        return text  # the @ belongs to a name
    if not cell_id or not re.fullmatch("[0-9a-fA-F]{1,16}", version):
        raise BadRequest(
            f"--held: {text!r} is not ID@VERSION",
            hint="a version is up to 16 hex digits, as `query` prints it",
        )
    return cell_id, int(version, 16)


def _as_json(found: CellSet, frame_id: str) -> dict[str, object]:
    return {
        "epoch": f"{found.epoch:016x}",
        "map_version": f"{found.map_version:016x}",
        "frame_id": frame_id,
        "cells": [
            {
                "id": cell.id,
                "version": cell.version_hex,
                "layer": cell.layer,
                "segment": cell.segment,
                "offset": cell.offset,
                "bytes": cell.nbytes,
                "points": cell.points,
                "stale": cell.stale,
                "box": list(cell.box),
            }
            for cell in found.cells
        ],
        "removed": list(found.removed),
        "pending": [{"id": cell.id, "layer": cell.layer} for cell in found.pending],
        "failed": [
            {
                "id": error.cell_id,
                "layer": error.layer,
                "code": error.code,
                "message": error.message,
                "holders": [str(holder) for holder in error.holders],
            }
            for error in found.failed
        ],
    }


def _print_text(found: CellSet, id_prefix: str) -> None:
    if found.cells:
        print_table(
            _COLUMNS,
            [
                [
                    cell.id.removeprefix(id_prefix),
                    f"{cell.box[0]:g}",
                    f"{cell.box[1]:g}",
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
        print(f"removed: {cell_id}")
    for pending in found.pending:
        print(f"pending: {pending.id} ({pending.layer})")
    for error in found.failed:
        print(f"failed: {error.message} [{error.code}]")
        for holder in error.holders:
            print(f"  {holder}")
    points, nbytes = (sum(getattr(cell, name) for cell in found.cells) for name in ("points", "nbytes"))
    print(f"{len(found.cells):,} cells, {points:,} points, {format_bytes(nbytes)}")
