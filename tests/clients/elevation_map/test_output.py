# SPDX-License-Identifier: Apache-2.0
"""Files as other programs read them."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image
from shmmap_clients.elevation_map import holes
from shmmap_clients.elevation_map.grid import ElevationGrid
from shmmap_clients.elevation_map.output import hillshade, write_elevation, write_hillshade

from shmmap import BadRequest

Made = tuple[ElevationGrid, NDArray[np.float32]]
DOCUMENT = {"map_version": "0123456789abcdef"}


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """A grid of two by two tiles, a third of it holes, and what filling within 0.6 m gives."""
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.arange(300), np.arange(270))
    heights = (700 + np.sin(x / 20) * 3 + y * 0.02).astype(np.float32)
    heights[rng.random(heights.shape) < 0.3] = np.nan
    heights[50:120, 30:90] = np.nan
    grid = ElevationGrid.create(tmp_path / "grid", 0.3, (-100, 40), heights.shape)
    j, i = np.nonzero(~np.isnan(heights))
    grid.put(i - 100, j + 40, heights[j, i].astype(np.float64))
    return grid, holes.fill_holes(heights, 2.0)


def test_npz(made: Made, tmp_path: Path) -> None:
    grid, expected = made
    write_elevation(tmp_path / "e.npz", grid, 0.6, DOCUMENT)
    with np.load(tmp_path / "e.npz", allow_pickle=False) as read:
        assert np.array_equal(read["height"], expected, equal_nan=True)
        assert read["height"].dtype == np.float32
        assert np.array_equal(read["kind"] == 0, np.isnan(expected))
        assert float(read["resolution"]) == 0.3
        assert np.allclose(read["origin"], (-30.0, 12.0))
        assert json.loads(str(read["document"])) == DOCUMENT
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".tmp")]


def test_geotiff(made: Made, tmp_path: Path) -> None:
    grid, expected = made
    write_elevation(tmp_path / "e.tif", grid, 0.6, DOCUMENT, epsg=32632)
    with tifffile.TiffFile(tmp_path / "e.tif") as file:
        page = file.pages[0]
        assert np.array_equal(page.asarray(), expected[::-1], equal_nan=True)
        assert page.is_tiled
        assert page.tags[33550].value == (0.3, 0.3, 0.0)
        assert np.allclose(page.tags[33922].value, (0, 0, 0, -30.0, 12.0 + 270 * 0.3, 0))
        assert page.tags[42113].value == "nan"
        assert page.geotiff_tags["ProjectedCSTypeGeoKey"] == 32632
        assert json.loads(page.description) == DOCUMENT


def test_png_with_a_world_file(made: Made, tmp_path: Path) -> None:
    grid, expected = made
    write_elevation(tmp_path / "e.png", grid, 0.6, DOCUMENT)
    with Image.open(tmp_path / "e.png") as read:
        levels = np.asarray(read).astype(np.int64)[::-1]
    about = json.loads((tmp_path / "e.png.json").read_text())
    assert about["step"] == 0.001
    assert np.array_equal(levels == 0, np.isnan(expected))
    heights = about["z_min"] + (levels - 1) * about["step"]
    assert np.nanmax(np.abs(np.where(levels, heights, np.nan) - expected)) < 0.00051
    numbers = [float(line) for line in (tmp_path / "e.pgw").read_text().split()]
    assert np.allclose(numbers, (0.3, 0, 0, -0.3, -30 + 0.15, 12 + 270 * 0.3 - 0.15))


def test_hillshade(made: Made, tmp_path: Path) -> None:
    grid, expected = made
    write_hillshade(tmp_path / "h.png", grid, 0.6)
    with Image.open(tmp_path / "h.png") as read:
        pixels = np.asarray(read)[::-1]
    assert np.array_equal(pixels[:, :, 1] == 0, np.isnan(expected))
    whole = hillshade(np.pad(expected, ((1, 1), (0, 0)), constant_values=np.nan), 0.3)
    assert np.array_equal(pixels, whole)


def test_light_comes_from_the_north_west() -> None:
    x, y = np.meshgrid(np.arange(9.0), np.arange(9.0))

    def grey(heights: NDArray[np.float64]) -> int:
        return int(hillshade(heights.astype(np.float32), 1.0)[4, 4, 0])

    flat = grey(0 * x)
    assert grey(0.3 * (x - y)) > flat > grey(0.3 * (y - x))  # facing the light: descending to the north-west


@pytest.mark.parametrize("suffix", [".npz", ".tif", ".png", "shade"])
def test_a_larger_grid_takes_no_more_memory(tmp_path: Path, suffix: str) -> None:
    def peak_bytes(side: int) -> int:
        grid = ElevationGrid.create(tmp_path / f"grid{side}", 0.5, (0, 0), (side, side))
        i = np.arange(0, side, 2)
        grid.put(i, i, i / 7.0)
        tracemalloc.start()
        try:
            if suffix == "shade":
                write_hillshade(tmp_path / "h.png", grid, 1.0)
            else:
                write_elevation(tmp_path / f"e{suffix}", grid, 1.0, DOCUMENT)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak_bytes(100)  # imports
    assert peak_bytes(2000) < 1.5 * peak_bytes(600) < 10e6


def test_an_empty_grid_and_what_cannot_be_written(tmp_path: Path) -> None:
    grid = ElevationGrid.create(tmp_path / "grid", 1.0, (0, 0), (3, 4))
    for name in ("e.npz", "e.png"):
        write_elevation(tmp_path / name, grid, 1.0, DOCUMENT)
    with np.load(tmp_path / "e.npz") as read:
        assert np.isnan(read["height"]).all()
    for name, epsg, radius in (("e.xyz", None, 1.0), ("e.tif", 99999, 1.0), ("e.png", None, 1e9)):
        with pytest.raises(BadRequest):
            write_elevation(tmp_path / name, grid, radius, DOCUMENT, epsg=epsg)
    with pytest.raises(BadRequest):
        ElevationGrid.create(tmp_path / "endless", 1e-6, (0, 0), (3, 20_000_000))
    assert [path.name for path in tmp_path.glob("*.tmp")] == []


def test_what_no_cell_covers_is_not_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two small parts of a map at two corners: heights as without boxes, and few columns are read."""
    rng = np.random.default_rng(0)
    side = 900
    boxes = np.array([(100, 200, 160, 250), (900, 1000, 990, 1060), (130, 240, 200, 300)], np.int64)
    grids = [
        ElevationGrid(tmp_path / "grid", 0.3, (100, 200), (side, side), which) for which in (None, boxes)
    ]
    ElevationGrid.create(tmp_path / "grid", 0.3, (100, 200), (side, side))
    for i0, j0, i1, j1 in boxes.tolist():
        i, j = np.meshgrid(np.arange(i0, i1), np.arange(j0, j1))
        some = rng.random(i.shape) < 0.6
        grids[0].put(i[some], j[some], rng.uniform(0, 3, int(some.sum())))
    read = 0
    rows = ElevationGrid.rows

    def counted(self: ElevationGrid, *where: int) -> NDArray[np.float32]:
        nonlocal read
        found = rows(self, *where)
        read += found.size
        return found

    monkeypatch.setattr(ElevationGrid, "rows", counted)
    for margin in (0, 1):
        every, few = (
            [(begin, heights.copy(), kind.copy()) for begin, heights, kind in grid.blocks(1.0, margin=margin)]
            for grid in grids
        )
        for (a, heights, kind), (b, others, kinds) in zip(every, few, strict=True):
            assert a == b
            assert np.array_equal(heights, others, equal_nan=True)
            assert np.array_equal(kind, kinds)
    read = 0
    for _ in grids[1].blocks(1.0):
        pass
    assert 0 < read < side * side // 10
    write_elevation(tmp_path / "few.tif", grids[1], 1.0, {})
    write_elevation(tmp_path / "every.tif", grids[0], 1.0, {})
    assert (tmp_path / "few.tif").read_bytes() == (tmp_path / "every.tif").read_bytes()
