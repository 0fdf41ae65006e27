# SPDX-License-Identifier: Apache-2.0
"""What a picture shows lies where its coordinates say, in the colour that its legend says."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.errors import BadRequest, NoColumn
from shmmap.geometry import Box
from shmmap.viewing.page import Drawn, Follower, View, backdrop, draw, looking_from
from shmmap.viewing.rendering import Camera, PointImage
from shmmap.viewing.sources import BoxTuple, Points, PointSource, values_of
from tests.support.pictures import png_pixels

LEFT, TOP = 62, 26
GROUND = (198, 198, 198)
HEIGHT_M = 8.0
BLOCK = (20.0, 10.0, 30.0, 16.0)
AREA = (0.0, 0.0, 60.0, 40.0)


class Scene(PointSource):
    """A plain with a block on it: points at the middles of squares of 10 cm, in the dtype given."""

    def __init__(self, dtype: str = "<f4", offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        super().__init__("a plain")
        x, y = np.meshgrid(np.arange(0.05, 60, 0.1), np.arange(0.05, 40, 0.1))
        x, y = x.ravel(), y.ravel()
        on_block = (x > BLOCK[0]) & (x < BLOCK[2]) & (y > BLOCK[1]) & (y < BLOCK[3])
        z = np.where(on_block, HEIGHT_M, 0.0)
        moved = np.column_stack((x, y, z)) + offset
        self.xyz = moved.astype(dtype)
        self.on_block = on_block.astype("<u2")
        self.asked: list[str] = []

    def extent(self) -> BoxTuple | None:
        return AREA

    def blocks(self, area: Box, column: str) -> Iterator[Points]:
        del area
        self.parts = 1
        columns: dict[str, NDArray[Any]] = {"xyz": self.xyz, "mark": self.on_block}
        for start in range(0, len(self.xyz), 100_000):
            rows = slice(start, start + 100_000)
            part = {name: values[rows] for name, values in columns.items()}
            yield Points(part["xyz"], (0.0, 0.0, 0.0), values_of(part, column, len(part["xyz"]), "plain"))


def drawn(source: PointSource, **settings: Any) -> Drawn:
    found = draw(source, View(**{"box": AREA, "size": (900, 700), **settings}))
    assert found is not None
    return found


def at(picture: Drawn, x: float, y: float) -> tuple[int, ...]:
    """The colour at a place of a view from above."""
    column = LEFT + (x - picture.box[0]) / picture.metres_per_pixel
    row = TOP + (picture.box[3] - y) / picture.metres_per_pixel
    return tuple(picture.pixels[int(row), int(column)].tolist())


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
@pytest.mark.parametrize("far", [(0.0, 0.0, 0.0), (90_000.0, -41_000.0, 500.0)])
def test_a_block_lies_where_the_coordinates_say(dtype: str, far: tuple[float, float, float]) -> None:
    box = (AREA[0] + far[0], AREA[1] + far[1], AREA[2] + far[0], AREA[3] + far[1])
    picture = drawn(Scene(dtype, far), box=box)
    assert picture.points == 600 * 400
    assert picture.box[0] <= box[0] < box[2] <= picture.box[2]
    min_x, min_y, max_x, max_y = BLOCK
    top = at(picture, far[0] + 25, far[1] + 13)
    assert top[0] > 200 > 130 > top[1], "the end of the colours"
    inside, outside = 0.3, -0.3
    for x, y in ((min_x, 13.0), (max_x, 13.0), (25.0, min_y), (25.0, max_y)):
        toward = np.sign((25.0 - x, 13.0 - y))
        just_in, just_out = (
            at(picture, far[0] + x + toward[0] * by, far[1] + y + toward[1] * by) for by in (inside, outside)
        )
        assert just_in == top, (x, y)
        assert np.ptp(just_out) <= 2, "grey ground, darker beside the block"
    assert at(picture, far[0] + 45, far[1] + 30) == GROUND
    assert picture.low == 0.0
    assert picture.high == pytest.approx(HEIGHT_M, abs=0.01)


def test_colours_of_a_column_and_of_z() -> None:
    picture = drawn(Scene(), by="mark")
    assert (picture.low, picture.high) == (0.0, 1.0)
    assert at(picture, 25, 13) != at(picture, 45, 30)
    picture = drawn(Scene("<f4", (0.0, 0.0, 3.0)), by="z")
    assert (picture.low, picture.high) == (3.0, 3.0 + HEIGHT_M)
    with pytest.raises(NoColumn, match="no column 'ring'") as missing:
        drawn(Scene(), by="ring")
    assert missing.value.hint == "it has xyz, mark"
    with pytest.raises(BadRequest, match="3 values a point") as wide:
        drawn(Scene(), by="xyz")
    assert "xyz[0] to xyz[2]" in wide.value.hint
    assert drawn(Scene(), by="xyz[2]").high == HEIGHT_M


def test_heights_and_areas_crop() -> None:
    assert drawn(Scene(), z=(1.0, 20.0)).points == 100 * 60, "the block alone"
    assert draw(Scene(), View(AREA, z=(20.0, 30.0))) is None
    assert draw(Scene(), View((500.0, 500.0, 510.0, 510.0))) is None
    cut = drawn(Scene(), box=(20.0, 10.0, 40.0, 20.0), azimuth=looking_from("south"))
    assert cut.points == 200 * 100
    assert cut.box == (20.0, 10.0, 40.0, 20.0)


@pytest.mark.parametrize("direction", ["south", "north", "west", "east", "south-west"])
def test_an_oblique_view_shows_the_near_wall(direction: str) -> None:
    """From each side: where the camera says that the block's top is, is its colour, and ground beside it."""
    azimuth = looking_from(direction)
    camera = Camera.looking((0, 0, 0), (60, 40, HEIGHT_M), 800, 560, azimuth, math.radians(38.0))
    image = PointImage(camera, Box(*AREA), with_ground=True)
    for points in Scene().blocks(Box(*AREA), ""):
        image.add(*points)
    image.fill_gaps()
    heights = image.heights()
    for x, y, z in ((25, 13, HEIGHT_M), (45, 30, 0.0), (5, 5, 0.0)):
        column, row = camera.place(x, y, z)
        assert heights[int(row), int(column)] == pytest.approx(z, abs=0.15), "to a pixel"
    # a step towards the viewer on the ground is down in the picture
    near = camera.place(25 - 5 * math.cos(azimuth), 13 - 5 * math.sin(azimuth), 0.0)
    assert near[1] > camera.place(25, 13, 0.0)[1]
    corners = [camera.place(x, y, z) for x in (0, 60) for y in (0, 40) for z in (0.0, HEIGHT_M)]
    assert all(-1e-6 <= u <= 800 + 1e-6 and -1e-6 <= v <= 560 + 1e-6 for u, v in corners)


