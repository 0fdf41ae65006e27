# SPDX-License-Identifier: Apache-2.0
"""Routes by the metres along them, and where on them a client is."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.travel.motion import BEHIND_M, FARTHEST_M, MAX_VERTICES, OFF_ROUTE_M, Route

coordinates = st.floats(-1e5, 1e5)
hostile = st.floats(allow_nan=False, allow_infinity=False)
places = st.tuples(coordinates, coordinates)


def distance(route: Route, x: float, y: float) -> float:
    """Distance to the route, by trying places along it a metre (or a thousandth of it) apart."""
    tried = route.at(np.linspace(0.0, route.length_m, 1001))
    return float(np.hypot(tried[:, 0] - x, tried[:, 1] - y).min())


@given(st.lists(places, min_size=1, max_size=20))
def test_its_length_is_that_of_its_legs(vertices: list[tuple[float, float]]) -> None:
    route = Route(vertices)
    legs = sum(math.dist(a, b) for a, b in pairwise(vertices))
    assert route.length_m == pytest.approx(legs, abs=1e-6)
    assert route.at(0.0) == pytest.approx(vertices[0])
    assert route.at(route.length_m + 5.0) == pytest.approx(vertices[-1])
    assert route.at(np.zeros((3, 2))).shape == (3, 2, 2)


@given(st.lists(places, min_size=1, max_size=8), st.floats(0, 1), st.floats(-90, 90), st.floats(-90, 90))
def test_a_client_near_it_is_found_near_where_it_is(
    vertices: list[tuple[float, float]], share: float, dx: float, dy: float
) -> None:
    """What is found is about as near to the client as any place of the route (to the slack)."""
    route = Route(vertices)
    x, y = (route.at(share * route.length_m) + np.array([dx, dy])).tolist()
    along = route.find(x, y)
    if math.hypot(dx, dy) <= OFF_ROUTE_M:
        assert along is not None
        assert -1e-6 <= along <= route.length_m + 1e-6
        found_x, found_y = route.at(along).tolist()
        assert math.hypot(found_x - x, found_y - y) <= distance(route, x, y) + 10.0 + 1e-3


def test_a_client_far_from_it_is_not_on_it() -> None:
    route = Route([(0.0, 0.0), (1000.0, 0.0)])
    assert route.find(500.0, OFF_ROUTE_M - 1.0) == pytest.approx(500.0)
    assert route.find(500.0, OFF_ROUTE_M + 1.0) is None
    assert route.find(500.0, OFF_ROUTE_M + 1.0, 500.0) is None


def test_one_vertex_is_a_route_to_stay_at() -> None:
    route = Route([(5.0, 7.0)])
    assert (route.length_m, route.last_heading) == (0.0, 0.0)
    assert route.find(5.0, 8.0) == 0.0
    assert route.find(5.0, 8.0 + OFF_ROUTE_M) is None


def test_the_same_vertex_many_times() -> None:
    route = Route([(1.0, 1.0)] * 5 + [(1.0, 11.0)] * 3)
    assert route.length_m == pytest.approx(10.0)
    assert route.last_heading == pytest.approx(math.pi / 2)
    assert route.find(1.0, 6.0) == pytest.approx(5.0)


@pytest.mark.parametrize("lap", [0, 1, 2])
def test_where_it_passes_a_place_twice_the_client_is_where_it_comes_to_next(lap: int) -> None:
    square = [(0.0, 0.0), (500.0, 0.0), (500.0, 500.0), (0.0, 500.0)]
    route = Route([*square * 3, (0.0, 0.0)])
    before = lap * 2000.0 + 230.0
    assert route.find(250.0, 1.0, before) == pytest.approx(before + 20.0)


def test_a_street_is_driven_in_both_directions() -> None:
    """A client that comes back along a street is not taken to go backwards along its first pass."""
    route = Route([(0.0, 0.0), (1000.0, 0.0), (1000.0, 300.0), (500.0, 300.0), (500.0, 0.0), (0.0, 0.0)])
    # 2100 m along it is back on the first street, 500 m from its beginning
    come_m = 2095.0
    for driven in range(0, 500, 15):
        found = route.find(500.0 - driven, 0.0, come_m)
        assert found is not None
        assert found >= come_m - BEHIND_M
        come_m = max(come_m, found)
    assert come_m == pytest.approx(2100.0 + 495.0)


def test_a_client_that_leaves_its_route_and_comes_back() -> None:
    route = Route([(0.0, 0.0), (2000.0, 0.0)])
    assert route.find(300.0, 150.0, 280.0) is None
    assert route.find(600.0, 50.0, None) == pytest.approx(600.0)
    assert route.find(100.0, 0.0, 600.0) == pytest.approx(600.0 - BEHIND_M) or route.find(
        100.0, 0.0, 600.0
    ) == pytest.approx(100.0), "it went back far"


def town(corners: int, radius: float) -> list[tuple[float, float]]:
    """Steps of 80 m to the right and up in turns, with round corners, a vertex each 2 m."""
    at, heading, vertices = np.zeros(2), 0.0, [(0.0, 0.0)]
    for corner in range(corners):
        for _ in range(34):
            at = at + 2.0 * np.array([math.cos(heading), math.sin(heading)])
            vertices.append((float(at[0]), float(at[1])))
        turn = math.pi / 2 if corner % 2 == 0 else -math.pi / 2
        for _ in range(6):
            heading += turn / 6
            at = at + radius * abs(turn) / 6 * np.array([math.cos(heading), math.sin(heading)])
            vertices.append((float(at[0]), float(at[1])))
    return vertices


def test_of_many_vertices_those_at_bends_are_kept() -> None:
    vertices = town(100, 6.0)[:4096]
    assert len(vertices) > 7 * MAX_VERTICES
    route = Route(vertices)
    kept = route.at(np.linspace(0.0, route.length_m, 20_000))
    away = [float(np.hypot(*(kept - vertex).T).min()) for vertex in vertices]
    assert max(away) < 1.0
    legs = sum(math.dist(a, b) for a, b in pairwise(vertices))
    assert legs * 0.99 < route.length_m <= legs
    assert route.at(route.length_m) == pytest.approx(vertices[-1])


def test_a_long_straight_route_keeps_its_ends() -> None:
    route = Route([(7.0 * n, 3.0 * n) for n in range(4096)])
    assert route.length_m == pytest.approx(4095 * math.hypot(7, 3))
    assert route.find(7.0 * 2000, 3.0 * 2000) == pytest.approx(2000 * math.hypot(7, 3))


@given(st.lists(st.tuples(hostile, hostile), min_size=1, max_size=700), hostile, hostile)
def test_hostile_coordinates(vertices: list[tuple[float, float]], x: float, y: float) -> None:
    """Whatever is sent, lengths are finite, and a client is on it or not."""
    route = Route(vertices)
    assert 0.0 <= route.length_m < math.inf
    assert np.abs(route.at(np.array([0.0, route.length_m / 2, route.length_m]))).max() <= FARTHEST_M
    at = (max(-FARTHEST_M, min(x, FARTHEST_M)), max(-FARTHEST_M, min(y, FARTHEST_M)))
    along = route.find(*at)
    assert along is None or 0.0 <= along <= route.length_m * (1 + 1e-9)
