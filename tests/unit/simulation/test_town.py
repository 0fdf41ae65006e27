# SPDX-License-Identifier: Apache-2.0
"""The generated town: reproducible, inside its tiles, on its ground, and drivable."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from shmmap.errors import BadRequest
from shmmap.origin.map_directory import open_map
from shmmap.simulation.town import Town
from tests.support.divided_map import read_pcd

ORIGINS = [(0.0, 0.0), (-160.0, 40.0), (89_000.0, 43_000.0)]


def test_tiles_are_the_same_in_any_order_and_town_size() -> None:
    small, large = Town(seed=5, blocks=(2, 2), density=4.0), Town(seed=5, blocks=(4, 3), density=4.0)
    for bx, by in ((1, 1), (0, 0), (1, 0), (0, 1), (1, 1)):
        a, b = small.tile(bx, by), large.tile(bx, by)
        assert np.array_equal(a["xyz"], b["xyz"])
        assert np.array_equal(a["intensity"], b["intensity"])
    other = Town(seed=6, blocks=(2, 2), density=4.0).tile(0, 0)
    assert not np.array_equal(other["xyz"][:100], small.tile(0, 0)["xyz"][:100])
    assert not np.array_equal(small.tile(0, 1)["xyz"][:100, 2], small.tile(0, 0)["xyz"][:100, 2])


@pytest.mark.parametrize("origin", ORIGINS)
def test_points_are_finite_and_inside_their_half_open_tile(origin: tuple[float, float]) -> None:
    town = Town(seed=2, blocks=(3, 3), origin=origin, density=4.0)
    for bx in range(3):
        for by in range(3):
            xyz, intensity = town.tile(bx, by).values()
            assert xyz.dtype == intensity.dtype == np.float32
            assert intensity.shape == (len(xyz),)
            assert xyz.flags.c_contiguous
            assert np.isfinite(xyz).all()
            assert 0.0 <= intensity.min() <= intensity.max() <= 255.0
            corner = np.array((origin[0] + 80.0 * bx, origin[1] + 80.0 * by))
            inside = np.floor((xyz[:, :2].astype(np.float64) - corner) / 80.0)
            assert not inside.any()
    x, y = origin
    assert town.bounds == (x, y, x + 240.0, y + 240.0)


@pytest.mark.parametrize("origin", ORIGINS)
def test_the_ground_is_where_ground_height_says(origin: tuple[float, float]) -> None:
    """The street has nothing but ground, cars and foliage over it; the lowest points are ground."""
    town = Town(seed=4, blocks=(2, 2), origin=origin, density=20.0)
    xyz = np.concatenate([tile["xyz"] for tile in town.tiles()]).astype(np.float64)
    above = xyz[:, 2] - town.ground_height(xyz[:, 0], xyz[:, 1])
    local = xyz[:, :2] - origin
    to_street = np.abs(local - 80.0 * np.rint(local / 80.0)).min(axis=1)
    assert above.min() > -0.15
    near = np.abs(above) < 0.1
    assert near.sum() > 0.8 * 160.0 * 160.0 * 20.0 * 0.7
    assert abs(float(np.median(above[near]))) < 0.003
    middle = to_street < 2.0
    assert (np.abs(above[middle]) < 0.1).mean() > 0.9
    assert float(above[middle & near].std()) == pytest.approx(0.015, rel=0.1)
    # a curb of 12 cm, four metres from the centre line
    x = np.linspace(origin[0] + 83.9, origin[0] + 84.1, 21)
    step = np.diff(town.ground_height(x, np.full(21, origin[1] + 40.0)))
    assert step.max() == pytest.approx(0.12, abs=0.002)


def test_the_hills_are_hills_and_no_cliffs() -> None:
    town = Town(seed=1, blocks=(12, 12))
    x, y = np.meshgrid(np.arange(20.0, 960.0, 5.0), np.arange(20.0, 960.0, 5.0))
    z = town.ground_height(x, y)
    assert np.ptp(z) > 4.0
    assert np.abs(np.diff(z, axis=0)).max() < 5.0 * 0.1 + 0.13


def test_it_is_a_town() -> None:
    """Walls of many directions, things high above the ground, thin upright things."""
    town = Town(seed=8, blocks=(5, 5), density=8.0)
    xyz = np.concatenate([tile["xyz"] for tile in town.tiles()]).astype(np.float64)
    above = xyz[:, 2] - town.ground_height(xyz[:, 0], xyz[:, 1])
    assert 0.4 < (np.abs(above) < 0.1).mean() < 0.9
    assert (above > 2.0).mean() > 0.1
    assert 10.0 < np.quantile(above, 0.99) < 60.0
    # a lamp: a column of points 5 m high within a 20 cm square, standing on the sidewalk
    local = xyz[:, :2] - 80.0 * np.rint(xyz[:, :2] / 80.0)
    at_curb = (np.abs(np.abs(local).min(axis=1) - 4.6) < 0.15) & (above > 0.5)
    squares = np.unique(np.floor(xyz[at_curb] / (0.5, 0.5, 0.5)), axis=0)
    _, heights = np.unique(squares[:, :2], axis=0, return_counts=True)
    assert (heights >= 8).sum() >= 20


@pytest.mark.parametrize("blocks", [(1, 1), (1, 4), (2, 2), (3, 3), (9, 6)])
@pytest.mark.parametrize("origin", ORIGINS[:2])
def test_the_route_is_drivable(blocks: tuple[int, int], origin: tuple[float, float]) -> None:
    town = Town(seed=3, blocks=blocks, origin=origin)
    route = town.route(length=700.0, step=0.5)
    assert route.shape == (1401, 3)
    steps = np.diff(route[:, :2], axis=0)
    lengths = np.hypot(*steps.T)
    turning_round = np.abs(np.diff(route[:, 2])) > 0.5
    assert lengths[~turning_round].min() > 0.45
    assert lengths.max() <= 0.5 + 1e-9
    if min(blocks) >= 3:
        # in the street, never nearer than a wheel to the curb, and facing where it goes
        local = route[:, :2] - origin
        to_street = np.abs(local - 80.0 * np.rint(local / 80.0)).min(axis=1)
        assert to_street.max() < 4.0 - 0.9
        heading = (route[:-1, 2] + route[1:, 2]) / 2
        assert np.abs(np.cos(heading) * steps[:, 1] - np.sin(heading) * steps[:, 0]).max() < 0.06
        assert (np.cos(heading) * steps[:, 0] + np.sin(heading) * steps[:, 1]).min() > 0.4
        assert np.abs(np.diff(route[:, 2])).max() < 0.2
        lowest, highest = np.array(town.bounds).reshape(2, 2)
        assert ((lowest < route[:, :2]) & (route[:, :2] < highest)).all()
    assert np.array_equal(route, Town(seed=3, blocks=blocks, origin=origin).route(length=700.0, step=0.5))


def test_route_explores(tmp_path: Path) -> None:
    route = Town(seed=0, blocks=(8, 8)).route(length=3000.0)
    crossings = {
        (round(x / 80), round(y / 80)) for x, y, _ in route if math.dist((x % 80, y % 80), (40, 40)) > 40
    }
    assert len(crossings) > 15


def test_written_maps_hold_every_point_in_20_m_cells(tmp_path: Path) -> None:
    town = Town(seed=9, blocks=(2, 1), origin=(-80.0, 400.0), density=3.0)
    result = town.write(tmp_path / "map")
    tiles = list(town.tiles())
    assert result.points == sum(len(tile["xyz"]) for tile in tiles)
    assert result.cells == 2 * 16
    catalogue = open_map(tmp_path / "map", strict=True).load()
    assert len(catalogue) == 32
    total = 0
    for index in range(32):
        points = read_pcd(Path(catalogue.source(index).name))
        assert list(points) == ["x", "y", "z", "intensity"]
        corner, side = np.array(catalogue.box(index)[:2]), 20.0
        place = np.floor((np.stack([points["x"], points["y"]], axis=1) - corner) / side)
        assert not place.any()
        total += len(points["x"])
    assert total == result.points


def test_memory_is_that_of_a_tile() -> None:
    town = Town(seed=1, blocks=(1000, 1000), density=2.0)
    one = sum(column.nbytes for column in town.tile(500, 500).values())
    tracemalloc.start()
    try:
        town.tile(999, 999)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 20 * one + 5_000_000


def test_arguments_are_checked() -> None:
    for arguments in (
        {"blocks": (0, 1)},
        {"origin": (10.0, 0.0)},
        {"density": 0.0},
        {"density": float("nan")},
        {"seed": -1},
    ):
        with pytest.raises(BadRequest):
            Town(**arguments)
    town = Town(blocks=(2, 2))
    for bx, by in ((-1, 0), (0, 2), (2, 0)):
        with pytest.raises(BadRequest):
            town.tile(bx, by)
    for length, step in ((0.0, 1.0), (10.0, 0.0), (float("inf"), 1.0)):
        with pytest.raises(BadRequest):
            town.route(length=length, step=step)
