# SPDX-License-Identifier: Apache-2.0
"""What a notebook shows of a client and of cells: a table, and a small picture from above.

Everything comes from what this process has: no request is sent, and it is the same once the daemon is gone.
At most `MAX_POINTS` points are drawn, spread over all cells.
"""

from __future__ import annotations

import base64
import html
import math
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shmmap.formats.png import png_bytes
from shmmap.quantities import counted, format_bytes, format_metres
from shmmap.viewing.rendering import Camera, PointImage, Ramp, coloured

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from shmmap.client.cell import Cell
    from shmmap.client.cell_set import CellSet
    from shmmap.client.session_state import SessionState

MAX_POINTS: Final = 20_000
_MAX_CELLS: Final = 2_000  # drawn of a set: each takes some microseconds, and a page of its memory
_MAX_LISTED: Final = 8
_SIDE: Final = 320  # pixels
_COLOUR_BITS: Final = 0xF0  # fewer colours make a picture of half the bytes
_HEIGHTS: Final = Ramp(((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)))

Row = tuple[str, ...]


def cell_html(cell: Cell) -> str:
    """Return a table of a cell's columns, and its picture."""
    head = (f"{cell.name}, layer {cell.layer}", f"{cell.points:,} rows, {format_bytes(cell.nbytes)}")
    rows: list[Row] = [("column", "dtype", "shape", "unit")]
    for name in cell.column_names:
        column = cell[name]
        rows.append((name, str(column.dtype), str(column.shape), cell.unit(name)))
    return _page(head, [_box_text(cell.box), f"version {cell.version_hex}"], rows, [cell])


def cell_set_html(cells: CellSet) -> str:
    """Return a table of a set's first cells and of what it lacks, and the picture of all cells."""
    head = (counted(len(cells), "cell"), format_bytes(sum(cell.nbytes for cell in cells)))
    lines = [
        f"{counted(len(some), 'cell')} {word}"
        for word, some in (("pending", cells.pending), ("failed", cells.failed), ("removed", cells.removed))
        if some
    ]
    if not cells.covered:
        lines.append("there may be more cells")
    rows: list[Row] = [("cell", "layer", "rows", "memory")]
    rows += [
        (cell.name, cell.layer, f"{cell.points:,}", format_bytes(cell.nbytes)) for cell in cells[:_MAX_LISTED]
    ]
    if len(cells) > _MAX_LISTED:
        rows.append((f"{len(cells) - _MAX_LISTED:,} more", "", "", ""))
    return _page(head, lines, rows, cells.cells)


def client_html(client: SessionState) -> str:
    """Return a table of what the session knows of daemon and map."""
    welcome, lost = client.welcome, client.disconnected_since
    state = "connected" if lost is None else f"connection lost {time.monotonic() - lost:.0f} s ago"
    rows: list[Row] = [
        ("map", welcome.map_path or "none"),
        ("daemon", f"{client.endpoint}, {state}"),
        ("cells", f"{welcome.cells:,}"),
        ("extent", _box_text(welcome.bounds) if welcome.bounds else "none"),
        ("frame", welcome.frame_id + (f", of {welcome.crs}" if welcome.crs else "")),
        ("map version", f"{client.map_version:016x}"),
    ]
    return f"<div><b>shmmap client</b>{_table(rows, heads=False)}</div>"


def _page(head: Row, lines: Iterable[str], rows: Sequence[Row], cells: Sequence[Cell]) -> str:
    text = "".join(f"<br>{_escaped(line)}" for line in lines)
    return f"<div><b>{_escaped(': '.join(head))}</b>{text}{_table(rows)}{_picture(cells)}</div>"


def _table(rows: Sequence[Row], *, heads: bool = True) -> str:
    body = ""
    for number, row in enumerate(rows):
        tag = "th" if heads and not number else "td"
        body += f"<tr>{''.join(f'<{tag}>{_escaped(word)}</{tag}>' for word in row)}</tr>"
    return f"<table>{body}</table>"


def _escaped(text: str) -> str:
    # a file's name may have bytes that are no characters
    return html.escape(text.encode("utf-8", "backslashreplace").decode())


def _box_text(box: Sequence[float]) -> str:
    x0, y0, x1, y1 = map(format_metres, box)
    return f"x {x0} to {x1}, y {y0} to {y1} m"


def _picture(cells: Sequence[Cell]) -> str:
    """Return an image of the points from above, coloured by height; empty if there are none to draw."""
    parts = []
    step = max(1, math.ceil(len(cells) / _MAX_CELLS))
    chosen = [cell for cell in cells[::step] if cell.points and cell.layer == cells[0].layer]
    share = max(1, MAX_POINTS // max(1, len(chosen)))
    for cell in chosen:
        points = _points(cell, share)
        if points is not None and len(points):
            parts.append(points)
    if not parts:
        return ""
    xyz = np.concatenate(parts)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    span = max(float((high - low)[:2].max()), 1e-3)
    width, height = (max(8, math.ceil(_SIDE * float(part) / span)) for part in (high - low)[:2])
    box = [(float(a), float(b), float(c)) for a, b, c in (low, high)]
    image = PointImage(Camera.looking(box[0], box[1], width, height, None, 0.0))
    image.add(xyz)
    image.fill_gaps()
    z_low, z_high = np.percentile(xyz[:, 2], (1.0, 99.0)).tolist()
    picture = coloured(image, image.heights(), z_low, z_high, _HEIGHTS)
    picture[..., :3] &= _COLOUR_BITS
    png = png_bytes(picture)
    caption = f"{counted(len(xyz), 'point')} from above, z {z_low:.2f} to {z_high:.2f} m"
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return f'<figure><img alt="{caption}" src="{source}"><figcaption>{caption}</figcaption></figure>'


def _points(cell: Cell, most: int) -> NDArray[np.float64] | None:
    """Return up to ``most`` places of a cell, (N, 3), metres, map frame; None if its layer has none."""
    names, lattice = cell.column_names, cell.lattice
    if lattice is not None and "min" in names:
        low: NDArray[Any] = cell["min"]
        places = np.argwhere(~np.isnan(low))
        rows, columns = places[:: math.ceil(max(1, len(places)) / most)].T
        x, y = (
            (columns + lattice.first[0] + 0.5) * lattice.leaf[0],
            (rows + lattice.first[1] + 0.5) * lattice.leaf[1],
        )
        return np.column_stack([x, y, low[rows, columns]]) + cell.origin
    for name in ("xyz", "mean"):
        if name in names:
            column: NDArray[Any] = cell[name]
            return column[:: math.ceil(len(column) / most)].astype(np.float64) + cell.origin
    return None
