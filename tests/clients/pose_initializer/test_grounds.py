# SPDX-License-Identifier: Apache-2.0
"""Grounds above each other: which heights are levels, and which of them a rough height means."""

from __future__ import annotations

import numpy as np
import pytest
from shmmap_clients.pose_initializer.grounds import Ground, ground_at, grounds_of, levels_of


@pytest.mark.parametrize("gaps", [(), (8.0,), (3.0, 3.0), (2.4, 2.4, 2.4)])
def test_levels_are_heights_of_many_pieces(gaps: tuple[float, ...]) -> None:
    rng = np.random.default_rng(3)
    truth = np.cumsum([-1.9, *gaps])
    slope = rng.uniform(-0.6, 0.6, 40)  # eight metres around, on a ramp of 7 %
    noise = rng.uniform(-9.0, 20.0, 5)
    heights = np.concatenate([*(z + slope * 0.5 for z in truth), noise])
    np.testing.assert_allclose(np.sort(levels_of(pieces(heights), 45)), truth, atol=0.25)


def pieces(heights: np.ndarray) -> np.ndarray:
    return np.column_stack([heights, np.linspace(0.0, 8.0, len(heights))])


def test_few_pieces_are_no_level() -> None:
    street = np.linspace(-0.1, 0.1, 40)
    bus = np.full(6, 3.1)
    assert len(levels_of(pieces(np.concatenate([street, bus])), 46)) == 1
    assert levels_of(np.empty((0, 2)), 0) == []


def test_the_ground_layer_is_exact_and_levels_are_added() -> None:
    assert grounds_of(None, None, []) == []
    assert grounds_of(1.0, 0.9, [1.3]) == [Ground((1.0,))]
    # the lowest point is tried as well: beside a street, more than half of the columns may be above it
    assert grounds_of(1.0, 0.2, [1.3]) == [Ground((1.0, 0.2))]
    assert grounds_of(6.1, -1.9, [6.0, -1.7]) == [Ground((-1.9,)), Ground((6.1,))]
    assert grounds_of(-1.9, -1.9, [6.1, -1.8, 9.1]) == [Ground((-1.9,)), Ground((6.1,)), Ground((9.1,))]


@pytest.mark.parametrize(
    ("z", "meant"),
    [
        (-1.9, -1.9),
        (-7.0, -1.9),  # GNSS is metres off, most of all in height
        (0.5, -1.9),
        (4.5, 6.1),
        (6.1, 6.1),
        (12.0, 6.1),
        (2.0, None),
        (2.9, None),
        (500.0, None),  # no height of this map at all
        (-300.0, None),
    ],
)
def test_a_height_means_the_ground_that_is_clearly_nearest(z: float, meant: float | None) -> None:
    grounds = [Ground((-1.9,)), Ground((6.1,))]
    found = ground_at(grounds, z)
    assert (None if found is None else found.z) == meant
    assert ground_at(grounds[:1], z) == grounds[0]
