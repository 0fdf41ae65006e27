# SPDX-License-Identifier: Apache-2.0
"""A top view of a map as SVG: cells and their state, a route, a vehicle and its window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from shmmap.formats.svg import Axes, BoxTuple, Page, dash, element, swatch, tooltip

WIDTH_PX: Final = 960.0
HEIGHT_PX: Final = 1400.0  # pixels of the map, at most
MARGIN_PX: Final = 16.0
COORDINATES_PX: Final = 52.0  # to the left of the map
NAME_LETTER_PX: Final = 5.6  # average width of a letter of a cell's name
LABEL_PX: Final = 16.0  # labels closer than a line would overlap

_STYLE: Final = """
  .label { font-size: 13px; stroke: #fff; stroke-width: 3; paint-order: stroke; }
  .coordinate { font-size: 12px; fill: #66727f; }
  .name { font-size: 9px; fill: #3e4c59; pointer-events: none; }
  .cell { fill: none; stroke: #52606d; stroke-opacity: .28; stroke-width: .6; }
  .resident { fill: #0b7285; fill-opacity: .20; stroke: #0b7285; stroke-opacity: .75; stroke-width: .9; }
  .ahead { fill: #5f3dc4; fill-opacity: .18; stroke: #5f3dc4; stroke-opacity: .75; stroke-width: .9; }
  .stale { fill: #e8590c; fill-opacity: .30; stroke: #e8590c; stroke-width: .9; }
  .retired { fill: #868e96; fill-opacity: .40; stroke: #495057; stroke-width: .9; stroke-dasharray: 3 2; }
  .saved { stroke: #9aa5b1; stroke-opacity: .8; }
  .clean { fill: #2f9e44; fill-opacity: .22; stroke: #2f9e44; stroke-opacity: .8; }
  .dirty { fill: #2563eb; fill-opacity: .22; stroke: #2563eb; stroke-opacity: .8; }
  .saving { fill: #0e9db8; fill-opacity: .26; stroke: #0e9db8; stroke-opacity: .8; }
  .loading { fill: #111418; fill-opacity: .30; stroke: #111418; stroke-opacity: .8; }
  .route { fill: none; stroke: #c92a2a; stroke-width: 2.4; stroke-linejoin: round; stroke-linecap: round; }
  .window { fill: none; stroke: #c92a2a; stroke-width: 1.6; stroke-dasharray: 7 5; }
  .vehicle { fill: #c92a2a; stroke: #fff; stroke-width: 1.5; }
"""
_STATES: Final = {
    "": "cell on disk",
    "resident": "cell in shared memory",
    "ahead": "fetched ahead",
    "stale": "stale cell",
    "retired": "retired cell",
    "saved": "chunk on disk",
    "clean": "in memory, saved",
    "dirty": "not saved yet",
    "saving": "being saved",
    "loading": "being loaded",
}
"""States of cells and of live chunks: classes of `_STYLE`, and their names in the legend."""


@dataclass(frozen=True, slots=True)
class CellSquare:
    """One cell: its box (metres), its state (one of `_STATES`), a tooltip, and the name written in it."""

    box: BoxTuple
    state: str = ""
    title: str = ""
    name: str = ""


@dataclass(frozen=True, slots=True)
class Raster:
    """A PNG that fills ``box`` (metres), north up."""

    box: BoxTuple
    png: bytes


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle: position (metres), heading (radians from x to y), radius of its window, tooltip, label.

    ``heading`` is None if unknown; with ``radius`` 0 no window is drawn; ``label`` is written beside the
    vehicle.
    """

    x: float
    y: float
    heading: float | None
    radius: float
    title: str = ""
    label: str = ""


def top_view_svg(
    bounds: BoxTuple,
    cells: Sequence[CellSquare],
    *,
    title: str,
    note: str = "",
    raster: Raster | None = None,
    driven: Sequence[tuple[float, float]] = (),
    vehicle: Vehicle | None = None,
    others: Sequence[Vehicle] = (),
    windows: Sequence[tuple[BoxTuple, str]] = (),
) -> str:
    """Draw the map from above; return the SVG text.

    Parameters
    ----------
    bounds
        Area of the picture, metres, map frame.
    cells
        Cells, drawn in order; cells with a state are drawn on top.
    title, note
        Two lines below the map.
    raster
        The ground: points seen from above.
    driven
        The route behind the vehicle, (x, y) each, metres.
    vehicle, others
        The vehicle that drove the route, and further ones.
    windows
        Rectangles that clients follow, metres, and their tooltips.
    """
    page = Page(WIDTH_PX, title, margin=MARGIN_PX, style=_STYLE)
    axes = Axes.fitted(page, bounds, MARGIN_PX, HEIGHT_PX, left=COORDINATES_PX)
    with axes.clipped():
        if raster is not None:
            axes.image(raster.box, raster.png)
        for cell in sorted(cells, key=lambda cell: bool(cell.state)):
            axes.rectangle(cell.box, tooltip(cell.title), class_=f"cell {cell.state}")
        _write_names(axes, cells)
        axes.line(driven, class_="route")
        for box, words in windows:
            axes.rectangle(box, tooltip(words), class_="window")
        for one in _labelled_apart(axes, [*others, *([vehicle] if vehicle is not None else [])]):
            _draw_vehicle(axes, one)
    axes.coordinates(class_="coordinate")
    page.heading(axes.bottom + 52, title, note)
    states = {cell.state for cell in cells}
    entries = [(swatch(class_=f"cell {state}"), text) for state, text in _STATES.items() if state in states]
    if driven:
        entries.append((dash(class_="route"), "route driven"))
    if others or windows:
        entries.append((element("circle", class_="vehicle", cx=9, cy=-5, r=6), "client"))
    if driven or others or windows:
        entries.append((dash(class_="window"), "window"))
    return page.svg(axes.legend(axes.bottom + 100, entries) + 16)


def _write_names(axes: Axes, cells: Sequence[CellSquare]) -> None:
    """Write the names of cells into their corners, if there is room for all."""
    if all(len(cell.name) * NAME_LETTER_PX + 4 <= (cell.box[2] - cell.box[0]) * axes.scale for cell in cells):
        for cell in cells:
            if cell.name:
                x, y = axes.place(cell.box[0], cell.box[3])
                axes.page.text(x + 3, y + 10, cell.name, class_="name")


def _labelled_apart(axes: Axes, vehicles: Sequence[Vehicle]) -> list[Vehicle]:
    """Join the labels of vehicles at the same place, such as several programs of one vehicle."""
    found: list[Vehicle] = []
    for vehicle in vehicles:
        for index, other in enumerate(found):
            apart_px = math.hypot(vehicle.x - other.x, vehicle.y - other.y) * axes.scale
            if other.label and apart_px < LABEL_PX:
                vehicle = replace(vehicle, label=f"{other.label}, {vehicle.label}".rstrip(", "))
                found[index] = replace(other, label="")
        found.append(vehicle)
    return found


def _draw_vehicle(axes: Axes, vehicle: Vehicle) -> None:
    x, y = axes.place(vehicle.x, vehicle.y)
    if vehicle.radius > 0:
        axes.dot(vehicle.x, vehicle.y, vehicle.radius * axes.scale, class_="window")
    if vehicle.heading is None:
        axes.dot(vehicle.x, vehicle.y, 7, tooltip(vehicle.title), class_="vehicle")
    else:
        turn = -math.degrees(vehicle.heading)
        axes.page.add(
            "path",
            tooltip(vehicle.title),
            class_="vehicle",
            d="M 12 0 L -8 7 L -4 0 L -8 -7 Z",
            transform=f"translate({x:.1f} {y:.1f}) rotate({turn:.1f})",
        )
    if vehicle.label:
        axes.page.text(x + 12, y - 8, vehicle.label, class_="label")
