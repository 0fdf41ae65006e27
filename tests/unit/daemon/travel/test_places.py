# SPDX-License-Identifier: Apache-2.0
"""When cells will be needed, by where clients are and will be."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import (
    MAX_PLACES,
    SLOWEST_MPS,
    merged_places,
    places_of,
    until_needed,
)
from shmmap.protocol.messages import Intent

coordinates = st.floats(-1e5, 1e5)
hostile = st.floats(allow_nan=False, allow_infinity=False)
REACH_M = 200.0


def box(x: float, y: float, size: float = 20.0) -> NDArray[np.float64]:
    """Return one cell about a place."""
    half = 0.5 * size
    return np.array([[x - half, y - half, x + half, y + half]])


def moving(
    x: float, y: float, vx: float, vy: float, *route: tuple[float, float], now_s: float = 0.0
) -> Motion:
    """A client that says where it is and how fast it moves."""
    motion = Motion()
    motion.update(Intent(x, y, vx, vy, route=route), now_s)
    return motion


def until_s(motion: Motion, x: float, y: float, now_s: float = 0.0) -> float:
    """In how many seconds a cell about (x, y) is needed."""
    return float(until_needed(box(x, y), places_of(motion, REACH_M), now_s)[0])


def test_what_is_within_reach_is_needed_now() -> None:
    motion = moving(100.0, 50.0, 10.0, 0.0)
    assert until_s(motion, 100.0, 50.0) == 0.0
    assert until_s(motion, 100.0 - REACH_M, 50.0) == 0.0
    assert until_s(motion, 100.0, 50.0 + REACH_M + 9.0) == 0.0
    assert until_s(motion, 100.0, 50.0 + REACH_M + 11.0) > 0.0


def test_ahead_comes_before_behind() -> None:
    motion = moving(0.0, 0.0, 10.0, 0.0)
    # the cell's near side is 100 m beyond reach
    assert until_s(motion, 310.0, 0.0) == pytest.approx(10.0)
    assert until_s(motion, 0.0, 310.0) == pytest.approx(15.0)
    assert until_s(motion, -310.0, 0.0) == pytest.approx(20.0)


def test_a_standing_client_may_drive_off_anywhere() -> None:
    motion = moving(0.0, 0.0, 0.0, 0.0)
    for x, y in ((310.0, 0.0), (-310.0, 0.0), (0.0, 310.0)):
        assert until_s(motion, x, y) == pytest.approx(1.5 * 100.0 / SLOWEST_MPS)


def test_along_a_route_it_is_when_the_client_comes_there() -> None:
    motion = moving(0.0, 0.0, 10.0, 0.0, (0.0, 0.0), (3000.0, 0.0), now_s=50.0)
    for ahead in (500.0, 1000.0, 2000.0):
        entered_s = (ahead - 10.0 - REACH_M) / 10.0
        assert until_s(motion, ahead, 0.0, 50.0) == pytest.approx(entered_s, abs=12.0)
        assert until_s(motion, ahead, 0.0, 60.0) == pytest.approx(max(0.0, entered_s - 10.0), abs=12.0)


def test_beside_a_route_it_is_after_its_end() -> None:
    motion = moving(0.0, 0.0, 10.0, 0.0, (0.0, 0.0), (3000.0, 0.0))
    behind, beside = until_s(motion, -500.0, 0.0), until_s(motion, 1500.0, 700.0)
    assert behind > beside > 3000.0 / 10.0
    near_behind = until_s(motion, -REACH_M - 15.0, 0.0)
    assert near_behind < 2.0, "it may turn round"


def test_a_place_that_a_route_passes_twice_is_needed_the_first_time() -> None:
    there, far, back = (0.0, 0.0), (0.0, 2000.0), (1000.0, 2000.0)
    motion = moving(0.0, 0.0, 10.0, 0.0, there, far, back, (1000.0, 1000.0), (0.0, 1000.0), there)
    assert until_s(motion, 0.0, 1000.0) == pytest.approx((1000.0 - REACH_M) / 10.0, abs=12.0)


@given(
    st.lists(st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)), min_size=2, max_size=8),
    st.floats(0.0, 1.0),
    st.floats(0.0, 2.0 * math.pi),
)
def test_nothing_within_reach_of_a_route_is_needed_after_its_end(
    vertices: list[tuple[float, float]], share: float, angle: float
) -> None:
    """Wherever along the route a cell comes into reach, it is not among those evicted first."""
    motion = moving(*vertices[0], 10.0, 0.0, *vertices)
    route = motion.route
    if route is None or route.length_m < 1.0:
        return
    left_s = route.length_m / 10.0
    along = motion.along_m + share * (route.length_m - motion.along_m)
    x, y = (route.at(along) + REACH_M * np.array([math.cos(angle), math.sin(angle)])).tolist()
    assert until_s(motion, x, y) <= left_s + 1e-6


@given(st.lists(st.tuples(hostile, hostile), max_size=20), hostile, hostile, hostile, hostile, hostile)
def test_hostile_intents(
    route: list[tuple[float, float]], x: float, y: float, vx: float, vy: float, cell: float
) -> None:
    places = places_of(moving(x, y, vx, vy, *route), REACH_M)
    assert places.shape[1] == 8
    assert not np.isnan(places).any()
    at = max(-1e12, min(cell, 1e12))
    found = until_needed(box(at, at), places, 0.0)
    assert found[0] >= 0.0


def test_a_route_of_4096_vertices_has_few_places() -> None:
    motion = moving(0.0, 0.0, 10.0, 0.0, *((10.0 * n, 50.0 * math.sin(n / 30.0)) for n in range(4096)))
    places = places_of(motion, REACH_M)
    assert len(places) <= 128
    apart = np.hypot(*np.diff(places[1:-1, :2], axis=0).T)
    assert apart[0] < 60.0
    assert until_s(motion, 30_000.0, 0.0) == pytest.approx((30_000.0 - REACH_M) / 10.0, rel=0.1)


@given(st.lists(st.tuples(coordinates, coordinates, st.floats(1, 30)), min_size=1, max_size=20), st.data())
def test_few_places_stand_for_all(clients: list[tuple[float, float, float]], data: st.DataObject) -> None:
    """However many there are, each client's cells still count as needed before what lies far from all."""
    tables = []
    for x, y, speed in clients:
        length = data.draw(st.integers(0, 8))
        route = [(x + 300.0 * n, y) for n in range(length)]
        tables.append(places_of(moving(x, y, speed, 0.0, *route), REACH_M))
    crowd = tables * 20
    merged = merged_places(crowd)
    assert 0 < len(merged) <= MAX_PLACES
    assert np.isinf(merged[:, 4]).any(), "from somewhere anything may be reached"
    assert np.isfinite(until_needed(box(3e5, 3e5), merged, 0.0)).all()


def test_a_crowd_with_routes() -> None:
    """4096 clients with routes all over the map."""
    tables = [
        places_of(moving(n * 131.0, n * 77.0, 10.0, 0.0, (n * 131.0, n * 77.0), (4e4, n * 100.0)), REACH_M)
        for n in range(4096)
    ]
    merged = merged_places(tables)
    assert MAX_PLACES // 8 < len(merged) <= MAX_PLACES
