# SPDX-License-Identifier: Apache-2.0
"""A live map from above and from the south, as one SVG file: voxels by height, chunks by state, the path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.png import png_bytes
from shmmap.formats.svg import PALE, Axes, BoxTuple, Page, dash, element, swatch
from shmmap.live import ChunkInfo

_CHUNK_SIDE: Final = 64
_WIDTH_PX: Final = 1200.0
_HIGH_PX: Final = 1100.0  # greatest height of the view from above
_MARGIN_PX: Final = 40.0
_GAP_PX: Final = 52.0
_HEAD_PX: Final = 92.0
_BAR_PX: Final = 200.0  # length of the scale of heights in the legend
_FREE: Final = (128, 156, 184, 72)  # transparent, so that chunks remain visible
_FREE_TEXT: Final = "#d8e0e9"  # the same colour on white
_PATH: Final = "#e8104a"
_ACROSS: Final = (0, 1)  # axes of the view from above: to the right, upwards
_SIDE: Final = (0, 2)
_LEVELS: Final = 256
# dark and violet below, orange above; not green or blue, the colours of chunks
_ANCHORS: Final = np.array(
    [
        *((44, 22, 84), (98, 28, 122), (152, 42, 118), (202, 68, 92)),
        *((236, 112, 60), (250, 166, 40), (247, 208, 70)),
    ],
    np.float64,
)


class _Look(NamedTuple):
    colour: str
    opacity: float
    text: str

    def area(self) -> dict[str, str | float | None]:
        """Return attributes of a square's area, which is drawn below the voxels."""
        return {"fill": self.colour, "fill_opacity": self.opacity}

    def outline(self) -> dict[str, str | float | None]:
        """Return attributes of a square's outline, which is drawn above the voxels."""
        return {"stroke": self.colour, "stroke_opacity": 0.8, "stroke_width": 1.2 if self.opacity else 0.8}


STATES: Final = {
    "loading": _Look("#111418", 0.30, "loading"),
    "saving": _Look("#0e9db8", 0.24, "saving"),
    "dirty": _Look("#2563eb", 0.17, "dirty: newer than on disk"),
    "clean": _Look("#2f9e44", 0.17, "clean: as on disk"),
    "saved": _Look("#9aa5b1", 0.0, "on disk only"),
}
"""Colours of states as in Rolling-Bonxai; where chunks overlap, the first state here is shown."""


