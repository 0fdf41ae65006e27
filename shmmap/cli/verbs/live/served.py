# SPDX-License-Identifier: Apache-2.0
"""``shmmap live ls``, ``show`` and ``save``: live maps of a running daemon."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING

from shmmap.cli.daemon_address import connect
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.screens.output import (
    Column,
    format_bytes,
    format_duration,
    format_metres,
    print_hanging,
    print_json,
    print_line,
    print_pairs,
    print_table,
)
from shmmap.cli.screens.status_parts import STATE_STYLES

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.protocol.live import LiveMapRow

_LS_EXIT = """\
Exit code: 0, or 69 when no daemon answers."""

_MAP_COLUMNS = (
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


def add_ls(subparsers: Subparsers) -> None:
    """Add the action ``ls``."""
    parser = add_verb(
        subparsers,
        "ls",
        _run_ls,
        help="the live maps, and how they are",
        description="List the live maps that a daemon keeps.\n"
        "VOXEL: edge, metres.  CHUNKS: in memory; UNSAVED: of these changed since they were saved.\n"
        "KNOWN: voxels that are occupied or free.  MEMORY OF: what the chunks take of what they may.\n"
        "FILES, ON DISK: chunks that are saved.  SCANS: applied since the daemon's start.",
        output="live.outputs.LiveMaps",
        epilog=_LS_EXIT,
    )
    add_daemon_options(parser)


def _run_ls(args: argparse.Namespace) -> int:
    """Print the table of live maps."""
    with connect(args) as client:
        maps = client.live_maps()
    if args.json:
        from shmmap.cli.json_output import LiveMap
        from shmmap.cli.verbs.live import outputs

        print_json(outputs.LiveMaps(list(map(LiveMap.of, maps))))
        return 0
    if not maps:
        print_line("this daemon keeps no live maps: start it with --live NAME")
        return 0
    print_table(_MAP_COLUMNS, [_map_row(row) for row in maps])
    for row in maps:
        for text in _problems_of(row):
            print_hanging(f"{row.name}: ", text)
    return 0


def _problems_of(row: LiveMapRow) -> list[str]:
    """Return the problems of a live map, one line each."""
    found = [row.problem] if row.problem else []
    return [*found, *row.damaged]


def _map_row(row: LiveMapRow) -> list[str]:
    return [
        row.name,
        f"{row.resolution:g}",
        f"{row.chunks:,}",
        f"{row.unsaved:,}",
        f"{row.active:,}",
        format_bytes(row.bytes + row.beside_bytes),
        format_bytes(row.budget_bytes),
        f"{row.files:,}",
        format_bytes(row.file_bytes),
        f"{row.scans:,}",
    ]


_SHOW_EXIT = """\
Exit code: 0, 2 when there is no such map, or 69 when no daemon answers."""

_CHUNK_COLUMNS = (
    Column("CHUNK"),
    Column("X", "right", spare=2),
    Column("Y", "right", spare=2),
    Column("Z", "right", spare=2),
    Column("STATE", looks=STATE_STYLES),
    Column("KNOWN", "right"),
    Column("OCCUPIED", "right", spare=1),
    Column("FREE", "right", spare=1),
    Column("BYTES", "right"),
    Column("CHANGES", "right", spare=4),
)


def add_show(subparsers: Subparsers) -> None:
    """Add the action ``show``."""
    parser = add_verb(
        subparsers,
        "show",
        _run_show,
        help="one live map, chunk by chunk",
        description="Show a live map and its chunks, cubes of 64 voxels a side.\n"
        "STATE: loading; clean; dirty when it was changed since it was saved; saving; saved when it is on "
        "the disk alone.\n"
        "X, Y, Z: lower corner, metres, map frame.  CHANGES: how many scans changed it.",
        output="live.outputs.ShownMap",
        epilog=_SHOW_EXIT,
    )
    parser.add_argument("name", metavar="NAME", help="the live map")
    parser.add_argument("--saved", action="store_true", help="chunks that are on the disk alone, too")
    add_daemon_options(parser)


def _run_show(args: argparse.Namespace) -> int:
    """Print a live map and its chunks."""
    with connect(args) as client:
        live = client.live(args.name)
        row, chunks = live.status(), live.chunks(saved=args.saved)
    if args.json:
        from shmmap.cli.json_output import LiveMap
        from shmmap.cli.verbs.live import outputs

        print_json(
            outputs.ShownMap(LiveMap.of(row), [outputs.Chunk.of(one, row.resolution) for one in chunks])
        )
        return 0
    print_pairs(_pairs(row))
    if chunks:
        print_line()
        print_table(_CHUNK_COLUMNS, [_chunk_row(one, row.resolution) for one in chunks])
    for text in _problems_of(row):
        print_hanging("problem: ", text)
    return 0


def _pairs(row: LiveMapRow) -> list[tuple[str, str]]:
    memory = f"{format_bytes(row.bytes)} of {format_bytes(row.budget_bytes)}"
    waiting = f"; {format_bytes(row.waiting_bytes)} of scans wait" if row.waiting_bytes else ""
    beside = f", {format_bytes(row.beside_bytes)} beside them" if row.beside_bytes else ""
    return [
        ("map", f"{row.name}, voxels of {row.resolution:g} m in frame {row.frame_id}"),
        ("memory", f"{memory} in {row.chunks:,} chunks ({row.unsaved:,} unsaved){beside}"),
        ("known", f"{row.active:,} voxels in memory"),
        ("disk", f"{format_bytes(row.file_bytes)} in {row.files:,} files in {row.path}"),
        ("scans", f"{row.scans:,} applied since the start, {row.durable:,} of them on the disk{waiting}"),
        ("mappers", ", ".join(row.mappers) or "none yet"),
    ]


def _chunk_row(chunk: ChunkInfo, resolution: float) -> list[str]:
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


_SAVE_EXIT = """\
Exit code: 0, 1 when this user may not, 2 when there is no such map, 69 when no daemon answers in time."""


def add_save(subparsers: Subparsers) -> None:
    """Add the action ``save``."""
    parser = add_verb(
        subparsers,
        "save",
        _run_save,
        help="write a live map to the disk now",
        description="Save all changed chunks of a live map to the disk; ends when everything that "
        "was applied before is there.",
        output="live.outputs.Saved",
        epilog=_SAVE_EXIT,
    )
    parser.add_argument("name", metavar="NAME", help="the live map")
    add_daemon_options(parser)


def _run_save(args: argparse.Namespace) -> int:
    """Request a save, and wait for it."""
    begin_s = time.monotonic()
    with connect(args) as client:
        files = client.live(args.name).save()
    took_s = time.monotonic() - begin_s
    if args.json:
        from shmmap.cli.verbs.live import outputs

        print_json(outputs.Saved(args.name, files, round(took_s, 3)))
    else:
        print_line(f"{args.name}: saved, {files:,} chunks on the disk ({format_duration(took_s)})")
    return 0
