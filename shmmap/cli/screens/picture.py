# SPDX-License-Identifier: Apache-2.0
"""A top view of a map as SVG: cells and their state, a route, a vehicle and its window.

The picture is one file without references: a raster of the points, where there is one, is embedded.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias
from xml.sax import saxutils

from shmmap.cli.screens.output import printable

__all__ = ["CellSquare", "Raster", "Vehicle", "WindowBox", "top_view_svg"]

BoxTuple: TypeAlias = tuple[float, float, float, float]

WIDTH_PX: Final = 960.0
MARGIN_PX: Final = 16.0
CAPTION_PX: Final = 72.0
LABEL_PX: Final = 16.0  # labels nearer than a line to one another could not be read

_STYLE: Final = """
  text { font-family: system-ui, "DejaVu Sans", sans-serif; font-size: 14px; fill: #1f2933; }
  .label { font-size: 13px; stroke: #fff; stroke-width: 3; paint-order: stroke; }
  .title { font-size: 17px; font-weight: 600; }
  .cell { fill: none; stroke: #52606d; stroke-opacity: .28; stroke-width: .6; }
  .resident { fill: #0b7285; fill-opacity: .20; stroke: #0b7285; stroke-opacity: .75; stroke-width: .9; }
  .fetched { fill: #5f3dc4; fill-opacity: .18; stroke: #5f3dc4; stroke-opacity: .75; stroke-width: .9; }
  .stale { fill: #e8590c; fill-opacity: .30; stroke: #e8590c; stroke-width: .9; }
  .zombie { fill: #868e96; fill-opacity: .40; stroke: #495057; stroke-width: .9; stroke-dasharray: 3 2; }
  .saved { stroke: #9aa5b1; stroke-opacity: .8; }
  .clean { fill: #2f9e44; fill-opacity: .22; stroke: #2f9e44; stroke-opacity: .8; }
  .dirty { fill: #2563eb; fill-opacity: .22; stroke: #2563eb; stroke-opacity: .8; }
  .saving { fill: #0e9db8; fill-opacity: .26; stroke: #0e9db8; stroke-opacity: .8; }
  .loading { fill: #111418; fill-opacity: .30; stroke: #111418; stroke-opacity: .8; }
  .route { fill: none; stroke: #c92a2a; stroke-width: 2.4; stroke-linejoin: round; stroke-linecap: round; }
  .ahead { stroke-dasharray: 1 6; }
  .window { fill: none; stroke: #c92a2a; stroke-width: 1.6; stroke-dasharray: 7 5; }
  .vehicle { fill: #c92a2a; stroke: #fff; stroke-width: 1.5; }
  .scale { stroke: #1f2933; stroke-width: 2; fill: none; }
"""


@dataclass(frozen=True, slots=True)
class CellSquare:
    """One cell: its box (metres), its state (a class of `_STYLE`, or empty) and a tooltip."""

    box: BoxTuple
    state: str = ""
    title: str = ""


@dataclass(frozen=True, slots=True)
class Raster:
    """A PNG that fills ``box`` (metres), north up."""

    box: BoxTuple
    png: bytes


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Where a vehicle is (metres), where it heads (radians from x to y), how far it looks; a tooltip.

    ``heading`` None is not known, ``radius`` 0 draws no window; ``label`` is written beside it.
    """

    x: float
    y: float
    heading: float | None
    radius: float
    title: str = ""
    label: str = ""


@dataclass(frozen=True, slots=True)
class WindowBox:
    """A rectangle (metres) that somebody follows."""

    box: BoxTuple
    title: str = ""


def escape(text: str) -> str:
    """Return text for XML, which cannot hold control characters at all: line breaks stay."""
    return saxutils.escape("\n".join(map(printable, text.split("\n"))))


class _Page:
    """Turns metres (y up) into pixels (y down)."""

    def __init__(self, bounds: BoxTuple) -> None:
        self.min_x, self.min_y, self.max_x, self.max_y = bounds
        span_x = max(self.max_x - self.min_x, 1e-9)
        self.scale = (WIDTH_PX - 2 * MARGIN_PX) / span_x
        self.map_height = (self.max_y - self.min_y) * self.scale
        self.height = self.map_height + 2 * MARGIN_PX + CAPTION_PX

    def x(self, metres: float) -> float:
        return MARGIN_PX + (metres - self.min_x) * self.scale

    def y(self, metres: float) -> float:
        return MARGIN_PX + (self.max_y - metres) * self.scale

    def rectangle(self, box: BoxTuple) -> str:
        width, height = (box[2] - box[0]) * self.scale, (box[3] - box[1]) * self.scale
        return f'x="{self.x(box[0]):.1f}" y="{self.y(box[3]):.1f}" width="{width:.1f}" height="{height:.1f}"'

    def points(self, line: Iterable[tuple[float, float]]) -> str:
        return " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in line)


def top_view_svg(
    bounds: BoxTuple,
    cells: Sequence[CellSquare],
    *,
    title: str,
    note: str = "",
    raster: Raster | None = None,
    driven: Sequence[tuple[float, float]] = (),
    ahead: Sequence[tuple[float, float]] = (),
    vehicle: Vehicle | None = None,
    others: Sequence[Vehicle] = (),
    windows: Sequence[WindowBox] = (),
) -> str:
    """Return the picture.

    Parameters
    ----------
    bounds
        What the picture shows, metres, map frame.
    cells
        Drawn in order; those with a state on top of those without.
    title, note
        Two lines below the map.
    raster
        The ground: points seen from above.
    driven, ahead
        The route behind and before the vehicle, (x, y) each, metres.
    vehicle, others
        The one that drove the route, and more.
    windows
        Rectangles that are followed.
    """
    page = _Page(bounds)
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH_PX:.0f}" height="{page.height:.0f}"'
            f' viewBox="0 0 {WIDTH_PX:.0f} {page.height:.0f}" role="img">'
        ),
        f"<title>{escape(title)}</title>",
        f"<style>{_STYLE}</style>",
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        f'<clipPath id="map"><rect {page.rectangle(bounds)}/></clipPath>',
        '<g clip-path="url(#map)">',
    ]
    if raster is not None:
        data = base64.b64encode(raster.png).decode("ascii")
        parts.append(
            f'<image {page.rectangle(raster.box)} preserveAspectRatio="none" image-rendering="auto"'
            f' href="data:image/png;base64,{data}"/>'
        )
    for cell in sorted(cells, key=lambda cell: bool(cell.state)):
        tooltip = f"<title>{escape(cell.title)}</title>" if cell.title else ""
        parts.append(f'<rect class="cell {cell.state}" {page.rectangle(cell.box)}>{tooltip}</rect>')
    if ahead:
        parts.append(f'<polyline class="route ahead" points="{page.points(ahead)}"/>')
    if driven:
        parts.append(f'<polyline class="route" points="{page.points(driven)}"/>')
    for window in windows:
        tooltip = f"<title>{escape(window.title)}</title>"
        parts.append(f'<rect class="window" {page.rectangle(window.box)}>{tooltip}</rect>')
    for one in _labelled_apart(page, [*others, *([vehicle] if vehicle is not None else [])]):
        parts += _vehicle(page, one)
    parts += [
        "</g>",
        *_caption(page, title, note, {cell.state for cell in cells}, bool(driven), bool(others or windows)),
        "</svg>",
        "",
    ]
    return "\n".join(parts)


def _labelled_apart(page: _Page, vehicles: Sequence[Vehicle]) -> list[Vehicle]:
    """Join the labels of those that stand on one another, as the programs of one vehicle do."""
    found: list[Vehicle] = []
    for vehicle in vehicles:
        for index, other in enumerate(found):
            apart_px = math.hypot(vehicle.x - other.x, vehicle.y - other.y) * page.scale
            if other.label and apart_px < LABEL_PX:
                vehicle = replace(vehicle, label=f"{other.label}, {vehicle.label}".rstrip(", "))
                found[index] = replace(other, label="")
        found.append(vehicle)
    return found


def _vehicle(page: _Page, vehicle: Vehicle) -> list[str]:
    x, y = page.x(vehicle.x), page.y(vehicle.y)
    tooltip = f"<title>{escape(vehicle.title)}</title>" if vehicle.title else ""
    parts = []
    if vehicle.radius > 0:
        radius = vehicle.radius * page.scale
        parts.append(f'<circle class="window" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>')
    if vehicle.heading is None:
        parts.append(f'<circle class="vehicle" cx="{x:.1f}" cy="{y:.1f}" r="7">{tooltip}</circle>')
    else:
        turn = -math.degrees(vehicle.heading)
        parts.append(
            f'<path class="vehicle" transform="translate({x:.1f} {y:.1f}) rotate({turn:.1f})"'
            f' d="M 12 0 L -8 7 L -4 0 L -8 -7 Z">{tooltip}</path>'
        )
    if vehicle.label:
        parts.append(f'<text class="label" x="{x + 12:.1f}" y="{y - 8:.1f}">{escape(vehicle.label)}</text>')
    return parts


def _caption(
    page: _Page, title: str, note: str, states: set[str], with_route: bool, with_clients: bool
) -> list[str]:
    top = page.map_height + 2 * MARGIN_PX
    bar_m = _round_length(0.18 * (page.max_x - page.min_x))
    right = WIDTH_PX - MARGIN_PX
    left = right - bar_m * page.scale
    parts = [
        f'<text class="title" x="{MARGIN_PX:.0f}" y="{top + 12:.0f}">{escape(title)}</text>',
        f'<text x="{MARGIN_PX:.0f}" y="{top + 34:.0f}">{escape(note)}</text>',
        f'<path class="scale" d="M {left:.1f} {top + 42:.0f} v 6 H {right:.1f} v -6"/>',
        f'<text x="{(left + right) / 2:.1f}" y="{top + 65:.0f}" text-anchor="middle">{bar_m:g} m</text>',
    ]
    x, y = MARGIN_PX, top + 58
    for label, symbol in _legend(states, with_route, with_clients):
        parts.append(f'<g transform="translate({x:.0f} {y:.0f})">{symbol}<text x="26">{label}</text></g>')
        x += 44 + 7.6 * len(label)
    return parts


def _legend(states: set[str], with_route: bool, with_clients: bool) -> list[tuple[str, str]]:
    square = '<rect class="cell {}" y="-11" width="16" height="13"/>'
    names = {
        "": "cell on disk",
        "resident": "cell in shared memory",
        "fetched": "fetched ahead",
        "stale": "stale cell",
        "zombie": "zombie",
        "saved": "chunk on disk",
        "clean": "in memory, saved",
        "dirty": "not saved yet",
        "saving": "being saved",
        "loading": "being loaded",
    }
    entries = [(label, square.format(state)) for state, label in names.items() if state in states]
    if with_route:
        entries.append(("route driven", '<path class="route" d="M 0 -5 h 18"/>'))
    if with_clients:
        entries.append(("client", '<circle class="vehicle" cx="9" cy="-5" r="6"/>'))
    if with_route or with_clients:
        entries.append(("window", '<path class="window" d="M 0 -5 h 19"/>'))
    return entries


def _round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``length``."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(step * power for step in (1, 2, 5) if step * power <= length)
