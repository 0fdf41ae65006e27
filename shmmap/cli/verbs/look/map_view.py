# SPDX-License-Identifier: Apache-2.0
"""``shmmap map``: the map from above, its cells in memory, and the clients' positions."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from shmmap.cli.areas import add_area_options, area_from, around, those_in
from shmmap.cli.daemon_address import connect_to, snapshot
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty, nothing_found, write_text
from shmmap.cli.screens.output import (
    can_be_written,
    counted,
    flowing,
    format_bytes,
    print_hanging,
    print_line,
    print_styled,
    wants_style,
)
from shmmap.cli.screens.status_parts import published_words
from shmmap.doctor.verdicts import outage_so_far
from shmmap.lacking import area_text, extent_text

if TYPE_CHECKING:
    from shmmap.cli.areas import BoxTuple
    from shmmap.cli.screens.map_scene import Scene
    from shmmap.cli.screens.picture import Raster
    from shmmap.client.client import Client
    from shmmap.geometry import Area
    from shmmap.protocol.rows import CellRow, ClientRow
    from shmmap.statistics.reader import Snapshot

MAX_ON_DISK: Final = 50_000
"""With more cells on disk than this, a picture shows only those in memory."""

MAX_DRAWN: Final = 5_000
"""With more cells in memory than this, a picture shows no points."""
MAX_POINTS: Final = 4_000_000
"""Points read for a picture; of more, every second, third ... is left out."""


class OnDisk(NamedTuple):
    """The cells of the drawn part of the map.

    Attributes
    ----------
    cells
        Names and boxes of the cells; empty if there are more than `MAX_ON_DISK`.
    total
        Number of cells; for an area with too many only a larger number than `MAX_ON_DISK`.
    """

    cells: list[tuple[str, BoxTuple]]
    total: int


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``map``."""
    parser = add_verb(
        subparsers,
        "map",
        run,
        help="the map from above: cells in memory, and where clients are",
        description="Draw the map from above, north up: its cells by state, the clients, and the areas they "
        "follow.  On the terminal, or into a file, which also shows the points of cells in memory and has a "
        "tooltip for each cell.  With --live the chunks of a live map instead of cells; of chunks above one "
        "another the one that has most to do is seen.",
        epilog="Exit code: 0; 1 when an area touches no cell, 69 when no daemon answers,\n"
        "73 a file cannot be written.",
    )
    parser.add_argument("--svg", metavar="FILE", type=Path, help="write an SVG picture")
    parser.add_argument("--html", metavar="FILE", type=Path, help="write an HTML page, complete in one file")
    parser.add_argument("--live", metavar="NAME", help="draw this live map")
    add_area_options(parser, parser.add_mutually_exclusive_group(), heights=False)
    add_allow_empty(parser)
    add_daemon_options(parser, json=False)


def run(args: argparse.Namespace) -> int:
    """Draw the map."""
    from shmmap.cli.screens.map_scene import html_page, svg

    area = area_from(args)
    found, identity = snapshot(args)
    with connect_to(args, found) as client:
        sessions = client.stats().sessions
        clients = [row for row in sessions if row.session != client.welcome.session]
        if args.live is not None:
            what = "chunk"
            scene, everywhere = _live_scene(client, args.live, area, clients)
        else:
            what = "cell"
            title = f"{identity.map_path or 'no map'} ({identity.instance})"
            scene, everywhere = _scene(client, area, found, clients, title)
            if args.svg is not None or args.html is not None:
                scene = replace(scene, points=_points(client, scene))
    for path, make in ((args.svg, svg), (args.html, html_page)):
        if path is not None:
            write_text(path, make(scene))
            print_line(f"wrote {path}")
    missing = ""
    if area is not None and scene.empty and everywhere is not None:
        missing = f"no {what} {area_text(area)}; the map spans {extent_text(everywhere)}"
    if args.svg is None and args.html is None and not missing:
        _print(scene)
    return nothing_found(args, missing) if missing else 0


def _live_scene(
    client: Client, name: str, area: Area | None, clients: list[ClientRow]
) -> tuple[Scene, BoxTuple | None]:
    """Request the chunks of a live map; return the scene and the bounds of all chunks."""
    from shmmap.cli.screens.map_scene import Scene, chunk_squares
    from shmmap.geometry import Box

    live = client.live(name)
    chunks = live.chunks(saved=True)
    squares = chunk_squares(chunks, live.resolution)
    everywhere = around([square.box for square in squares])
    bounds = everywhere or (0.0, 0.0, 1.0, 1.0)
    if area is not None:
        bounds = area.bounds
        squares = [squares[index] for index in those_in(Box(*bounds), [square.box for square in squares])]
    in_memory = [chunk for chunk in chunks if chunk.state != "saved"]
    memory = format_bytes(sum(chunk.bytes for chunk in in_memory))
    scene = Scene(
        bounds=bounds,
        disk=[],
        rows=[],
        clients=clients,
        now_ns=time.monotonic_ns(),
        title=f"live map {live.name}, voxels of {live.resolution:g} m",
        note=f"{counted(len(chunks), 'chunk')}, {len(in_memory):,} of them in memory, {memory}",
        empty=not squares,
        chunks=squares,
    )
    return scene, everywhere


