# SPDX-License-Identifier: Apache-2.0
"""What notebooks show of cells: tables and pictures, of any layer, of names and points of every sort."""

from __future__ import annotations

import base64
import io
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from shmmap.client.cell import Cell
from shmmap.client.cell_set import CellSet, PendingLayer
from shmmap.client.notebook import MAX_POINTS
from shmmap.errors import BadRequest, LoadFailed
from shmmap.layers import build_layer

if TYPE_CHECKING:
    from tests.unit.client.conftest import Segments


def cloud(points: int, *, east: float = 0.0) -> dict[str, NDArray[Any]]:
    rng = np.random.default_rng(1)
    xyz = rng.uniform((east, 0, 0), (east + 20, 10, 3), (points, 3)).astype(np.float32)
    return {"xyz": xyz, "intensity": np.zeros(points, np.uint16)}


def picture(text: str | None) -> Image.Image:
    assert text is not None
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', text)
    return Image.open(io.BytesIO(base64.b64decode(data)))


def test_a_cell_is_a_table_and_a_picture_from_above(segments: Segments) -> None:
    text = segments.cell("/map/a<b>.pcd", cloud(500))._repr_html_()
    assert text is not None
    assert "/map/a&lt;b&gt;.pcd" in text
    assert "<td>xyz</td><td>float32</td><td>(500, 3)</td><td>m</td>" in text
    assert "500 points from above" in text
    image = picture(text)
    assert image.size[0] == pytest.approx(320, abs=1)
    assert image.size[1] == pytest.approx(160, abs=2)
    assert np.asarray(image)[..., 3].any()


def test_at_most_twenty_thousand_points_are_drawn(segments: Segments) -> None:
    assert MAX_POINTS == 20_000
    cells = tuple(segments.cell(f"/map/{n}.pcd", cloud(9000, east=20.0 * n)) for n in range(10))
    text = CellSet(cells)._repr_html_()
    assert text is not None
    assert text.count("<tr>") == 10  # a head, eight cells, and the rest in a line
    assert "2 more" in text
    drawn = re.search(r"([\d,]+) points from above", text)
    assert drawn is not None
    assert 15_000 < int(drawn[1].replace(",", "")) <= MAX_POINTS


def test_a_set_says_what_it_lacks(segments: Segments) -> None:
    lacking = CellSet(
        (segments.cell("/map/a.pcd", cloud(3)),),
        failed=(LoadFailed("broken", cell_id="/b", layer="points"),),
        pending=(PendingLayer("/c", "points"),),
        covered=False,
    )
    text = lacking._repr_html_()
    assert text is not None
    assert all(words in text for words in ("1 cell failed", "1 cell pending", "there may be more cells"))


@pytest.mark.parametrize("points", [0, 1])
def test_hardly_any_points(segments: Segments, points: int) -> None:
    text = segments.cell("/map/a.pcd", cloud(points))._repr_html_()
    assert text is not None
    assert ("<img" in text) == bool(points)
    assert CellSet()._repr_html_() is not None


def test_a_layer_without_places_has_no_picture(segments: Segments) -> None:
    counts: dict[str, NDArray[Any]] = {"counts": np.arange(4)}
    cell = segments.cell("/map/a.pcd", counts, layer="counts")
    text = cell._repr_html_()
    assert text is not None
    assert "<img" not in text
    assert repr(cell).endswith(", 4 rows>")


def grid(segments: Segments) -> Cell:
    xyz = np.array([(11, 21, 1), (15, 21, 2), (13, 23, 4), (15, 23, 3)], np.float32)  # of 3 x 2 columns
    return segments.layer("ground(resolution=2.0)", build_layer("ground(resolution=2.0)", xyz))


def test_a_grid_is_drawn_where_it_lies_and_counts_its_occupied_columns(segments: Segments) -> None:
    cell = grid(segments)
    assert (len(cell), cell["min"].shape) == (4, (2, 3))
    assert repr(cell).endswith(", 4 rows>")
    text = cell._repr_html_()
    assert "4 points from above" in (text or "")
    assert "z 1.03 to 3.97 m" in (text or "")
    assert picture(text).size == (320, 160)


def test_tables_over_a_lattice_are_not_gathered(segments: Segments) -> None:
    with pytest.raises(BadRequest, match=r"min of layer ground\(resolution=2.0\) is a table over a lattice"):
        CellSet((grid(segments),)).gather("min")
