# SPDX-License-Identifier: Apache-2.0
"""``shmmap map``: the map from above, its cells in memory, and the clients' positions."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from shmmap.cli.areas import add_area_options, area_from, around, those_in
from shmmap.cli.daemon_address import connect, snapshot
from shmmap.cli.options import Subparsers, add_daemon_options, add_verb
from shmmap.cli.program import add_allow_empty, nothing_found, write_text
from shmmap.cli.screens.output import counted, format_bytes, print_hanging, print_line, wants_style
from shmmap.cli.screens.status_parts import published_words
from shmmap.doctor.verdicts import outage_so_far
from shmmap.errors import DaemonUnreachable
from shmmap.lacking import area_text, extent_text

if TYPE_CHECKING:
    from shmmap.cli.areas import BoxTuple
    from shmmap.cli.screens.map_scene import Scene
    from shmmap.geometry import Area
    from shmmap.protocol.rows import CellRow
    from shmmap.statistics.reader import Snapshot

__all__ = ["add_parser", "run"]

MAX_ON_DISK: Final = 50_000
"""With more cells on disk than this, a picture shows only those in memory."""


class OnDisk(NamedTuple):
    """The daemon's description of the drawn part of the map.

    Attributes
    ----------
    cells
        Names and boxes of the cells; empty if there are more than `MAX_ON_DISK`.
    total
        Number of cells; for an area with too many only a larger number than `MAX_ON_DISK`; None if unknown.
    everywhere
        Bounds of the whole map; None if it has no cells, or the daemon did not say.
    """

    cells: list[tuple[str, BoxTuple]]
    total: int | None
    everywhere: BoxTuple | None


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb ``map``."""
    parser = add_verb(
        subparsers,
        "map",
        run,
        help="the map from above: which cells are in memory, where the clients are",
        description="Draw the map from above, north up: its cells by state, the clients, and the areas they "
        "follow.  On the terminal, or into a file with a tooltip for each cell.  While the daemon does not "
        "answer, only cells in memory are drawn.  With --live the chunks of a live map instead of cells; of "
        "chunks above one another the one that has most to do is seen.",
        epilog="Exit code: 0; 1 when an area touches no cell, 69 when the daemon is dead or was "
        "never started,\n"
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
    if args.live is not None:
        what, silent = "chunk", False
        scene, everywhere = _live_scene(args, area, found)
    else:
        what = "cell"
        disk = _on_disk(args, area, found, identity.id_prefix)
        silent = disk.total is None
        boxes = [row.box for row in found.cells]
        everywhere = around(boxes if disk.everywhere is None else [disk.everywhere, *boxes])
        title = f"{identity.map_path} ({identity.instance})"
        scene = _scene(area, found, disk, everywhere, title)
    for path, make in ((args.svg, svg), (args.html, html_page)):
        if path is not None:
            write_text(path, make(scene))
            print_line(f"wrote {path}")
    missing = ""
    if area is not None and scene.empty and everywhere is not None:
        spans = f"the {'cells in memory span' if silent else 'map spans'} {extent_text(everywhere)}"
        missing = f"no {what} {area_text(area)}; {spans}"
    if args.svg is None and args.html is None and not missing:
        _print(scene)
    if found.state == "dead":
        return DaemonUnreachable.exit_code
    return nothing_found(args, missing) if missing else 0


def _live_scene(
    args: argparse.Namespace, area: Area | None, found: Snapshot
) -> tuple[Scene, BoxTuple | None]:
    """Request the chunks of a live map; return the scene and the bounds of all chunks."""
    from shmmap.cli.screens.map_scene import Scene, chunk_squares
    from shmmap.geometry import Box

    with connect(args) as client:
        live = client.live(args.live)
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
        bounds=bounds, disk=[], rows=[], clients=found.clients, now_ns=time.monotonic_ns(),
        title=f"live map {live.name}, voxels of {live.resolution:g} m",
        note=f"{counted(len(chunks), 'chunk')}, {len(in_memory):,} of them in memory, {memory}",
        empty=not squares, chunks=squares,
    )  # fmt: skip
    return scene, everywhere


