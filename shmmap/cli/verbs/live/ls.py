# SPDX-License-Identifier: Apache-2.0
"""``shmmap live ls``: the live maps of a daemon, and how they are."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.live_maps import live_as_json
from shmmap.cli.screens.output import Column, format_bytes, print_hanging, print_json, print_line, print_table

if TYPE_CHECKING:
    from shmmap.protocol.live import LiveMapRow

__all__ = ["add_parser", "problems_of", "run"]

_JSON = """\
  {"maps": [{"name", "path", "resolution": metres, "frame_id", "chunks": in memory, "active": known voxels
             in them, "bytes": their memory, "budget_bytes", "loading", "dirty": changed and not saved,
             "saving", "beside_bytes": of lists of voxels and marks,
             "readers": [[session, thousandths of a processor]], the busiest,
             "waiting_bytes": of scans that wait, "files", "file_bytes", "scans": applied since the start,
             "durable": of these on the disk, "mappers": [uid/name], "damaged": [what], "problem",
             "change": number of the last change}]}
Exit code: 0, or 69 when no daemon answers."""

_COLUMNS = (
    Column("MAP"),
    Column("VOXEL", "right", spare=4),
    Column("CHUNKS", "right"),
    Column("UNSAVED", "right", spare=1),
    Column("KNOWN", "right", spare=2),
    Column("MEMORY", "right"),
    Column("OF", "right", spare=3),
    Column("FILES", "right", spare=5),
    Column("ON DISK", "right", spare=6),
    Column("SCANS", "right"),
)


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "ls",
        run,
        help="the live maps, and how they are",
        description="List the live maps that a daemon keeps.\n"
        "VOXEL: edge, metres.  CHUNKS: in memory; UNSAVED: of these changed since they were saved.\n"
        "KNOWN: voxels that are occupied or free.  MEMORY OF: what the chunks take of what they may.\n"
        "FILES, ON DISK: chunks that are saved.  SCANS: applied since the daemon's start.",
        json=_JSON,
    )
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        maps = client.live_maps()
    if args.json:
        print_json({"maps": [live_as_json(row) for row in maps]})
        return 0
    if not maps:
        print_line("this daemon keeps no live maps: start it with --live NAME")
        return 0
    print_table(_COLUMNS, [_as_text(row) for row in maps])
    for row in maps:
        for text in problems_of(row):
            print_hanging(f"{row.name}: ", text)
    return 0


def problems_of(row: LiveMapRow) -> list[str]:
    """What is wrong with a live map, a line each."""
    found = [row.problem] if row.problem else []
    return [*found, *row.damaged]


def _as_text(row: LiveMapRow) -> list[str]:
    return [
        row.name,
        f"{row.resolution:g}",
        f"{row.chunks:,}",
        f"{row.dirty + row.saving:,}",
        f"{row.active:,}",
        format_bytes(row.bytes + row.beside_bytes),
        format_bytes(row.budget_bytes),
        f"{row.files:,}",
        format_bytes(row.file_bytes),
        f"{row.scans:,}",
    ]
