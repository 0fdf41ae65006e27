# SPDX-License-Identifier: Apache-2.0
"""Draw SVG pictures: a page, data on axes, rasters, legends and scale bars.

A picture is one file without references.  The names of maps, files and clients in it may contain any
character, so every text and every attribute passes through `escape`.
"""

from __future__ import annotations

import base64
import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias
from xml.sax import saxutils

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.png import png_bytes
from shmmap.logfmt import escaped

BoxTuple: TypeAlias = tuple[float, float, float, float]
Place: TypeAlias = tuple[float, float]
Attribute: TypeAlias = str | float | None

INK: Final = "#1f2933"
PALE: Final = "#66727f"
_RULE: Final = "#ced4da"
_FONT: Final = "system-ui, DejaVu Sans, sans-serif"
_LETTER_PX: Final = 7.6  # average width of a letter of the usual size
_LINE_PX: Final = 22.0
_SYMBOL_PX: Final = 26.0
_ENTRY_GAP_PX: Final = 18.0
_SCALE_BAR_PX: Final = 180.0  # maximum length
_SCALE_PX: Final = _SCALE_BAR_PX + 90.0  # including its label and the space before it
_TICK_PX: Final = 110.0  # pixels between coordinates, at least
_MAX_RASTER: Final = 2400  # pixels along the longer side


def escape(text: str) -> str:
    """Escape text for XML and HTML, as content or in double quotes.

    Characters that are invalid in XML or unprintable become backslash escapes; line breaks stay.
    """
    return saxutils.escape("\n".join(map(escaped, text.split("\n"))), {'"': "&quot;"})


def element(tag: str, content: str = "", /, **attributes: Attribute) -> str:
    """Return an XML element.

    Parameters
    ----------
    content
        Markup inside the element, whose text has passed through `escape`.
    **attributes
        ``stroke_width`` is the attribute ``stroke-width``, ``class_`` is ``class``; numbers have at most two
        decimals, None is left out.
    """
    words = [tag]
    for name, value in attributes.items():
        if value is not None:
            written = escape(value) if isinstance(value, str) else _number(value)
            words.append(f'{name.rstrip("_").replace("_", "-")}="{written}"')
    head = " ".join(words)
    return f"<{head}>{content}</{tag}>" if content else f"<{head}/>"


def tooltip(text: str) -> str:
    """Return the content of an element that shows a text under the pointer; empty for no text."""
    return element("title", escape(text)) if text else ""


def swatch(**attributes: Attribute) -> str:
    """Return a legend's symbol for an area; attributes as in `element`."""
    return element("rect", **attributes, y=-11, width=16, height=13)


def dash(**attributes: Attribute) -> str:
    """Return a legend's symbol for a line; attributes as in `element`."""
    return element("path", **attributes, d="M0 -5h19")


def box_around(places: Sequence[Place]) -> BoxTuple:
    """Return the box around all places, at least one unit a side; at the origin if there are none."""
    x, y = zip(*places, strict=True) if places else ((0.0,), (0.0,))
    return min(x), min(y), max(*x, min(x) + 1.0), max(*y, min(y) + 1.0)


