# SPDX-License-Identifier: Apache-2.0
"""A live map from above and from the south, as one SVG file: voxels by height, chunks by state, the path."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from shmmap import ChunkInfo
from shmmap_clients.png import png_bytes
from shmmap_clients.rolling_map.heights import HeightColours
from shmmap_clients.rolling_map.picture_legend import STATES, chunk_style, legend

__all__ = ["MapContent", "map_picture"]

_CHUNK_SIDE: Final = 64
_WIDTH_PX: Final = 1200.0
_HIGH_PX: Final = 1100.0  # the view from above, at most
_MOST_PIXELS: Final = 2400  # of an image along its longer side
_MARGIN_PX: Final = 40.0
_GAP_PX: Final = 52.0
_HEAD_PX: Final = 92.0
_LEGEND_PX: Final = 84.0
_FREE: Final = (128, 156, 184, 72)  # chunks can be seen through it
_FREE_TEXT: Final = "#d8e0e9"  # the same on white
_TEXT: Final = "#1f2933"
_PALE: Final = "#66727f"
_PATH: Final = "#e8104a"
_ACROSS: Final = (0, 1)  # axes of the view from above: to the right, upwards
_SIDE: Final = (0, 2)


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """What is drawn; what is empty is left out.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupied, free
        Middles of voxels, (N, 3), metres.
    chunks
        Where they are, and in which states.
    path
        Where the sensor was, metres.
    usage
        What the map takes, in words.
    """

    resolution: float
    occupied: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    free: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    chunks: Sequence[ChunkInfo] = ()
    path: Sequence[tuple[float, float, float]] = ()
    usage: str = ""


def map_picture(content: MapContent, title: str, note: str) -> str:
    """Return the picture as SVG: from above with y upwards, below it from the south; both to one scale.

    Parameters
    ----------
    content
        What is drawn.
    title, note
        Two lines of text at the top.
    """
    low, high = _extent(content)
    span = high - low
    inner = _WIDTH_PX - 2 * _MARGIN_PX
    scale = min(inner / span[0], _HIGH_PX / span[1])
    colours = HeightColours.of(content.occupied[:, 2])
    left = (_WIDTH_PX - span[0] * scale) / 2
    views, top = [], _HEAD_PX
    for axes, name in ((_ACROSS, "from above"), (_SIDE, "from the south")):
        view = _View(low, high, axes, scale, left, top)
        views.append(view.svg(content, colours, name))
        top = view.bottom + _GAP_PX
    height = top - _GAP_PX + 24.0 + _LEGEND_PX
    states = {row.state for row in content.chunks}
    below = legend(
        _MARGIN_PX, top - _GAP_PX + 36.0, inner, states, colours if len(content.occupied) else None,
        free=_FREE_TEXT if len(content.free) else "", path=_PATH if content.path else "",
        pixels_per_metre=scale,
    )  # fmt: skip
    usage = (
        f'<text x="{_WIDTH_PX - _MARGIN_PX:.0f}" y="34" text-anchor="end" font-size="17">'
        f"{escape(content.usage)}</text>"
        if content.usage
        else ""
    )
    box = f'viewBox="0 0 {_WIDTH_PX:.0f} {height:.0f}" width="{_WIDTH_PX:.0f}"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {box}>',
            f"<title>{escape(title)}</title>",
            '<rect width="100%" height="100%" fill="#ffffff"/>',
            f'<g font-family="system-ui, DejaVu Sans, sans-serif" font-size="14" fill="{_TEXT}">',
            f'<text x="{_MARGIN_PX:.0f}" y="34" font-size="19" font-weight="600">{escape(title)}</text>',
            f'<text x="{_MARGIN_PX:.0f}" y="57" fill="{_PALE}">{escape(note)}</text>',
            usage,
            *views,
            below,
            "</g>",
            "</svg>",
            "",
        ]
    )


def _extent(content: MapContent) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The box around all that is drawn, with a little air around it; metres."""
    half = content.resolution / 2
    boxes = []
    for voxels in (content.occupied, content.free):
        if len(voxels):
            boxes += [voxels.min(axis=0) - half, voxels.max(axis=0) + half]
    if content.chunks:
        keys, side = _keys(content.chunks), _CHUNK_SIDE * content.resolution
        boxes += [keys.min(axis=0) * side, (keys.max(axis=0) + 1) * side]
    if content.path:
        path = np.array(content.path)
        boxes += [path.min(axis=0), path.max(axis=0)]
    if not boxes:
        boxes = [np.zeros(3)]
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    air = max(0.01 * float((high - low).max()), content.resolution)
    return low - air, high + air


def _keys(chunks: Iterable[ChunkInfo]) -> NDArray[np.int64]:
    return np.array([tuple(row.key) for row in chunks], np.int64).reshape(-1, 3)


