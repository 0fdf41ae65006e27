# SPDX-License-Identifier: Apache-2.0
"""The map from above, with cells or with chunks of a live map: for a terminal, as SVG, or as HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import counted, format_bytes, format_duration, format_metres
from shmmap.cli.screens.picture import CellSquare, Vehicle, top_view_svg
from shmmap.formats.svg import BoxTuple, escape

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.protocol.rows import CellRow, ClientRow

__all__ = ["GLYPHS", "LIVE_STATES", "Scene", "chunk_squares", "html_page", "svg", "terminal_rows"]


GLYPHS: Final = {
    # state: glyph, style on a terminal
    "resident": ("#", "green"),
    "fetched": ("+", "cyan"),
    "stale": ("s", "yellow"),
    "zombie": ("r", "magenta"),
    "disk": (".", "bright_black"),
    "saved": (".", "bright_black"),
    "clean": ("#", "green"),
    "loading": ("l", "bright_black"),
    "saving": ("w", "cyan"),
    "dirty": ("d", "blue"),
    "window": ("o", "red"),
    "client": ("@", "bold red"),
    "none": (" ", ""),
}

_ORDER: Final = ("zombie", "stale", "fetched", "resident")  # the last state in this order is drawn

_OUTLINE_POINTS: Final = 180
CHARACTER_ASPECT: Final = 2.0  # a character is about twice as high as it is wide


@dataclass(frozen=True)
class Scene:
    """Everything that a picture shows.

    Attributes
    ----------
    bounds
        The area shown, metres, map frame.
    disk
        Boxes of all cells of the map, resident or not.
    rows
        Segments in memory.
    clients
        Connected clients.
    now_ns
        CLOCK_MONOTONIC of ``rows`` and ``clients``.
    title, note
        The two lines of text.
    empty
        Whether the map has nothing to draw, not even on disk.
    chunks
        Columns of chunks of a live map, drawn instead of cells.
    """

    bounds: BoxTuple
    disk: Sequence[tuple[str, BoxTuple]]
    rows: Sequence[CellRow]
    clients: Sequence[ClientRow]
    now_ns: int
    title: str
    note: str
    empty: bool = False
    chunks: Sequence[CellSquare] = ()

    def by_cell(self) -> dict[str, list[CellRow]]:
        """Return the segments of each cell, the most important state last."""
        found: dict[str, list[CellRow]] = {}
        for row in sorted(self.rows, key=_rank):
            found.setdefault(row.id, []).append(row)
        return found


def state_of(row: CellRow) -> str:
    """Return the name in `GLYPHS` of a segment's state; ``fetched``: prefetched and not requested yet."""
    return "fetched" if row.ahead else row.state


def _rank(row: CellRow) -> int:
    state = state_of(row)
    return _ORDER.index(state) if state in _ORDER else -1


# --- on a terminal ------------------------------------------------------------------------------------
def terminal_rows(scene: Scene, columns: int, lines: int) -> list[list[str]]:
    """Return the picture as rows of states (names in `GLYPHS`), north up."""
    min_x, min_y, max_x, max_y = scene.bounds
    span_x, span_y = max(max_x - min_x, 1e-9), max(max_y - min_y, 1e-9)
    step = max(span_x / columns, span_y / (lines * CHARACTER_ASPECT))
    width = max(1, min(columns, math.ceil(span_x / step)))
    height = max(1, min(lines, math.ceil(span_y / (step * CHARACTER_ASPECT))))
    grid = [["none"] * width for _ in range(height)]

    def column(x: float) -> int:
        return math.floor((x - min_x) / span_x * width)

    def line(y: float) -> int:
        return math.floor((max_y - y) / span_y * height)

    def fill(box: BoxTuple, state: str) -> None:
        # a character shows the cell at its centre; a cell too small for that still gets one character
        first, last = (
            math.ceil((box[0] - min_x) / span_x * width - 0.5),
            math.ceil((box[2] - min_x) / span_x * width - 0.5),
        )
        top, bottom = (
            math.ceil((max_y - box[3]) / span_y * height - 0.5),
            math.ceil((max_y - box[1]) / span_y * height - 0.5),
        )
        for row in range(max(top, 0), min(max(bottom, top + 1), height)):
            for at in range(max(first, 0), min(max(last, first + 1), width)):
                grid[row][at] = state

    for _, box in scene.disk:
        fill(box, "disk")
    for rows in scene.by_cell().values():
        fill(rows[-1].box, state_of(rows[-1]))
    for square in scene.chunks:
        fill(square.box, square.state)
    for client in scene.clients:
        for x, y in _outline(client):
            if 0 <= line(y) < height and 0 <= column(x) < width:
                grid[line(y)][column(x)] = "window"
    for client in scene.clients:
        if client.pose is not None:
            row, at = line(client.pose[1]), column(client.pose[0])
            if 0 <= row < height and 0 <= at < width:
                grid[row][at] = "client"
    return grid