def _points(client: Client, scene: Scene) -> Raster | None:
    """Draw the points of cells in memory; none is loaded, and few are read where there are many."""
    from shmmap.cli.screens.picture import WIDTH_PX, Raster
    from shmmap.geometry import Box
    from shmmap.viewing.page import backdrop
    from shmmap.viewing.sources import served_points

    rows = [row for row in scene.rows if row.layer == "points" and row.state == "resident"]
    if not rows or len(rows) > MAX_DRAWN:
        return None
    every = -(-sum(row.points for row in rows) // MAX_POINTS)
    source = served_points(client, "points", 0.0, ids=[row.id for row in rows])
    blocks = (points.thinned(every) for points in source.blocks(Box(*scene.bounds), ""))
    png = backdrop(blocks, scene.bounds, int(WIDTH_PX))
    return None if png is None else Raster(scene.bounds, png)


def _scene(
    client: Client, area: Area | None, found: Snapshot, clients: list[ClientRow], title: str
) -> tuple[Scene, BoxTuple | None]:
    """Request what is in memory and the map's cells; return the scene and the bounds of all cells."""
    from shmmap.cli.screens.map_scene import Scene
    from shmmap.geometry import Box

    rows, disk, whole = client.list_cells(), _on_disk(client, area), client.bounds
    boxes = [row.box for row in rows]
    everywhere = around(boxes if whole is None else [whole, *boxes])
    bounds = everywhere or (0.0, 0.0, 1.0, 1.0)
    if area is not None:
        bounds = area.bounds
        rows = [rows[index] for index in those_in(Box(*bounds), boxes)]  # bounds of everything drawn
    scene = Scene(
        bounds=bounds,
        disk=disk.cells,
        rows=rows,
        clients=clients,
        now_ns=time.monotonic_ns(),
        title=title,
        note=_note(area, found, rows, clients, disk),
        empty=not disk.total and not rows,
    )
    return scene, everywhere


def _on_disk(client: Client, area: Area | None) -> OnDisk:
    """Request the cells to draw, unless they are too many."""
    from shmmap.geometry import Box

    count = client.welcome.cells
    if area is None and count > MAX_ON_DISK:
        return OnDisk([], count)
    listing = client.metadata(Box(*area.bounds) if area is not None else None, most=MAX_ON_DISK)
    if len(listing) > MAX_ON_DISK:
        return OnDisk([], len(listing))
    cells = [(cell.id.removeprefix(client.welcome.id_prefix), cell.box) for cell in listing]
    return OnDisk(cells, len(cells))


def _note(
    area: Area | None, found: Snapshot, rows: list[CellRow], clients: list[ClientRow], disk: OnDisk
) -> str:
    memory = sum(row.bytes for row in rows)
    segments = counted(len(rows), "segment")
    ahead = sum(row.ahead for row in rows)
    segments += f" ({ahead:,} of them fetched ahead, not asked for yet)" if ahead else ""
    texts = f"{segments} in memory, {format_bytes(memory)}, {counted(len(clients), 'client')}"
    note = "; ".join((texts, *_published(found.counters)))
    if disk.total <= MAX_ON_DISK:
        return f"{note}, {counted(disk.total, 'cell')} in the map"
    count = f"more than {MAX_ON_DISK:,}" if area is not None else f"{disk.total:,}"
    return f"{note}, {count} cells in the map (too many to show those on disk)"


def _published(counters: dict[str, int]) -> list[str]:
    """Return texts about a published map, and for how long its store has been out of reach."""
    texts = [text for text, _trouble in published_words(counters)]
    if texts and counters.get("origin_out", 0):
        texts.append(f"its store is out of reach for {outage_so_far(counters)}")
    return texts


def _print(scene: Scene) -> None:
    from shmmap.cli.screens.map_scene import GLYPHS, LIVE_STATES, glyph, terminal_map

    size, solid = shutil.get_terminal_size((100, 40)), wants_style() and can_be_written("█")
    cells = {"resident": "in memory", "ahead": "fetched ahead", "stale": "stale", "retired": "retired"}
    cells["disk"] = "on disk"
    names = {**(LIVE_STATES if scene.chunks else cells), "client": "client", "window": "its area"}
    texts = {state: f"{glyph(state, solid=solid)} {text}" for state, text in names.items()}
    gap = 2 if len("  ".join(texts.values())) <= size.columns else 1
    legend = flowing([[(text, GLYPHS[state][1])] for state, text in texts.items()], size.columns, gap=gap)
    for line in terminal_map(scene, size.columns, max(size.lines - 4 - len(legend), 10), solid=solid):
        print_styled(line)
    for line in legend:
        print_styled(line)
    print_hanging("", f"{extent_text(scene.bounds)}; {scene.note}")
    sys.stdout.flush()
