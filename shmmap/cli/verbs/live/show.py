# SPDX-License-Identifier: Apache-2.0
"""``shmmap live show``: the chunks of a live map."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_metres,
    print_hanging,
    print_json,
    print_line,
    print_pairs,
    print_table,
)
from shmmap.cli.verbs.live.ls import problems_of

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.protocol.live import LiveMapRow

__all__ = ["add_parser", "run"]

_JSON = """\
  {"map": as in `shmmap live ls`,
   "chunks": [{"key": [x, y, z], "state", "active", "occupied", "free", "bytes", "version", "generation",
               "box": [min_x, min_y, min_z, max_x, max_y, max_z] in metres}]}
Exit code: 0, 2 when there is no such map, or 69 when no daemon answers."""

_COLOURS = {
    "clean": "green",
    "dirty": "blue",
    "saving": "cyan",
    "loading": "bright_black",
    "saved": "dim",
}
"""Rolling-Bonxai's colours: clean green, dirty blue, not there yet dark."""
_COLUMNS = (
    Column("CHUNK"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("Z", "right", spare=2),
    Column("STATE", looks=_COLOURS),
    Column("KNOWN", "right"),
    Column("OCCUPIED", "right", spare=1),
    Column("FREE", "right", spare=1),
    Column("BYTES", "right"),
    Column("CHANGES", "right", spare=4),
)


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "show",
        run,
        help="one live map, chunk by chunk",
        description="Show a live map and its chunks, cubes of 64 voxels a side.\n"
        "STATE: loading; clean; dirty when it was changed since it was saved; saving; saved when it is on "
        "the disk alone.\n"
        "X, Y, Z: lower corner, metres, map frame.  CHANGES: how many scans changed it.",
        json=_JSON,
    )
    parser.add_argument("name", metavar="NAME", help="the live map")
    parser.add_argument("--saved", action="store_true", help="chunks that are on the disk alone, too")
    add_daemon_options(parser)


def run(args: argparse.Namespace) -> int:
    """Print it."""
    from shmmap.cli.daemon_address import connect

    with connect(args) as client:
        live = client.live(args.name)
        row, chunks = live.status(), live.chunks(saved=args.saved)
    if args.json:
        import msgspec

        print_json(
            {"map": msgspec.structs.asdict(row), "chunks": [_as_json(one, row.resolution) for one in chunks]}
        )
        return 0
    print_pairs(_pairs(row))
    if chunks:
        print_line()
        print_table(_COLUMNS, [_as_text(one, row.resolution) for one in chunks])
    for text in problems_of(row):
        print_hanging("problem: ", text)
    return 0


def _pairs(row: LiveMapRow) -> list[tuple[str, str]]:
    unsaved = row.dirty + row.saving
    memory = f"{format_bytes(row.bytes)} of {format_bytes(row.budget_bytes)}"
    waiting = f"; {format_bytes(row.waiting_bytes)} of scans wait" if row.waiting_bytes else ""
    beside = f", {format_bytes(row.beside_bytes)} beside them" if row.beside_bytes else ""
    return [
        ("map", f"{row.name}, voxels of {row.resolution:g} m in frame {row.frame_id}"),
        ("memory", f"{memory} in {row.chunks:,} chunks ({unsaved:,} unsaved){beside}"),
        ("known", f"{row.active:,} voxels in memory"),
        ("disk", f"{format_bytes(row.file_bytes)} in {row.files:,} files in {row.path}"),
        ("scans", f"{row.scans:,} applied since the start, {row.durable:,} of them on the disk{waiting}"),
        ("mappers", ", ".join(row.mappers) or "none yet"),
    ]


def _as_json(chunk: ChunkInfo, resolution: float) -> dict[str, object]:
    import msgspec

    return {**msgspec.structs.asdict(chunk), "box": list(chunk.key.box(resolution))}


def _as_text(chunk: ChunkInfo, resolution: float) -> list[str]:
    x, y, z, *_ = chunk.key.box(resolution)
    return [
        chunk.key.text,
        *(format_metres(value) for value in (x, y, z)),
        chunk.state,
        f"{chunk.active:,}",
        f"{chunk.occupied:,}",
        f"{chunk.free:,}",
        format_bytes(chunk.bytes),
        f"{chunk.version:,}",
    ]