class HeightColours:
    """Colour scale between two heights.

    Parameters
    ----------
    low, high
        Heights, metres; heights beyond have the colour of the nearer end.
    """

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high
        at = np.linspace(0.0, len(_ANCHORS) - 1.0, _LEVELS)
        columns = [np.interp(at, np.arange(len(_ANCHORS)), _ANCHORS[:, channel]) for channel in range(3)]
        self.levels: NDArray[np.uint8] = np.stack(columns, axis=1).round().astype(np.uint8)

    @classmethod
    def of(cls, heights: NDArray[np.float64]) -> HeightColours:
        """Make a scale for these heights, (N,), metres, without the outermost hundredths."""
        if not len(heights):
            return cls(0.0, 1.0)
        low, high = (float(value) for value in np.percentile(heights, (1, 99)))
        return cls(low, max(high, low + 1e-3))

    def rgb(self, heights: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the colours of heights, (N, 3)."""
        part = np.clip((heights - self.low) / (self.high - self.low), 0.0, 1.0)
        found: NDArray[np.uint8] = self.levels[(part * (_LEVELS - 1)).round().astype(np.int64)]
        return found


@dataclass(frozen=True, slots=True, eq=False)
class MapContent:
    """Contents of the picture; empty parts are left out.

    Attributes
    ----------
    resolution
        Edge of a voxel, metres.
    occupied, free
        Centres of voxels, (N, 3), metres.
    chunks
        Positions and states of chunks.
    path
        Positions of the sensor, metres.
    usage
        Size of the map as text.
    """

    resolution: float
    occupied: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    free: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    chunks: Sequence[ChunkInfo] = ()
    path: Sequence[tuple[float, float, float]] = ()
    usage: str = ""


def map_picture(content: MapContent, title: str, note: str) -> str:
    """Return the picture as SVG: a view from above, y upwards, and one from the south, to the same scale.

    Parameters
    ----------
    content
        Contents of the picture.
    title, note
        Two lines of text at the top.
    """
    (low_x, low_y, low_z), (high_x, high_y, high_z) = (corner.tolist() for corner in _extent(content))
    colours = HeightColours.of(content.occupied[:, 2])
    page = Page(_WIDTH_PX, title, margin=_MARGIN_PX)
    page.heading(34, title, note)
    if content.usage:
        page.text(page.right, 34, content.usage, text_anchor="end", font_size=17)
    above = Axes.fitted(page, (low_x, low_y, high_x, high_y), _HEAD_PX, _HIGH_PX)
    side_box, side_height = (low_x, low_z, high_x, high_z), (high_z - low_z) * above.scale
    side = Axes(page, side_box, above.left, above.bottom + _GAP_PX, above.width, side_height)
    _draw_view(above, content, colours, _ACROSS, "from above")
    _draw_view(side, content, colours, _SIDE, "from the south")
    return page.svg(_draw_legend(above, side.bottom + 36, content, colours) + 24)


def _extent(content: MapContent) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of a box around the contents, with a margin; metres."""
    half, side = content.resolution / 2, _CHUNK_SIDE * content.resolution
    chunks = (np.array([tuple(row.key) for row in content.chunks]) + 0.5) * side
    parts = (
        (content.occupied, half),
        (content.free, half),
        (chunks, side / 2),
        (np.array(content.path), 0.0),
    )
    lows = [middles.min(axis=0) - reach for middles, reach in parts if len(middles)]
    highs = [middles.max(axis=0) + reach for middles, reach in parts if len(middles)]
    low, high = np.min(lows or [np.zeros(3)], axis=0), np.max(highs or [np.zeros(3)], axis=0)
    air = max(0.01 * float((high - low).max()), content.resolution)
    return low - air, high + air


def _draw_view(
    axes: Axes, content: MapContent, colours: HeightColours, seen: tuple[int, int], name: str
) -> None:
    """Draw the view along one axis: chunks, voxels on them, outlines and the path on top.

    Where voxels overlap, the highest is shown; free voxels are shown only where none is occupied.

    Parameters
    ----------
    seen
        Axes of the map that point to the right and upwards.
    """
    columns = list(seen)
    axes.page.text(axes.page.margin, axes.top - 6, name, font_size=12, fill=PALE)
    axes.rectangle(axes.box, fill="#fbfcfd", stroke="#d5dbe1")
    squares = _squares(content, columns)
    for state, boxes in squares:
        axes.rectangles(boxes, **STATES[state].area())
    occupied = content.occupied[np.argsort(content.occupied[:, 2], kind="stable")]
    free_cells, occupied_cells = (
        np.floor(voxels[:, columns] / content.resolution).astype(np.int64)
        for voxels in (content.free, occupied)
    )
    colour = np.pad(colours.rgb(occupied[:, 2]), ((0, 0), (0, 1)), constant_values=255)
    axes.raster([(free_cells, _FREE), (occupied_cells, colour)], content.resolution)
    for state, boxes in squares:
        axes.rectangles(boxes, fill="none", **STATES[state].outline())
    path = [(at[seen[0]], at[seen[1]]) for at in content.path]
    axes.line(path, stroke="#ffffff", stroke_width=5, stroke_opacity=0.85, stroke_linecap="round")
    axes.line(path, stroke=_PATH, stroke_width=2.2, stroke_linecap="round")
    if path:
        axes.dot(*path[0], 4, fill="#ffffff", stroke=_PATH, stroke_width=2)
        axes.dot(*path[-1], 5, fill=_PATH, stroke="#ffffff", stroke_width=1.5)


def _squares(content: MapContent, seen: Sequence[int]) -> list[tuple[str, list[BoxTuple]]]:
    """Return each state with the boxes of its chunks; where chunks overlap, the most urgent state."""
    shown: dict[tuple[int, int], int] = {}
    for row in content.chunks:
        key = (row.key[seen[0]], row.key[seen[1]])
        shown[key] = min(shown.get(key, len(STATES)), list(STATES).index(row.state))
    side = _CHUNK_SIDE * content.resolution
    # a later box covers borders of earlier ones, so that the most urgent state is last
    found = []
    for rank, state in reversed(list(enumerate(STATES))):
        places = [place for place, at in shown.items() if at == rank]
        if places:
            found.append((state, [(i * side, j * side, (i + 1) * side, (j + 1) * side) for i, j in places]))
    return found


def _draw_legend(axes: Axes, y: float, content: MapContent, colours: HeightColours) -> float:
    """Draw the legend: states and path, then heights and scale; return the last baseline."""
    page, states = axes.page, {row.state for row in content.chunks}
    entries = [
        (swatch(**look.area(), **look.outline()), look.text)
        for state, look in STATES.items()
        if state in states
    ]
    if states:
        page.text(page.margin, y, "chunks", font_weight=600)
    if content.path:
        end = element("circle", cx=19, cy=-5, r=5, fill=_PATH)
        entries.append((dash(stroke=_PATH, stroke_width=2.2) + end, "sensor's path"))
    y = page.legend(y, entries, left=66 if states else 0) + 34
    free = [(swatch(fill=_FREE_TEXT, stroke="#c3ced8"), "free")] if len(content.free) else []
    if not len(content.occupied):
        return axes.legend(y, free)
    bar = page.margin + 122
    page.text(page.margin, y, "height", font_weight=600)
    page.text(bar - 8, y, _metres(colours.low), text_anchor="end")
    page.image(png_bytes(colours.levels[None]), x=bar, y=y - 12, width=_BAR_PX, height=14)
    page.text(bar + _BAR_PX + 8, y, f"{_metres(colours.high)} m")
    return axes.legend(y, free, left=_BAR_PX + 212)


def _metres(value: float) -> str:
    return f"{round(value, 1) + 0.0:.1f}".replace("-", "−")