def test_slopes_and_pits_do_not_move_the_ground() -> None:
    source = Scene()
    source.xyz[:, 2] += 0.1 * source.xyz[:, 0]
    low = np.random.default_rng(1).choice(len(source.xyz), 400)
    below = source.xyz[low] - np.array((0.0, 0.0, 5.0), np.float32)
    source.xyz = np.concatenate((source.xyz, below))
    source.on_block = np.concatenate((source.on_block, source.on_block[low]))
    picture = drawn(source)
    for x, y in ((10, 30), (30, 30), (50, 8), (45, 35)):
        assert np.ptp(at(picture, x, y)) <= 12, (x, y)


def test_points_without_a_number_are_left_out() -> None:
    source = Scene()
    source.xyz[::7, 2] = np.nan
    source.xyz[3::7, 0] = np.inf
    assert drawn(source).points == int(np.isfinite(source.xyz).all(axis=1).sum())


def test_a_sparse_cloud_closes_and_what_lies_behind_it_is_hidden() -> None:
    """A wall of points 60 cm apart before a plain: pixels of 9 cm between them show the wall."""
    across, up = np.meshgrid(np.arange(5.0, 55.0, 0.6), np.arange(0.0, 12.0, 0.6))
    wall = np.column_stack((across.ravel(), np.full(across.size, 10.0), up.ravel()))
    camera = Camera.looking((0, 0, 0), (60, 40, 12), 650, 400, looking_from("south"), math.radians(38.0))
    image = PointImage(camera)
    image.add(wall)
    image.fill_gaps()
    column, row = camera.place(30.3, 10.0, 6.3)
    window = image.depth[int(row) - 20 : int(row) + 20, int(column) - 60 : int(column) + 60]
    assert np.isfinite(window).all()


def test_a_client_is_marked_where_it_is() -> None:
    follower = Follower(45.0, 30.0, 0.0, "planner", (40.0, 25.0, 50.0, 35.0))
    picture = drawn(Scene(), follower=follower)
    assert at(picture, 45, 30) == (201, 42, 42)
    ring = [at(picture, 45 + 5 * math.cos(t), 30 + 5 * math.sin(t)) for t in np.arange(0, 6.28, 0.02)]
    red = [r > 180 and g < 120 for r, g, _ in ring]
    assert 0.3 < np.mean(red) < 0.8, "a dashed circle"


@pytest.mark.parametrize("size", [(480, 320), (1280, 800), (1400, 400)])
def test_legend_and_scale_bar_fit(size: tuple[int, int]) -> None:
    """The scale bar is as long as its metres; the picture keeps a white border."""
    picture = drawn(Scene(), size=size)
    assert picture.pixels.shape == (size[1], size[0], 3)
    border = [picture.pixels[:, :8], picture.pixels[:, -8:], picture.pixels[-6:], picture.pixels[:8]]
    assert all((part == 255).all() for part in border)
    dark = (picture.pixels[size[1] - 28] < 120).all(axis=1)
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate(([False], dark, [False])).astype(int))))
    metres = max(runs) * picture.metres_per_pixel
    power = 10 ** math.floor(math.log10(metres * 1.02))
    assert any(metres == pytest.approx(step * power, rel=0.03) for step in (1, 2, 5, 10))


def test_a_backdrop_fills_its_box() -> None:
    png = backdrop(Scene().blocks(Box(*AREA), ""), AREA, 600)
    assert png is not None
    pixels = png_pixels(png, "RGBA")
    assert pixels.shape == (400, 600, 4)
    assert (pixels[..., 3] == 255).all()
    roof, ground = pixels[400 - 130, 250], pixels[100, 450]
    assert np.ptp(ground[:3]) <= 2
    assert int(roof[0]) > int(roof[1]) + 30
    assert backdrop(iter(()), AREA, 600) is None


def test_thinning_keeps_values_with_their_points() -> None:
    points = Points(np.arange(12.0).reshape(4, 3), (0.0, 0.0, 0.0), np.arange(4.0)).thinned(3)
    assert points.xyz.tolist() == [[0, 1, 2], [9, 10, 11]]
    assert points.values is not None
    assert points.values.tolist() == [0, 3]


@pytest.mark.parametrize("make", [lambda: np.empty((0, 3)), lambda: np.full((5, 3), np.nan)])
def test_nothing_to_draw(make: Callable[[], NDArray[np.float64]]) -> None:
    source = Scene()
    source.xyz = make()
    source.on_block = np.zeros(len(source.xyz), "<u2")
    for azimuth in (None, 0.0):
        assert draw(source, View(AREA, azimuth=azimuth)) is None