def round_length(longest: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(step * power for step in (1, 2, 5) if step * power <= longest)


def round_steps(low: float, high: float, count: float) -> Iterator[float]:
    """Yield multiples of 1, 2 or 5 times a power of ten from ``low`` to ``high``, at most about ``count``."""
    span, count = max(high - low, 1e-12), max(count, 1.0)
    power = 10.0 ** math.floor(math.log10(span / count))
    step = next(power * factor for factor in (1, 2, 5, 10, 20) if span / (power * factor) <= count)
    for number in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        yield round(number * step, 10)


def _number(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")


class Page:
    """A white page, filled from top to bottom; lengths in pixels, y downwards.

    Parameters
    ----------
    width
        Width of the whole page.
    title
        Title in the file's metadata; `heading` writes a visible one.
    margin
        Space left and right of lines of text.
    style
        CSS for the ``class_`` of elements.
    """

    def __init__(self, width: float, title: str, *, margin: float = 16.0, style: str = "") -> None:
        self.width = width
        self.margin = margin
        self.right = width - margin
        self._parts = [tooltip(title)]
        if style:
            self._parts.append(element("style", style))
        self.add("rect", width="100%", height="100%", fill="#ffffff")

    def svg(self, height: float) -> str:
        """Return the file's text; ``height`` is the height of the whole page."""
        content = "\n".join(["", *self._parts, ""])
        width, height = round(self.width), round(height)
        size: dict[str, Attribute] = {"width": width, "height": height, "viewBox": f"0 0 {width} {height}"}
        fonts: dict[str, Attribute] = {"font_family": _FONT, "font_size": 14, "fill": INK}
        return element("svg", content, xmlns="http://www.w3.org/2000/svg", role="img", **size, **fonts) + "\n"

    def add(self, tag: str, content: str = "", /, **attributes: Attribute) -> None:
        """Add an `element`."""
        self._parts.append(element(tag, content, **attributes))

    @contextlib.contextmanager
    def group(self, **attributes: Attribute) -> Iterator[None]:
        """Put everything added inside the context into one group."""
        before, self._parts = self._parts, []
        yield
        before.append(element("g", "\n".join(["", *self._parts, ""]), **attributes))
        self._parts = before

    def text(self, x: float, y: float, text: str, /, **attributes: Attribute) -> None:
        """Write one line of text with its baseline at ``y``."""
        self.add("text", escape(text), **attributes, x=x, y=y)

    def heading(self, y: float, title: str, note: str = "") -> None:
        """Write a title and a note below it."""
        self.text(self.margin, y, title, font_size=18, font_weight=600)
        if note:
            self.text(self.margin, y + _LINE_PX, note, fill=PALE)

    def image(self, png: bytes, /, **attributes: Attribute) -> None:
        """Embed a PNG; the attributes include ``x``, ``y``, ``width`` and ``height``."""
        data = base64.b64encode(png).decode("ascii")
        self.add("image", **attributes, preserveAspectRatio="none", href=f"data:image/png;base64,{data}")

    def legend(
        self, y: float, entries: Iterable[tuple[str, str]], *, left: float = 0.0, spare: float = 0.0
    ) -> float:
        """Write a legend in as many lines as needed; return the baseline of the last.

        Parameters
        ----------
        y
            Baseline of the first line.
        entries
            Pairs of a symbol, as returned by `swatch` or `dash`, and its text.
        left, spare
            Widths kept free at the start and end of the lines, inside the margins.
        """
        start = self.margin + left
        x = start
        for symbol, text in entries:
            width = _SYMBOL_PX + _LETTER_PX * len(text)
            if x > start and x + width > self.right - spare:
                x, y = start, y + _LINE_PX
            label = element("text", escape(text), x=_SYMBOL_PX)
            self.add("g", symbol + label, transform=f"translate({_number(x)} {_number(y)})")
            x += width + _ENTRY_GAP_PX
        return y


@dataclass(frozen=True, slots=True)
class Axes:
    """A rectangle of a page that shows data: x to the right, y upwards, both linear.

    Parameters
    ----------
    page
        The page.
    box
        Data values at the rectangle's edges: min_x, min_y, max_x, max_y.
    left, top, width, height
        Position and size of the rectangle, pixels.
    """

    page: Page
    box: BoxTuple
    left: float
    top: float
    width: float
    height: float

    @classmethod
    def fitted(cls, page: Page, box: BoxTuple, top: float, max_height: float, *, left: float = 0.0) -> Axes:
        """Return axes with one scale for x and y: as large as fits, centred on the page.

        Parameters
        ----------
        top, max_height
            Vertical space available, pixels; horizontally it is from margin to margin.
        left
            Space kept free at the left, for `coordinates`.
        """
        max_width = page.right - page.margin - left
        span_x, span_y = max(box[2] - box[0], 1e-9), max(box[3] - box[1], 1e-9)
        scale = min(max_width / span_x, max_height / span_y)
        width = span_x * scale
        start = page.margin + left + (max_width - width) / 2
        return cls(page, box, start, top, width, span_y * scale)

    @property
    def bottom(self) -> float:
        """Lower edge, pixels."""
        return self.top + self.height

    @property
    def scale(self) -> float:
        """Pixels along x for one unit of the data."""
        return self.width / max(self.box[2] - self.box[0], 1e-9)

    def place(self, x: float, y: float) -> Place:
        """Return the position of a value on the page, pixels."""
        min_x, min_y, max_x, max_y = self.box
        return (
            self.left + (x - min_x) / max(max_x - min_x, 1e-9) * self.width,
            self.top + (max_y - y) / max(max_y - min_y, 1e-9) * self.height,
        )

    def points(self, places: Iterable[Place]) -> str:
        """Return an attribute ``points`` with the places, without those that are not finite."""
        pixels = (self.place(x, y) for x, y in places if math.isfinite(x) and math.isfinite(y))
        return " ".join(f"{_number(x)},{_number(y)}" for x, y in pixels)

    def line(self, places: Iterable[Place], /, **attributes: Attribute) -> None:
        """Draw a line through places."""
        if points := self.points(places):
            self.page.add("polyline", **attributes, points=points, fill="none", stroke_linejoin="round")

    def dot(self, x: float, y: float, radius: float, content: str = "", /, **attributes: Attribute) -> None:
        """Draw a circle; its radius is in pixels."""
        at_x, at_y = self.place(x, y)
        self.page.add("circle", content, **attributes, cx=at_x, cy=at_y, r=radius)

    def rectangle(self, box: BoxTuple, content: str = "", /, **attributes: Attribute) -> None:
        """Draw a box."""
        self.page.add("rect", content, **attributes, **self._extent(box))

    def rectangles(self, boxes: Iterable[BoxTuple], /, **attributes: Attribute) -> None:
        """Draw boxes of one style, as one element."""
        steps = []
        for box in boxes:
            x, y, width, height = map(_number, self._extent(box).values())
            steps.append(f"M{x} {y}h{width}v{height}h-{width}z")
        if steps:
            self.page.add("path", **attributes, d="".join(steps))

    def image(self, box: BoxTuple, png: bytes) -> None:
        """Fill a box with a PNG."""
        self.page.image(png, **self._extent(box))

    def raster(self, layers: Sequence[tuple[NDArray[np.int64], Any]], pixel: float) -> None:
        """Draw equal squares as one image; of several at one place the last is visible.

        Parameters
        ----------
        layers
            Squares (N, 2) and their RGBA colours, (N, 4) or one for all.  Square (i, j) has its lower left
            corner at i and j times ``pixel``.
        pixel
            Side of a square, in units of the data.  Enlarged if there would be too many pixels.
        """
        squares = np.concatenate([places for places, _ in layers])
        if not len(squares):
            return
        low = squares.min(axis=0)
        span = squares.max(axis=0) - low + 1
        coarse = max(1, math.ceil(int(span.max()) / _MAX_RASTER))
        columns, rows = (int(count) for count in -(-span // coarse))
        image = np.zeros((rows, columns, 4), np.uint8)
        for places, colours in layers:
            at = (places - low) // coarse
            image[rows - 1 - at[:, 1], at[:, 0]] = colours
        west, south = (float(value) * pixel for value in low)
        size = pixel * coarse
        extent = self._extent((west, south, west + columns * size, south + rows * size))
        self.page.image(png_bytes(image), image_rendering="pixelated", **extent)

    @contextlib.contextmanager
    def clipped(self) -> Iterator[None]:
        """Clip what is drawn inside the context to the rectangle."""
        self.page.add("clipPath", element("rect", **self._extent(self.box)), id="axes")
        with self.page.group(clip_path="url(#axes)"):
            yield

    def frame(
        self,
        title: str,
        *,
        y_labels: Iterable[tuple[float, str]] = (),
    ) -> None:
        """Draw a chart's title, baseline, and labels of values to the left of the chart."""
        small: dict[str, Attribute] = {"font_size": 12, "fill": PALE}
        self.page.text(self.left, self.top - 9, title, **small)
        self.page.add(
            "path", d=f"M{_number(self.left)} {_number(self.bottom)}h{_number(self.width)}", stroke=_RULE
        )
        for value, text in y_labels:
            self.page.text(self.left - 7, self.place(0, value)[1] + 4, text, text_anchor="end", **small)

    def coordinates(self, **attributes: Attribute) -> None:
        """Write round values below and to the left of the rectangle, each at a short mark."""
        min_x, min_y, max_x, max_y = self.box
        marks = []
        for value in round_steps(min_x, max_x, self.width / _TICK_PX):
            x, _ = self.place(value, min_y)
            marks.append(f"M{_number(x)} {_number(self.bottom)}v5")
            self.page.text(x, self.bottom + 19, f"{value:.10g}", text_anchor="middle", **attributes)
        for value in round_steps(min_y, max_y, self.height / _TICK_PX):
            _, y = self.place(min_x, value)
            marks.append(f"M{_number(self.left)} {_number(y)}h-5")
            self.page.text(self.left - 9, y + 4, f"{value:.10g}", text_anchor="end", **attributes)
        self.page.add("path", d="".join(marks), stroke=PALE)

    def scale_bar(self, y: float) -> None:
        """Draw a scale bar of 1, 2 or 5 times a power of ten metres at the right, its label to the left.

        Parameters
        ----------
        y
            Baseline of the label.
        """
        right = self.page.right
        metres = round_length(_SCALE_BAR_PX / self.scale)
        length = metres * self.scale
        bar = f"M{_number(right - length)} {_number(y - 10)}v7h{_number(length)}v-7"
        self.page.add("path", d=bar, fill="none", stroke=INK, stroke_width=1.6)
        self.page.text(right - length - 8, y, f"{metres:g} m", text_anchor="end")

    def legend(self, y: float, entries: Iterable[tuple[str, str]], *, left: float = 0.0) -> float:
        """Write a legend as `Page.legend`, with the scale bar at the end of its first line."""
        self.scale_bar(y)
        return self.page.legend(y, entries, left=left, spare=_SCALE_PX)

    def _extent(self, box: BoxTuple) -> dict[str, float]:
        (x, y), (right, bottom) = self.place(box[0], box[3]), self.place(box[2], box[1])
        return {"x": x, "y": y, "width": right - x, "height": bottom - y}