def _outline(client: ClientRow) -> list[tuple[float, float]]:
    window = client.window
    if window is None:
        return []
    if window.shape == "circle":
        turns = [2 * math.pi * i / _OUTLINE_POINTS for i in range(_OUTLINE_POINTS)]
        return [
            (window.x + window.half_x * math.cos(t), window.y + window.half_y * math.sin(t)) for t in turns
        ]
    steps = [2 * i / (_OUTLINE_POINTS // 4) - 1 for i in range(_OUTLINE_POINTS // 4)]
    sides = [side for s in steps for side in ((s, -1.0), (s, 1.0), (-1.0, s), (1.0, s))] + [(1.0, 1.0)]
    return [(window.x + a * window.half_x, window.y + b * window.half_y) for a, b in sides]


# --- as a file ----------------------------------------------------------------------------------------
def svg(scene: Scene) -> str:
    """Return the picture as SVG, with a tooltip on every cell and client."""
    known = scene.by_cell()
    cells = [CellSquare(box, "", f"{name}\non disk") for name, box in scene.disk if name not in known]
    cells += [
        CellSquare(rows[-1].box, state_of(rows[-1]), _cell_title(rows, scene.now_ns))
        for rows in known.values()
    ]
    cells += scene.chunks
    vehicles, windows = [], []
    for client in scene.clients:
        title, window = _client_title(client, scene.now_ns), client.window
        circle = window is not None and window.shape == "circle"
        if window is not None and not circle:
            half_x, half_y = window.half_x, window.half_y
            box = (window.x - half_x, window.y - half_y, window.x + half_x, window.y + half_y)
            windows.append((box, title))
        if client.pose is not None:
            radius = window.half_x if window is not None and circle else 0.0
            label = client.client or client.command
            vehicles.append(Vehicle(*client.pose, client.heading, radius, title, label))
    return top_view_svg(
        scene.bounds, cells, title=scene.title, note=scene.note, others=vehicles, windows=windows
    )


def _cell_title(rows: Sequence[CellRow], now_ns: int) -> str:
    lines = [rows[-1].id]
    for row in rows:
        idle_s = max(now_ns - row.last_use_monotonic_ns, 0) * 1e-9
        state = {"zombie": "retired", "fetched": "fetched ahead"}.get(state_of(row), row.state)
        lines.append(
            f"{row.layer}: {state}, {format_bytes(row.bytes)}, {row.points:,} points, {row.hits:,} hits,"
            f" used {format_duration(idle_s)} ago, loaded in {format_duration(row.load_ns * 1e-9)}"
        )
    return "\n".join(lines)


def _client_title(client: ClientRow, now_ns: int) -> str:
    return (
        f"{client.client or client.command or 'a client'}, pid {client.pid or '?'}\n"
        f"{client.cells:,} cells, {format_bytes(client.bytes)}, {client.requests:,} requests,"
        f" the last {format_duration(client.idle_s(now_ns))} ago"
    )


_STYLE: Final = """
  body { font: 14px/1.45 system-ui, sans-serif; color: #1f2933; margin: 1.5em auto; max-width: 1000px; }
  table { border-collapse: collapse; margin: 1em 0; } td, th { padding: .15em .8em; text-align: right; }
  th { border-bottom: 1px solid #9aa5b1; } td:first-child, th:first-child { text-align: left; }
  svg { max-width: 100%; height: auto; }
  svg rect.cell:hover { stroke: #000; stroke-opacity: 1; stroke-width: 2; }
"""


def html_page(scene: Scene) -> str:
    """Return a self-contained page: the picture, its tooltips, and a table of the clients."""
    rows = "".join(
        f"<tr><td>{escape(c.client or c.command or '?')}</td><td>{c.pid or '?'}</td><td>{c.cells:,}</td>"
        f"<td>{format_bytes(c.bytes)}</td><td>{c.requests:,}</td>"
        f"<td>{f'{c.pose[0]:.1f}, {c.pose[1]:.1f}' if c.pose is not None else ''}</td></tr>"
        for c in scene.clients
    )
    table = (
        "<table><tr><th>client</th><th>pid</th><th>cells</th><th>given</th><th>requests</th><th>at</th></tr>"
        f"{rows}</table>"
        if rows
        else "<p>No client is connected.</p>"
    )
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(scene.title)}</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n{svg(scene)}{table}\n</body></html>\n"
    )


LIVE_STATES: Final = {
    "saved": "on disk",
    "clean": "in memory, saved",
    "loading": "loading",
    "saving": "saving",
    "dirty": "not saved yet",
}
"""States of chunks, and their names in the legend; of a column's chunks the last state here is drawn."""

_LIVE_ORDER: Final = list(LIVE_STATES)


def chunk_squares(chunks: Iterable[ChunkInfo], resolution: float) -> list[CellSquare]:
    """Return a square for each column of chunks; its tooltip has a line for each chunk.

    Parameters
    ----------
    resolution
        Edge of a voxel, metres.
    """
    columns: dict[tuple[int, int], list[ChunkInfo]] = {}
    for chunk in chunks:
        columns.setdefault((chunk.key.x, chunk.key.y), []).append(chunk)
    return [_chunk_square(column, resolution) for _, column in sorted(columns.items())]


def _chunk_square(column: list[ChunkInfo], resolution: float) -> CellSquare:
    min_x, min_y, _, max_x, max_y, _ = column[0].key.box(resolution)
    lines = []
    for chunk in sorted(column, key=lambda chunk: chunk.key.z):
        known = f", {counted(chunk.active, 'known voxel')}" if chunk.state != "saved" else ""
        low, high = (format_metres(chunk.key.box(resolution)[axis]) for axis in (2, 5))
        what = LIVE_STATES.get(chunk.state, chunk.state)
        lines.append(f"{chunk.key.text}, z {low} to {high} m: {what}, {format_bytes(chunk.bytes)}{known}")
    state = max(
        (chunk.state for chunk in column),
        key=lambda one: _LIVE_ORDER.index(one) if one in _LIVE_ORDER else -1,
    )
    return CellSquare((min_x, min_y, max_x, max_y), state, "\n".join(lines))