class _View:
    """The map along one axis.

    Parameters
    ----------
    low, high
        Box that is shown, metres.
    axes
        Which go to the right and upwards.
    scale
        SVG units a metre.
    left, top
        Corner in the picture.
    """

    def __init__(
        self, low: NDArray[np.float64], high: NDArray[np.float64], axes: tuple[int, int], scale: float,
        left: float, top: float,
    ) -> None:  # fmt: skip
        self._axes = list(axes)
        self._low, self._high = low[self._axes], high[self._axes]
        self._scale, self._left, self._top = scale, left, top
        self.bottom: float = top + float(self._high[1] - self._low[1]) * scale

    def svg(self, content: MapContent, colours: HeightColours, name: str) -> str:
        """Return what is seen: chunks, voxels on them, outlines and the path on top."""
        x, y, width, height = self._rectangle(self._low, self._high)
        frame = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
        squares = self._squares(content)
        fills = [f'<path d="{d}" {chunk_style(state, fill=True)}/>' for state, d in squares]
        lines = [f'<path d="{d}" {chunk_style(state, fill=False)}/>' for state, d in squares]
        at = f'x="{_MARGIN_PX:.0f}" y="{self._top - 6:.1f}"'
        return "\n".join(
            [
                f'<text {at} font-size="12" fill="{_PALE}">{name}</text>',
                f'<rect {frame} fill="#fbfcfd" stroke="#d5dbe1"/>',
                *fills,
                self._voxels(content, colours),
                *lines,
                self._path(content.path),
            ]
        )

    def _rectangle(
        self, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> tuple[float, float, float, float]:
        """Left, top, width and height of a box."""
        (x, y), (width, height) = self._place(low[0], high[1]), (high - low) * self._scale
        return x, y, float(width), float(height)

    def _place(self, right: float, up: float) -> tuple[float, float]:
        return (
            self._left + float(right - self._low[0]) * self._scale,
            self._top + float(self._high[1] - up) * self._scale,
        )

    def _squares(self, content: MapContent) -> list[tuple[str, str]]:
        """Each state with the outlines of its chunks; of chunks behind one another, the most urgent state."""
        shown: dict[tuple[int, int], int] = {}
        for row in content.chunks:
            key = (row.key[self._axes[0]], row.key[self._axes[1]])
            shown[key] = min(shown.get(key, len(STATES)), list(STATES).index(row.state))
        side = _CHUNK_SIDE * content.resolution
        size = side * self._scale
        # one that is drawn later covers the border of one before: the most urgent last
        found = []
        for rank, state in reversed(list(enumerate(STATES))):
            places = [self._place(i * side, (j + 1) * side) for (i, j), at in shown.items() if at == rank]
            if places:
                step = f"h{size:.2f}v{size:.2f}h{-size:.2f}z"
                found.append((state, "".join(f"M{x:.2f} {y:.2f}{step}" for x, y in places)))
        return found

    def _voxels(self, content: MapContent, colours: HeightColours) -> str:
        """Of the voxels behind one another the highest; free ones only where none is occupied."""
        cells = [self._cells(voxels, content.resolution) for voxels in (content.free, content.occupied)]
        both = np.concatenate(cells)
        if not len(both):
            return ""
        low = both.min(axis=0)
        size = both.max(axis=0) - low + 1
        coarse = max(1, math.ceil(int(size.max()) / _MOST_PIXELS))
        columns, rows = (int(value) for value in -(-size // coarse))
        image = np.zeros((rows, columns, 4), np.uint8)
        free, occupied = ((places - low) // coarse for places in cells)
        image[rows - 1 - free[:, 1], free[:, 0]] = _FREE
        # of several values for one pixel the last stays
        order = np.argsort(content.occupied[:, 2], kind="stable")
        image[rows - 1 - occupied[order, 1], occupied[order, 0], :3] = colours.rgb(content.occupied[order, 2])
        image[rows - 1 - occupied[:, 1], occupied[:, 0], 3] = 255
        edge = content.resolution * coarse
        corner = low * content.resolution
        x, y, width, height = self._rectangle(corner, corner + np.array([columns, rows]) * edge)
        place = f'x="{x:.2f}" y="{y:.2f}" width="{width:.2f}" height="{height:.2f}"'
        data = base64.b64encode(png_bytes(image)).decode("ascii")
        return f'<image {place} image-rendering="pixelated" href="data:image/png;base64,{data}"/>'

    def _cells(self, voxels: NDArray[np.float64], resolution: float) -> NDArray[np.int64]:
        """Which voxel each middle is of, seen along the axis."""
        return np.floor(voxels[:, self._axes] / resolution).astype(np.int64)

    def _path(self, path: Sequence[tuple[float, float, float]]) -> str:
        if not path:
            return ""
        places = [self._place(at[self._axes[0]], at[self._axes[1]]) for at in path]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        (x0, y0), (x1, y1) = places[0], places[-1]
        start, end = f'cx="{x0:.1f}" cy="{y0:.1f}"', f'cx="{x1:.1f}" cy="{y1:.1f}"'
        line = f'<polyline points="{points}" fill="none" stroke-linejoin="round" stroke-linecap="round"'
        return "\n".join(
            [
                f'{line} stroke="#ffffff" stroke-width="5" stroke-opacity="0.85"/>',
                f'{line} stroke="{_PATH}" stroke-width="2.2"/>',
                f'<circle {start} r="4" fill="#ffffff" stroke="{_PATH}" stroke-width="2"/>',
                f'<circle {end} r="5" fill="{_PATH}" stroke="#ffffff" stroke-width="1.5"/>',
            ]
        )
