# SPDX-License-Identifier: Apache-2.0
"""The map from above, with cells or with chunks of a live map: for a terminal, as SVG, or as HTML."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Final

from shmmap.cli.screens.output import Line, counted, format_bytes, format_duration, format_metres, printable
from shmmap.cli.screens.picture import CellSquare, Raster, Vehicle, top_view_svg
from shmmap.formats.svg import BoxTuple, escape

if TYPE_CHECKING:
    from shmmap.client.live.chunk_reader import ChunkInfo
    from shmmap.protocol.rows import CellRow, ClientRow

GLYPHS: Final = {
    # state: glyph, style on a terminal
    "resident": ("#", "green"),
    "ahead": ("+", "cyan"),
    "stale": ("s", "yellow"),
    "retired": ("r", "magenta"),
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

_ORDER: Final = ("retired", "stale", "ahead", "resident")  # the last state in this order is drawn

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
    points
        The points of cells in memory, seen from above, for a file.
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
    points: Raster | None = None

    def by_cell(self) -> dict[str, list[CellRow]]:
        """Return the segments of each cell, the most important state last."""
        found: dict[str, list[CellRow]] = {}
        for row in sorted(self.rows, key=_rank):
            found.setdefault(row.id, []).append(row)
        return found


def _rank(row: CellRow) -> int:
    return _ORDER.index(row.shown_state) if row.shown_state in _ORDER else -1


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
        fill(rows[-1].box, rows[-1].shown_state)
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


def terminal_map(scene: Scene, columns: int, lines: int, *, solid: bool) -> list[Line]:
    """Return the picture with axes in metres, a scale bar and names, where there is room for them.

    Parameters
    ----------
    columns, lines
        Room for all of it.
    solid
        Draw areas with blocks instead of ASCII letters.
    """
    min_x, min_y, max_x, max_y = scene.bounds
    if columns < _NARROWEST:
        return _joined(_characters(scene, terminal_rows(scene, columns, lines), solid=solid))
    margin = max(len(f"{bound:.0f}") for bound in (min_y, max_y)) + 3  # a label has no decimals, or few
    grid = terminal_rows(scene, max(columns - margin, 1), max(lines - 3, 1))
    width, height = len(grid[0]), len(grid)
    step = _tick_step((max_x - min_x) / width * _TICK_COLUMNS)
    drawn = _joined(_characters(scene, grid, solid=solid))
    span_y = max(max_y - min_y, 1e-9)
    marks = {
        min(int((max_y - y) / span_y * height), height - 1): y
        for y in _ticks(min_y, max_y, _tick_step(span_y / height * _TICK_LINES))
    }
    rows: list[Line] = []
    for at, line in enumerate(drawn):
        label = format_metres(marks[at]) if at in marks else ""
        rows.append([(f"{label:>{margin - 2}} {'-' if at in marks else '|'}", _AXIS), *line])
    axis, labels = ["-"] * width, ""
    for x in _ticks(min_x, max_x, step):
        at = min(int((x - min_x) / max(max_x - min_x, 1e-9) * width), width - 1)
        axis[at] = "|"
        label = format_metres(x)
        start = margin + at - len(label) // 2
        if start > len(labels) and start + len(label) <= columns:
            labels = f"{labels:{start}}{label}"
    bar = max(int(step / max(max_x - min_x, 1e-9) * width), 2)
    scale = f"{'':{margin}}|{'-' * (bar - 2)}| {format_metres(step)} m"
    return [*rows, [(" " * margin + "".join(axis), _AXIS)], [(labels, _AXIS)], [(scale[:columns], _AXIS)]]


_NARROWEST: Final = 30  # columns below which there are no axes
_TICK_COLUMNS: Final = 12
_TICK_LINES: Final = 4
_AXIS: Final = "bright_black"
_SOLID: Final = {
    "resident": "█",
    "ahead": "▓",
    "stale": "▓",
    "retired": "▒",
    "disk": "·",
    "window": "○",
    "client": "●",
    "saved": "·",
    "clean": "█",
    "loading": "█",
    "saving": "█",
    "dirty": "█",
    "none": " ",
}


def glyph(state: str, *, solid: bool) -> str:
    """Return the character of a state."""
    return _SOLID[state] if solid else GLYPHS[state][0]


def _characters(scene: Scene, grid: list[list[str]], *, solid: bool) -> list[list[tuple[str, str]]]:
    """Return characters and their styles, with the names of cells and clients written over them."""
    rows = [[(glyph(state, solid=solid), GLYPHS[state][1]) for state in row] for row in grid]
    min_x, min_y, max_x, max_y = scene.bounds
    width, height = len(grid[0]), len(grid)

    def place(x: float, y: float) -> tuple[int, int]:
        return (
            math.floor((x - min_x) / max(max_x - min_x, 1e-9) * width),
            math.floor((max_y - y) / max(max_y - min_y, 1e-9) * height),
        )

    taken: set[tuple[int, int]] = set()

    def write(text: str, at: int, line: int, end: int, style: str) -> None:
        """Write a name where it covers no other, and ends before ``end``."""
        places = [(column, line) for column in range(at, at + len(text))]
        if 0 <= line < height and at >= 0 and at + len(text) <= min(end, width) and not taken & {*places}:
            taken.update(places)
            rows[line][at : at + len(text)] = [(one, style) for one in text]

    clients = [client for client in scene.clients if client.pose is not None]
    taken.update(place(*client.pose) for client in clients if client.pose is not None)
    for client in clients:
        if client.pose is not None:
            at, line = place(*client.pose)
            name = printable(client.client or client.command)
            room = width - at - 2
            name = name if len(name) <= room else f"{name[: room - 1]}…"
            if room >= _SHORTEST_NAME or len(name) <= room:
                write(name, at + 2, line, width, "bold")
    boxes = {**dict(scene.disk), **{name: rows_[-1].box for name, rows_ in scene.by_cell().items()}}
    for name, short in _short_names(list(boxes)).items():
        at, line = place(boxes[name][0], boxes[name][3])
        end = place(boxes[name][2], boxes[name][3])[0]
        write(printable(short), at + 1, max(line, 0), end, "")
    return rows


_SHORTEST_NAME: Final = 6


def _joined(rows: list[list[tuple[str, str]]]) -> list[Line]:
    """Return lines in which neighbours of one style are one piece."""
    by_style: Callable[[tuple[str, str]], str] = lambda one: one[1]  # noqa: E731
    return [
        [("".join(text for text, _ in pieces), style) for style, pieces in groupby(row, by_style)]
        for row in rows
    ]


def _tick_step(at_least: float) -> float:
    """Return the smallest 1, 2 or 5 times a power of ten that is not smaller."""
    power = 10.0 ** math.floor(math.log10(max(at_least, 1e-6)))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= at_least * (1 - 1e-9))


def _ticks(low: float, high: float, step: float) -> list[float]:
    return [index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


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
    shown = _short_names([*(name for name, _ in scene.disk), *known])
    cells = [
        CellSquare(box, "", f"{name}\non disk", shown[name]) for name, box in scene.disk if name not in known
    ]
    cells += [
        CellSquare(rows[-1].box, rows[-1].shown_state, _cell_title(rows, scene.now_ns), shown[name])
        for name, rows in known.items()
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
        scene.bounds,
        cells,
        title=scene.title,
        note=scene.note,
        raster=scene.points,
        others=vehicles,
        windows=windows,
    )


def _short_names(names: Sequence[str]) -> dict[str, str]:
    """Return names of cells without suffix, and without the word that all of them begin with."""
    stems = {name: name.rpartition("/")[2].rpartition(".")[0] or name for name in names}
    first = os.path.commonprefix(list(stems.values()))  # noqa: RUF071  of characters
    word = len(first.rpartition("_")[0]) + 1 if "_" in first and len(names) > 1 else 0
    return {name: stem[word:] for name, stem in stems.items()}


def _cell_title(rows: Sequence[CellRow], now_ns: int) -> str:
    lines = [rows[-1].id]
    for row in rows:
        idle_s = max(now_ns - row.last_use_monotonic_ns, 0) * 1e-9
        state = "fetched ahead" if row.shown_state == "ahead" else row.shown_state
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
        known = f", {counted(chunk.active, 'voxel')} known" if chunk.state != "saved" else ""
        low, high = (format_metres(chunk.key.box(resolution)[axis]) for axis in (2, 5))
        what = LIVE_STATES.get(chunk.state, chunk.state)
        lines.append(f"{chunk.key.text}, z {low} to {high} m: {what}, {format_bytes(chunk.bytes)}{known}")
    state = max(
        (chunk.state for chunk in column),
        key=lambda one: _LIVE_ORDER.index(one) if one in _LIVE_ORDER else -1,
    )
    return CellSquare((min_x, min_y, max_x, max_y), state, "\n".join(lines))
