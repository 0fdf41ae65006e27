# SPDX-License-Identifier: Apache-2.0
"""``shmmap map``: the map from above, what of it is in memory, and who is where."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from shmmap.cli.options import Subparsers, add_area_options, add_daemon_options, add_verb, area_from
from shmmap.cli.screens.output import format_bytes, wants_style
from shmmap.errors import DaemonUnreachable

if TYPE_CHECKING:
    from shmmap.cli.screens.map_scene import BoxTuple, Scene
    from shmmap.geometry import Area
    from shmmap.statistics.cell_rows import CellRow
    from shmmap.statistics.reader import Snapshot

__all__ = ["add_parser", "run"]

MOST_ON_DISK: Final = 50_000
"""More cells than this are left out of a picture where they are not in memory."""


def add_parser(subparsers: Subparsers) -> None:
    """Describe the verb."""
    parser = add_verb(
        subparsers,
        "map",
        run,
        help="the map from above: what is in memory, who is where",
        description="Draw the map's cells by state, clients and the areas they follow: on the terminal, or "
        "into a file with tooltips.  While the daemon does not answer, only what is in memory is drawn.",
        epilog="Exit code: 0, 69 when the daemon is dead or was never started, 73 a file cannot be written.",
    )
    parser.add_argument("--svg", metavar="FILE", type=Path, help="write a picture")
    parser.add_argument("--html", metavar="FILE", type=Path, help="write a page that needs nothing else")
    add_area_options(parser, parser.add_mutually_exclusive_group())
    add_daemon_options(parser, json=False)


def run(args: argparse.Namespace) -> int:
    """Draw."""
    from shmmap.cli.daemon_address import snapshot
    from shmmap.cli.files import write_text
    from shmmap.cli.screens.map_scene import html_page, svg

    found, identity = snapshot(args)
    scene = _scene(args, found, f"{identity.map_path} ({identity.instance})", identity.id_prefix)
    for path, make in ((args.svg, svg), (args.html, html_page)):
        if path is not None:
            write_text(path, make(scene))
            print(f"wrote {path}")
    if args.svg is None and args.html is None:
        _print(scene)
    return DaemonUnreachable.exit_code if found.state == "dead" else 0


def _scene(args: argparse.Namespace, found: Snapshot, title: str, id_prefix: str) -> Scene:
    from shmmap.cli.screens.map_scene import Scene

    area = area_from(args)
    rows = found.cells
    disk, silent = _on_disk(args, found, id_prefix)
    if area is not None:
        bounds = _bounds(area)
        rows = [row for row in rows if _touches(row.box, bounds)]
        disk = [(name, box) for name, box in disk if _touches(box, bounds)]
    else:
        bounds = _around([box for _, box in disk] + [row.box for row in rows])
    left_out = len(disk) > MOST_ON_DISK
    return Scene(
        bounds=bounds,
        disk=[] if left_out else disk,
        rows=rows,
        clients=found.clients,
        now_ns=time.monotonic_ns(),
        title=title,
        note=_note(found, rows, len(disk), left_out=left_out, silent=silent),
    )


def _on_disk(
    args: argparse.Namespace, found: Snapshot, id_prefix: str
) -> tuple[list[tuple[str, BoxTuple]], bool]:
    """All cells of the map, if the daemon tells; and whether it does not."""
    from shmmap.cli.daemon_address import connect

    if found.state in ("dead", "stopped"):
        return [], True
    try:
        with connect(args) as client:
            return [(cell.id.removeprefix(id_prefix), cell.box) for cell in client.metadata()], False
    except DaemonUnreachable:
        return [], True


def _note(found: Snapshot, rows: list[CellRow], cells: int, *, left_out: bool, silent: bool) -> str:
    memory = sum(row.bytes for row in rows)
    note = f"{len(rows):,} segments in memory, {format_bytes(memory)}, {len(found.clients):,} clients"
    if silent:
        return f"{note}; the daemon is {found.state}: cells on disk are not shown"
    return f"{note}, {cells:,} cells in the map" + (" (too many to show those on disk)" if left_out else "")


def _bounds(area: Area) -> BoxTuple:
    from shmmap.geometry import Box

    if isinstance(area, Box):
        return (area.min_x, area.min_y, area.max_x, area.max_y)
    return (area.x - area.radius, area.y - area.radius, area.x + area.radius, area.y + area.radius)


def _touches(box: BoxTuple, bounds: BoxTuple) -> bool:
    return box[0] <= bounds[2] and box[2] >= bounds[0] and box[1] <= bounds[3] and box[3] >= bounds[1]


def _around(boxes: list[BoxTuple]) -> BoxTuple:
    if not boxes:
        return (0.0, 0.0, 1.0, 1.0)
    return (
        min(box[0] for box in boxes),
        min(box[1] for box in boxes),
        max(box[2] for box in boxes),
        max(box[3] for box in boxes),
    )


def _print(scene: Scene) -> None:
    from shmmap.cli.screens.map_scene import GLYPHS, terminal_rows

    size = shutil.get_terminal_size((100, 40))
    grid = terminal_rows(scene, size.columns, max(size.lines - 6, 10))
    legend = {
        "resident": "in memory",
        "stale": "stale",
        "zombie": "zombie",
        "disk": "on disk",
        "client": "client",
        "window": "its area",
    }
    if not wants_style():
        for row in grid:
            print("".join(GLYPHS[state][0] for state in row).rstrip())
        print("  ".join(f"{GLYPHS[state][0]} {text}" for state, text in legend.items()))
    else:
        from rich.console import Console
        from rich.text import Text

        console = Console(highlight=False)
        solid = {"resident": "█", "stale": "▓", "zombie": "▒", "disk": "·", "window": "○", "client": "●"}
        for row in grid:
            console.print(Text.assemble(*((solid.get(state, " "), GLYPHS[state][1]) for state in row)))
        console.print(Text.assemble(*((f"{solid[s]} {text}  ", GLYPHS[s][1]) for s, text in legend.items())))
    min_x, min_y, max_x, max_y = scene.bounds
    print(f"x {min_x:g} to {max_x:g} m, y {min_y:g} to {max_y:g} m; {scene.note}")
    sys.stdout.flush()
