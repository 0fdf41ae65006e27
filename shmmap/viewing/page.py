# SPDX-License-Identifier: Apache-2.0
"""A whole picture of points: coordinates, scale bar, title and colours around what was rendered."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.png import png_bytes
from shmmap.formats.svg import round_length, round_steps
from shmmap.geometry import Box
from shmmap.viewing.lettering import Anchor, Canvas, Colour, text_width
from shmmap.viewing.rendering import Camera, PointImage, Ramp, coloured
from shmmap.viewing.sources import BoxTuple, Points, PointSource

if TYPE_CHECKING:
    from shmmap.protocol.rows import ClientRow

HEIGHT: Final = "height"
"""Colour by the height above the ground, which is no column."""
_DIRECTIONS: Final = {
    "east": 0.0,
    "north-east": 45.0,
    "north": 90.0,
    "north-west": 135.0,
    "west": 180.0,
    "south-west": 225.0,
    "south": 270.0,
    "south-east": 315.0,
}
"""Where one stands to look obliquely: angles from x to y, degrees."""

_ELEVATION: Final = math.radians(38.0)
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 16, 26, 92  # pixels around the map
_AROUND: Final = 44  # pixels for coordinates around an oblique map
_TICK_PX: Final = 110.0  # pixels between coordinates, about
_BAR_PX: Final = 150.0  # of the scale bar, at most
_LEGEND_PX: Final = 240
_MAX_BACKDROP: Final = 2000  # pixels along y
SHARES: Final = (0.5, 99.5)  # percentiles at the ends of the colours

_INK: Final[Colour] = (31, 41, 51)
_PALE: Final[Colour] = (92, 103, 115)
_GRID: Final[Colour] = (228, 231, 235)
_FRAME: Final[Colour] = (160, 168, 176)
_RED: Final[Colour] = (201, 42, 42)
_BACK: Final[Colour] = (250, 251, 252)
_WHITE: Final[Colour] = (255, 255, 255)

HEIGHT_COLOURS: Final = Ramp(
    (
        (198, 198, 198),
        (124, 184, 164),
        (64, 142, 174),
        (72, 92, 172),
        (136, 62, 142),
        (192, 44, 84),
        (242, 124, 42),
    )
)
VALUE_COLOURS: Final = Ramp(
    (
        (72, 40, 120),
        (62, 84, 150),
        (44, 124, 148),
        (38, 164, 138),
        (90, 200, 104),
        (180, 222, 60),
        (253, 231, 60),
    )
)


@dataclass(frozen=True)
class Follower:
    """A client: where it is, metres; its heading, radians, if known; the area that it follows; its name."""

    x: float
    y: float
    heading: float | None
    name: str
    box: BoxTuple | None = None
    is_round: bool = True


def follower_of(row: ClientRow) -> Follower | None:
    """Return where a client is and what it follows; None if it has not said so."""
    window = row.window
    if row.pose is None and window is None:
        return None
    box: BoxTuple | None = None
    if window is not None:
        box = (
            window.x - window.half_x,
            window.y - window.half_y,
            window.x + window.half_x,
            window.y + window.half_y,
        )
    x, y = row.pose if row.pose is not None else (window.x, window.y) if window is not None else (0.0, 0.0)
    name = row.client or row.command or str(row.pid)
    return Follower(x, y, row.heading, name, box, window is not None and window.shape == "circle")


@dataclass(frozen=True)
class View:
    """What to draw.

    Attributes
    ----------
    box
        The area, metres, map frame; from above the picture shows at least this.
    z
        Lowest and highest z to draw, metres; None: all.
    azimuth
        Direction in which one looks, radians from x to y; None: from above.
    by
        `HEIGHT`, ``"z"``, or a column.
    size
        Width and height, pixels.
    follower
        A client to mark.
    """

    box: BoxTuple
    z: tuple[float, float] | None = None
    azimuth: float | None = None
    by: str = HEIGHT
    size: tuple[int, int] = (1280, 800)
    follower: Follower | None = None


@dataclass(frozen=True)
class Drawn:
    """The picture, (rows, columns, 3) uint8, and what it shows.

    Attributes
    ----------
    points, parts
        Points in the picture, and cells, files or chunks read for it.
    box
        The area shown, metres.
    metres_per_pixel
        Metres per pixel across the line of sight.
    low, high
        Values at the ends of the colours.
    """

    pixels: NDArray[np.uint8]
    points: int
    parts: int
    box: BoxTuple
    metres_per_pixel: float
    low: float
    high: float


def looking_from(direction: str) -> float:
    """Return the azimuth of a view from a direction such as ``south-west``, radians from x to y."""
    return math.radians(_DIRECTIONS[direction] + 180.0)


def draw(source: PointSource, view: View) -> Drawn | None:
    """Draw the points of a source; None if there are none in the picture.

    Raises
    ------
    NoColumn
        The points have no such column.
    """
    camera, box = _camera(source, view)
    if camera is None:
        return None
    area = Box(*box, view.z)
    whole = view.azimuth is None and view.z is None
    by_height = view.by == HEIGHT
    image = PointImage(camera, None if whole else area, with_ground=by_height)
    for points in source.blocks(area, "" if view.by in (HEIGHT, "z") else view.by):
        image.add(*points)
    parts = source.parts
    if not image.points:
        return None
    image.fill_gaps()
    shown = image.values if image.has_values else image.heights()
    seen = shown[np.isfinite(shown)]
    low, high = np.percentile(seen, SHARES).tolist() if len(seen) else (0.0, 1.0)
    if by_height:
        low, high = 0.0, max(high, 1.0)
    high = max(high, low + 1e-6 * max(abs(low), 1.0))
    ramp = HEIGHT_COLOURS if by_height else VALUE_COLOURS
    floor = image.level()
    page = _Page(view, camera, box, floor)
    page.put(coloured(image, shown, low, high, ramp))
    if view.follower is not None:
        page.mark(view.follower)
    name = {HEIGHT: "height above ground, m", "z": "z, m"}.get(view.by, view.by)
    if source.unit and view.by not in (HEIGHT, "z"):
        name += f", {source.unit}"
    page.legend(name, low, high, ramp)
    page.title(source.title, f"{image.points:,} points")
    return Drawn(page.canvas.pixels, image.points, parts, box, 1.0 / camera.scale, low, high)


def backdrop(blocks: Iterable[Points], box: BoxTuple, width: int) -> bytes | None:
    """Return points from above in pale colours, as a PNG that fills a box; None if there are none.

    Parameters
    ----------
    width
        Width of the picture, pixels.
    """
    span_x, span_y = max(box[2] - box[0], 1e-3), max(box[3] - box[1], 1e-3)
    width = max(1, min(width, round(_MAX_BACKDROP * span_x / span_y)))
    height = max(1, round(width * span_y / span_x))
    camera = Camera.looking((*box[:2], 0.0), (*box[2:], 0.0), width, height, None, 0.0)
    image = PointImage(camera, with_ground=True)
    for points in blocks:
        image.add(points.xyz, points.origin)
    if not image.points:
        return None
    image.fill_gaps()
    heights = image.heights()
    high = float(np.percentile(heights[np.isfinite(heights)], SHARES[1]))
    pale = Ramp(
        tuple(
            (int(r * 0.6 + 100), int(g * 0.6 + 100), int(b * 0.6 + 100)) for r, g, b in HEIGHT_COLOURS.stops
        )
    )
    return png_bytes(coloured(image, heights, 0.0, max(high, 1.0), pale))


def _camera(source: PointSource, view: View) -> tuple[Camera | None, BoxTuple]:
    """Return the projection, and the area to draw; no projection if there is nothing."""
    width, height = view.size[0] - _LEFT - _RIGHT, view.size[1] - _TOP - _BOTTOM
    box = _at_least(view.box)
    if view.azimuth is None:
        box = _widened(box, width / height)
        low_z, high_z = view.z or (0.0, 0.0)
        camera = Camera.looking((*box[:2], low_z), (*box[2:], high_z), width, height, None, 0.0)
        return camera, box
    z = source.heights(Box(*box, view.z))
    if z is None:
        return None, box
    if view.z is not None:
        z = max(z[0], view.z[0]), min(z[1], view.z[1])
    width, height = view.size[0] - 2 * _RIGHT, view.size[1] - _TOP - _BOTTOM
    fitted = Camera.looking(
        (*box[:2], z[0]),
        (*box[2:], z[1]),
        width - 2 * _AROUND,
        height - 2 * _AROUND,
        view.azimuth,
        _ELEVATION,
    )
    return replace(fitted, width=width, height=height), box


def _at_least(box: BoxTuple) -> BoxTuple:
    """Return a box of at least a metre."""
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    half_x, half_y = max((box[2] - box[0]) / 2, 0.5), max((box[3] - box[1]) / 2, 0.5)
    return x - half_x, y - half_y, x + half_x, y + half_y


def _widened(box: BoxTuple, aspect: float) -> BoxTuple:
    """Return a box of an aspect around another one."""
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    span_x, span_y = box[2] - box[0], box[3] - box[1]
    half_x, half_y = max(span_x, span_y * aspect) / 2, max(span_y, span_x / aspect) / 2
    return x - half_x, y - half_y, x + half_x, y + half_y


def _text(value: float) -> str:
    return f"{value:.10g}"


class _Page:
    """The canvas, and the map's place on it."""

    def __init__(self, view: View, camera: Camera, box: BoxTuple, floor: float) -> None:
        self.canvas = Canvas(*view.size)
        self._camera = camera
        self._box = box
        self._floor = floor
        self._left = _LEFT if view.azimuth is None else _RIGHT
        self._view = view
        self._texts_end = float(view.size[0])
        self.canvas.rectangle(self._left, _TOP, camera.width, camera.height, _BACK)
        if view.azimuth is None:
            self._axes()
        else:
            self._graticule(view.azimuth)

    def _place(self, x: float, y: float, z: float | None = None) -> tuple[float, float]:
        u, v = self._camera.place(x, y, self._floor if z is None else z)
        return self._left + u, _TOP + v

    def put(self, picture: NDArray[np.uint8]) -> None:
        """Put the points, RGBA, over what is drawn on the ground."""
        rows, columns = picture.shape[:2]
        part = self.canvas.pixels[_TOP : _TOP + rows, self._left : self._left + columns]
        np.copyto(part, picture[..., :3], where=picture[..., 3:] > 0)
        if self._view.azimuth is None:
            for x, y, width, height in (
                (self._left, _TOP, columns, 1),
                (self._left, _TOP + rows - 1, columns, 1),
                (self._left, _TOP, 1, rows),
                (self._left + columns - 1, _TOP, 1, rows),
            ):
                self.canvas.rectangle(x, y, width, height, _FRAME)

    def _axes(self) -> None:
        """Draw the coordinates of a view from above: lines behind the points, numbers at the frame."""
        camera, (min_x, min_y, max_x, max_y) = self._camera, self._box
        bottom = _TOP + camera.height
        for x in round_steps(min_x, max_x, camera.width / _TICK_PX):
            at = round(self._place(x, min_y)[0])
            self.canvas.rectangle(at, _TOP, 1, camera.height + 5, _GRID)
            self.canvas.rectangle(at, bottom, 1, 5, _PALE)
            self.canvas.text(at + 0.5, bottom + 17, _text(x), _PALE, size=7.5, anchor="middle")
        for y in round_steps(min_y, max_y, camera.height / _TICK_PX * 1.3):
            at = round(self._place(min_x, y)[1])
            self.canvas.rectangle(self._left, at, camera.width, 1, _GRID)
            self.canvas.rectangle(self._left - 5, at, 5, 1, _PALE)
            self.canvas.text(self._left - 9, at + 4, _text(y), _PALE, size=7.5, anchor="end")
        self.canvas.text(self._left + camera.width, bottom + 32, "x, m", _PALE, size=7.5, anchor="end")
        self.canvas.text(self._left - 9, _TOP - 9, "y, m", _PALE, size=7.5, anchor="end")

    def _graticule(self, azimuth: float) -> None:
        """Draw the coordinates of an oblique view: lines on the ground, numbers at its two near edges."""
        min_x, min_y, max_x, max_y = self._box
        near_x = min_x if math.cos(azimuth) >= -1e-6 else max_x
        near_y = min_y if math.sin(azimuth) >= -1e-6 else max_y
        count = self._camera.scale * max(max_x - min_x, max_y - min_y) / _TICK_PX
        span = max(max_x - min_x, max_y - min_y)
        for x in round_steps(min_x, max_x, count * (max_x - min_x) / span):
            self.canvas.line([self._place(x, min_y), self._place(x, max_y)], _GRID)
            self._beside(x, near_y, 0.0, math.copysign(1.0, near_y - (min_y + max_y) / 2), f"x {_text(x)}")
        for y in round_steps(min_y, max_y, count * (max_y - min_y) / span):
            if abs(y - near_y) < 0.02 * span:
                continue  # where the numbers of x begin
            self.canvas.line([self._place(min_x, y), self._place(max_x, y)], _GRID)
            self._beside(near_x, y, math.copysign(1.0, near_x - (min_x + max_x) / 2), 0.0, f"y {_text(y)}")
        edges = [(min_x, min_y), (max_x, min_y), (max_x, max_y), (min_x, max_y), (min_x, min_y)]
        self.canvas.line([self._place(x, y) for x, y in edges], (190, 196, 202))

    def _beside(self, x: float, y: float, out_x: float, out_y: float, text: str) -> None:
        """Write a text outside an edge of the ground, whose outward direction is given."""
        at, beyond = self._place(x, y), self._place(x + out_x, y + out_y)
        u, v = beyond[0] - at[0], beyond[1] - at[1]
        length = math.hypot(u, v) or 1.0
        u, v = u / length, v / length
        anchor: Anchor = "middle" if abs(u) < 0.35 else "start" if u > 0 else "end"
        self.canvas.line([at, (at[0] + 5 * u, at[1] + 5 * v)], _PALE)
        self.canvas.text(at[0] + 10 * u, at[1] + 10 * v + 4 + 4 * v, text, _PALE, size=7.5, anchor=anchor)

    def mark(self, client: Follower) -> None:
        """Draw a client, its heading and its window."""
        if client.box is not None:
            min_x, min_y, max_x, max_y = client.box
            ring = [(min_x, min_y), (max_x, min_y), (max_x, max_y), (min_x, max_y), (min_x, min_y)]
            if client.is_round:
                x, y, radius = (min_x + max_x) / 2, (min_y + max_y) / 2, (max_x - min_x) / 2
                turns = [2 * math.pi * number / 120 for number in range(121)]
                ring = [(x + radius * math.cos(t), y + radius * math.sin(t)) for t in turns]
            self._dashed([self._place(x, y) for x, y in ring])
        at = self._place(client.x, client.y)
        heading = client.heading
        if heading is None:
            self.canvas.line([at], _WHITE, 17.0)
            self.canvas.line([at], _RED, 13.0)
        else:
            for size, colour in ((17.0, _WHITE), (13.0, _RED)):
                length = size / self._camera.scale
                shape = [(1.0, 0.0), (-0.75, 0.6), (-0.75, -0.6)]
                cos, sin = math.cos(heading), math.sin(heading)
                self.canvas.polygon(
                    [
                        self._place(
                            client.x + (a * cos - b * sin) * length, client.y + (a * sin + b * cos) * length
                        )
                        for a, b in reversed(shape)
                    ],
                    colour,
                )
        self.canvas.text(at[0] + 14, at[1] - 12, client.name, _RED, size=9.0, halo=True)

    def _dashed(self, places: Sequence[tuple[float, float]]) -> None:
        """Draw a line as dashes of 8 pixels."""
        on, left = True, 8.0
        for (x0, y0), (x1, y1) in pairwise(places):
            length, done = math.hypot(x1 - x0, y1 - y0), 0.0
            while done < length:
                step = min(left, length - done)
                ends = [
                    (x0 + (x1 - x0) * part / length, y0 + (y1 - y0) * part / length)
                    for part in (done, done + step)
                ]
                if on:
                    self.canvas.line(ends, _RED, 1.8)
                done += step
                left -= step
                if left <= 1e-9:
                    on, left = not on, 8.0

    def legend(self, name: str, low: float, high: float, ramp: Ramp) -> None:
        """Draw the colours with their values, and the scale bar beside them."""
        width, height = self._view.size
        left, top = width - _RIGHT - _LEGEND_PX - 12, height - 38
        bar = ramp.colours(np.arange(_LEGEND_PX) / (_LEGEND_PX - 1)).astype(np.uint8)
        self.canvas.pixels[top : top + 12, left : left + _LEGEND_PX] = bar[None]
        self.canvas.text(left, top - 7, name, _INK, size=8.0)
        for value in round_steps(low, high, 5):
            at = left + (value - low) / (high - low) * (_LEGEND_PX - 1)
            self.canvas.rectangle(at, top + 12, 1, 4, _PALE)
            self.canvas.text(at + 0.5, top + 29, _text(value), _PALE, size=7.5, anchor="middle")
        metres = round_length(_BAR_PX / self._camera.scale)
        length = metres * self._camera.scale
        right = left - 36
        ends = [(right - length, top + 2), (right - length, top + 10), (right, top + 10), (right, top + 2)]
        self.canvas.line([(round(x) + 0.5, y + 0.5) for x, y in ends], _INK, 1.4)
        self.canvas.text(right - length / 2, top - 7, f"{_text(metres)} m", _INK, size=8.0, anchor="middle")
        self._texts_end = right - max(length, 60.0) - 24

    def title(self, title: str, note: str) -> None:
        """Write two lines at the left, the start of the first left out if it is too long."""
        room = self._texts_end - _RIGHT
        if text_width(title, 9.0) > room:
            while title and text_width("..." + title, 9.0) > room:
                title = title[1:]
            title = "..." + title
        height = self._view.size[1]
        self.canvas.text(_RIGHT, height - 40, title, _INK, size=9.0)
        if text_width(note, 8.0) <= room:
            self.canvas.text(_RIGHT, height - 19, note, _PALE, size=8.0)
