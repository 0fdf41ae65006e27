# SPDX-License-Identifier: Apache-2.0
"""The picture is well-formed, to scale, north up, and escapes what it is given."""

from __future__ import annotations

import base64
from xml.etree import ElementTree

import pytest

from shmmap.cli.screens.picture import (
    COORDINATES_PX,
    MARGIN_PX,
    WIDTH_PX,
    CellSquare,
    Raster,
    Vehicle,
    top_view_svg,
)

SVG = "{http://www.w3.org/2000/svg}"
BOUNDS = (-100.0, -50.0, 100.0, 50.0)
SCALE = (WIDTH_PX - 2 * MARGIN_PX - COORDINATES_PX) / 200.0
LEFT = MARGIN_PX + COORDINATES_PX


def draw() -> ElementTree.Element:
    cells = [
        CellSquare((0, 0, 20, 20), "resident", "a <b> & c"),
        CellSquare((-100, -50, -80, -30)),
    ]
    text = top_view_svg(
        BOUNDS,
        cells,
        title="Town <1>",
        note="1 & 2",
        raster=Raster(BOUNDS, b"png bytes"),
        driven=[(0, 0), (50, 0)],
        vehicle=Vehicle(50, 0, 1.5707963267948966, 30),
    )
    return ElementTree.fromstring(text)


def test_cells_lie_where_they_are() -> None:
    on_map = draw().find(f"{SVG}g")
    assert on_map is not None
    squares = {square.get("class"): square for square in on_map.iter(f"{SVG}rect")}
    resident = squares["cell resident"]
    assert float(resident.get("x", 0)) == pytest.approx(LEFT + 100 * SCALE, abs=0.1)
    assert float(resident.get("y", 0)) == pytest.approx(MARGIN_PX + 30 * SCALE, abs=0.1), "north is up"
    assert float(resident.get("width", 0)) == pytest.approx(20 * SCALE, abs=0.1)
    assert resident.findtext(f"{SVG}title") == "a <b> & c"


def test_route_and_vehicle() -> None:
    picture = draw()
    lines = {line.get("class"): line.get("points", "") for line in picture.iter(f"{SVG}polyline")}
    assert len(lines["route"].split()) == 2
    end = [float(v) for v in lines["route"].split()[-1].split(",")]
    assert end == pytest.approx([LEFT + 150 * SCALE, MARGIN_PX + 50 * SCALE], abs=0.1)
    circle = next(c for c in picture.iter(f"{SVG}circle"))
    assert float(circle.get("r", 0)) == pytest.approx(30 * SCALE, abs=0.1)
    vehicle = next(p for p in picture.iter(f"{SVG}path") if p.get("class") == "vehicle")
    assert "rotate(-90.0)" in vehicle.get("transform", ""), "heading north points up"


def test_raster_is_embedded_and_nothing_is_fetched() -> None:
    picture = draw()
    image = next(picture.iter(f"{SVG}image"))
    assert image.get("href") == "data:image/png;base64," + base64.b64encode(b"png bytes").decode()
    links = [v for e in picture.iter() for k, v in e.attrib.items() if k.endswith("href")]
    assert all(link.startswith("data:") for link in links)


def test_legend_names_only_what_is_drawn() -> None:
    text = top_view_svg(BOUNDS, [CellSquare((0, 0, 20, 20))], title="t")
    assert "cell on disk" in text
    assert "zombie</text>" not in text
    assert "route driven" not in text


def test_coordinates_and_names_stand_where_they_belong() -> None:
    cells = [CellSquare((x, y, x + 20, y + 20), "", "", f"{x}_{y}") for x in (0, 20) for y in (-20, 0)]
    drawn = ElementTree.fromstring(top_view_svg(BOUNDS, cells, title="t"))
    texts = {text.text: text for text in drawn.iter(f"{SVG}text")}
    for value in (-100, -50, 0, 50, 100):
        found = [
            e for e in drawn.iter(f"{SVG}text") if e.text == str(value) and e.get("text-anchor") == "middle"
        ]
        assert [float(e.get("x", 0)) for e in found] == pytest.approx([LEFT + (value + 100) * SCALE], abs=0.1)
    name = texts["20_0"]
    assert LEFT + 120 * SCALE < float(name.get("x", 0)) < LEFT + 125 * SCALE
    assert MARGIN_PX + 30 * SCALE < float(name.get("y", 0)) < MARGIN_PX + 35 * SCALE


def test_names_are_left_out_where_one_has_no_room() -> None:
    cells = [CellSquare((x, 0, x + 2, 2), "", "", "long_name") for x in (0, 20)]
    assert "long_name" not in top_view_svg(BOUNDS, cells, title="t")
