# SPDX-License-Identifier: Apache-2.0
"""Cells as a browser draws them: blocks about their centres, the ground, and colours."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from shmmap.viewing.browser.cell_points import Colours, Ground, blocks
from shmmap.viewing.page import HEIGHT


def cloud(count: int, side: float, far: float = 0.0, seed: int = 0) -> NDArray[np.float64]:
    found: NDArray[np.float64] = np.random.default_rng(seed).uniform(0.0, side, (count, 3))
    found[:, 2] *= 0.1
    found += far
    return found


@pytest.mark.parametrize(("leaf", "side"), [(0.1, 20.0), (0.1, 100.0), (0.5, 500.0), (5.0, 3000.0)])
def test_no_point_moves_by_more_than_a_fraction_of_its_leaf(leaf: float, side: float) -> None:
    xyz = cloud(4000, side, far=90_000.0)
    colours = (np.arange(4000) % 256).astype(np.uint8)[:, None].repeat(3, axis=1)
    parts = list(blocks(xyz, colours, leaf))
    assert sum(len(part.points) for part in parts) == len(xyz)
    assert all(part.points.dtype == np.float16 for part in parts)
    drawn = np.concatenate([part.points.astype(np.float64) + part.centre for part in parts])
    painted = np.concatenate([part.colours[:, 0] for part in parts])
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(xyz).query(drawn)
    assert distance.max() < leaf / 4
    if leaf / 4 < side / 200:
        assert (painted == colours[nearest, 0]).mean() > 0.99


def test_a_block_has_no_more_points_than_a_browser_takes_at_once() -> None:
    xyz = cloud(700_000, 50.0)
    parts = list(blocks(xyz, np.zeros((len(xyz), 3), np.uint8), 1.0))
    assert max(len(part.points) for part in parts) < 250_000
    assert len(parts) < 30


def test_no_points_no_block() -> None:
    assert not list(blocks(np.empty((0, 3)), np.empty((0, 3), np.uint8), 0.1))
    (one,) = blocks(np.array([[1.0, 2.0, 3.0]]), np.zeros((1, 3), np.uint8), 0.1)
    assert one.centre == (1.0, 2.0, 3.0)


def street(x: float) -> NDArray[np.float64]:
    """Ground at 10 m, and a house."""
    ground = cloud(3000, 20.0, seed=1)
    ground[:, 2] = 10.0
    house = cloud(1000, 6.0, seed=2)
    house[:, 2] = 18.0
    both: NDArray[np.float64] = np.concatenate([ground, house]) + np.array((x, 0.0, 0.0))
    return both


def test_heights_are_those_above_the_ground() -> None:
    ground, colours = Ground(), Colours(HEIGHT)
    for number in range(4):
        ground.add(number, street(20.0 * number))
    xyz = street(20.0)
    values = colours.values(xyz, None, ground.surface((20.0, 0.0, 40.0, 20.0)))
    assert np.abs(values[:3000]).max() < 1.0
    assert values[3000:] == pytest.approx(8.0, abs=1.0)
    colours.settle(values)
    assert (colours.low, round(colours.high)) == (0.0, 8)
    painted = colours.of(values)
    assert np.abs(np.diff(painted[:3000].astype(int), axis=0)).max() <= 3
    assert np.abs(painted[0].astype(int) - painted[-1]).max() > 60
    assert not colours.settle(values * 5)
    assert round(colours.high) == 8, "one cell changes nothing"
    assert [colours.settle(values * 5) for _ in range(70)].count(True) == 1
    assert round(colours.high) == 40
    assert not any(colours.settle(values) for _ in range(200)), "they mean the same from then on"


def test_the_height_of_a_place() -> None:
    ground = Ground()
    assert ground.height(5.0, 5.0, 3.5) == 3.5
    ground.add(0, street(0.0))
    assert ground.height(15.0, 15.0, 3.5) == 10.0
    assert ground.height(500.0, 5.0, 3.5) == 3.5
    ground.forget()
    assert ground.height(5.0, 5.0, 3.5) == 3.5


def test_colours_of_a_column() -> None:
    colours = Colours("intensity")
    assert colours.column == "intensity"
    values = colours.values(cloud(100, 5.0), np.arange(100, dtype=np.uint16), None)
    colours.settle(values)
    painted = colours.of(values)
    assert (painted[0] != painted[-1]).any()
    assert Colours("z").column == Colours(HEIGHT).column == ""
