# SPDX-License-Identifier: Apache-2.0
"""SVG pages stay XML, lie to scale, and have legends that fit; PNG images are what Pillow reads."""

from __future__ import annotations

import io
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from shmmap import BadRequest
from shmmap.formats.png import PngWriter, png_bytes
from shmmap.formats.svg import Axes, Page, box_around, element, swatch, tooltip
from tests.support.pictures import SVG, png_pixels

HOSTILE = "a<b>&\"c'\x00\x1b[31m\udcff\ufffe\nnext"
BOX = (-100.0, -50.0, 100.0, 50.0)


def parsed(page: Page, height: float = 500.0) -> ElementTree.Element:
    return ElementTree.fromstring(page.svg(height))


def test_any_text_stays_xml() -> None:
    page = Page(300, HOSTILE)
    page.heading(20, HOSTILE, HOSTILE)
    page.legend(60, [(swatch(), HOSTILE)])
    page.add("rect", tooltip(HOSTILE), class_=HOSTILE)
    root = parsed(page)
    shown = "a<b>&\"c'\\x00\\x1b[31m\\udcff\\ufffe\nnext"
    assert [title.text for title in root.iter(f"{SVG}title")] == [shown, shown]
    assert [text.text for text in root.iter(f"{SVG}text")] == [shown] * 3
    assert next(rect for rect in root.iter(f"{SVG}rect") if rect.get("class")).get("class") == shown.replace(
        "\n", " "
    )


def test_elements_and_their_numbers() -> None:
    assert (
        element("g", class_="a b", stroke_width=1.504, x=-3.0, y=None)
        == '<g class="a b" stroke-width="1.5" x="-3"/>'
    )
    root = parsed(Page(300, "t"), 99.6)
    assert (root.get("viewBox"), root.get("width"), root.get("height")) == ("0 0 300 100", "300", "100")


def test_maps_have_one_scale_and_charts_two() -> None:
    page = Page(1032, "t", margin=16)
    wide = Axes.fitted(page, BOX, 10, 2000)
    assert wide.scale == 5.0
    assert wide.place(-100, 50) == (16, 10)
    assert wide.place(100, -50) == (1016, 510)
    high = Axes.fitted(page, BOX, 10, 100)
    assert high.scale == 1.0
    assert high.place(0, 0) == (516, 60), "in the middle between the margins"
    chart = Axes(page, (0.0, 0.0, 60.0, 4.0), 100, 200, 600, 80)
    assert chart.place(30, 1) == (400, 260)


def test_what_is_not_finite_is_left_out() -> None:
    page = Page(100, "t", margin=0)
    axes = Axes(page, (0.0, 0.0, 10.0, 10.0), 0, 0, 100, 100)
    axes.line([(0, 0), (5, math.nan), (math.inf, 3), (10, 10)])
    axes.line([])
    (line,) = parsed(page).iter(f"{SVG}polyline")
    assert line.get("points") == "0,100 100,0"
    assert box_around([]) == (0.0, 0.0, 1.0, 1.0)
    assert box_around([(3.0, 4.0), (5.0, 4.5)]) == (3.0, 4.0, 5.0, 5.0)


def test_a_legend_s_entries_lie_beside_one_another_inside_the_page() -> None:
    page = Page(400, "t")
    entries = [(swatch(), "x" * length) for length in (12, 20, 5, 30, 1)]
    last = page.legend(40, entries, spare=50)
    places = [
        tuple(map(float, re.findall(r"[\d.]+", group.attrib["transform"])))
        for group in parsed(page).iter(f"{SVG}g")
    ]
    assert last == places[-1][1] > 40
    ends = [x + 26 + 7 * len(text) for (x, _), (_, text) in zip(places, entries, strict=True)]
    for (x, y), (next_x, next_y), end in zip(places, places[1:], ends, strict=False):
        assert next_x > end if next_y == y else (next_x == 16 and next_y > y + 14)
        assert x >= 16
    assert max(ends) <= 400 - 16 - 50


@pytest.mark.parametrize(
    ("span_m", "label"), [(5.0, "0.5 m"), (70.0, "10 m"), (130.0, "20 m"), (3000.0, "500 m")]
)
def test_the_scale_bar_is_as_long_as_it_says(span_m: float, label: str) -> None:
    page = Page(1000, "t", margin=0)
    axes = Axes.fitted(page, (0.0, 0.0, span_m, span_m), 0, 1000)
    axes.legend(30, [])
    root = parsed(page)
    (text,) = (text.text for text in root.iter(f"{SVG}text"))
    (bar,) = (path.attrib["d"] for path in root.iter(f"{SVG}path"))
    left, length = map(float, re.findall(r"^M([\d.]+) .*h([\d.]+)v", bar)[0])
    assert text == label
    assert length == pytest.approx(float(label.split()[0]) * axes.scale, abs=0.01)
    assert left + length == pytest.approx(1000)
    assert 50 < length <= 180


# --- PNG images -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_there_and_back(channels: int, dtype: type[np.unsignedinteger]) -> None:
    shape = (7, 11) if channels == 1 else (7, 11, channels)
    pixels = np.random.default_rng(channels).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    read = png_pixels(png_bytes(pixels), ["", "LA", "RGB", "RGBA"][channels - 1])
    if read.dtype == np.uint8 and dtype == np.uint16:
        pixels = pixels >> 8  # Pillow reads the upper byte of several channels
    assert np.array_equal(read, pixels)


def test_png_row_by_row() -> None:
    file = io.BytesIO()
    writer = PngWriter(file, 5, 4)
    writer.add(np.zeros((3, 5), np.uint8))
    with pytest.raises(BadRequest):
        writer.finish()
    with pytest.raises(BadRequest):
        writer.add(np.zeros((2, 5), np.uint8))
    with pytest.raises(BadRequest):
        writer.add(np.zeros((1, 6), np.uint8))
    writer.add(np.full((1, 5), 9, np.uint8))
    writer.finish()
    assert png_pixels(file.getvalue())[:, 0].tolist() == [0, 0, 0, 9]