def _scene(
    area: Area | None, found: Snapshot, disk: OnDisk, everywhere: BoxTuple | None, title: str
) -> Scene:
    from shmmap.cli.screens.map_scene import Scene
    from shmmap.geometry import Box

    rows = found.cells
    bounds = everywhere or (0.0, 0.0, 1.0, 1.0)
    if area is not None:
        bounds = area.bounds
        shown = Box(*bounds)  # bounds of everything drawn
        rows = [rows[index] for index in those_in(shown, [row.box for row in rows])]
    return Scene(
        bounds=bounds,
        disk=disk.cells,
        rows=rows,
        clients=found.clients,
        now_ns=time.monotonic_ns(),
        title=title,
        note=_note(area, found, rows, disk),
        empty=not disk.total and not rows,
    )


def _on_disk(args: argparse.Namespace, area: Area | None, found: Snapshot, id_prefix: str) -> OnDisk:
    """Request the cells to draw, unless they are too many or the daemon does not reply."""
    from shmmap.geometry import Box

    nothing = OnDisk([], None, None)
    if found.state in ("dead", "stopped"):
        return nothing
    try:
        with connect(args) as client:
            count, everywhere = client.welcome.cells, client.welcome.bounds
            if area is None and count > MAX_ON_DISK:
                return OnDisk([], count, everywhere)
            listing = client.metadata(Box(*area.bounds) if area is not None else None, most=MAX_ON_DISK)
            if len(listing) > MAX_ON_DISK:
                return OnDisk([], len(listing), everywhere)
            cells = [(cell.id.removeprefix(id_prefix), cell.box) for cell in listing]
            return OnDisk(cells, len(cells), everywhere)
    except DaemonUnreachable:
        return nothing


def _note(area: Area | None, found: Snapshot, rows: list[CellRow], disk: OnDisk) -> str:
    memory = sum(row.bytes for row in rows)
    segments, clients = counted(len(rows), "segment"), counted(len(found.clients), "client")
    ahead = sum(row.ahead for row in rows)
    segments += f" ({ahead:,} of them fetched ahead, not asked for yet)" if ahead else ""
    note = "; ".join(
        (f"{segments} in memory, {format_bytes(memory)}, {clients}", *_published(found.counters))
    )
    if disk.total is None:
        state = "paused" if found.state == "stopped" else found.state
        return f"{note}; the daemon is {state}: cells on disk are not shown"
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
    from shmmap.cli.screens.map_scene import GLYPHS, LIVE_STATES, terminal_rows

    size = shutil.get_terminal_size((100, 40))
    grid = terminal_rows(scene, size.columns, max(size.lines - 6, 10))
    cells = {"resident": "in memory", "fetched": "fetched ahead", "stale": "stale", "zombie": "retired"}
    cells["disk"] = "on disk"
    legend = {**(LIVE_STATES if scene.chunks else cells), "client": "client", "window": "its area"}
    if not wants_style():
        for row in grid:
            print_line("".join(GLYPHS[state][0] for state in row).rstrip())
        print_line("  ".join(f"{GLYPHS[state][0]} {text}" for state, text in legend.items()))
    else:
        from rich.console import Console
        from rich.text import Text

        console = Console(highlight=False)
        solid = {"resident": "█", "fetched": "▓", "stale": "▓", "zombie": "▒", "disk": "·"}
        solid |= {"window": "○", "client": "●", **dict.fromkeys(LIVE_STATES, "█"), "saved": "·"}
        for row in grid:
            console.print(Text.assemble(*((solid.get(state, " "), GLYPHS[state][1]) for state in row)))
        console.print(Text.assemble(*((f"{solid[s]} {text}  ", GLYPHS[s][1]) for s, text in legend.items())))
    print_hanging("", f"{extent_text(scene.bounds)}; {scene.note}")
    sys.stdout.flush()
