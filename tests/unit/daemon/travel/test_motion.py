# SPDX-License-Identifier: Apache-2.0
"""How a client moves: what it says, what its poses show, and where on its route it is."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.travel.motion import (
    BEHIND_M,
    FARTHEST_M,
    MAX_SPEED_MPS,
    MAX_VERTICES,
    OFF_ROUTE_M,
    Motion,
    Route,
)
from shmmap.protocol.messages import Intent

hostile = st.floats(allow_nan=False, allow_infinity=False)
routes = st.lists(st.tuples(hostile, hostile), max_size=5).map(tuple)


@pytest.fixture
def at_origin() -> Motion:
    """A client that was at the origin at 0 s."""
    motion = Motion()
    motion.update(Intent(0.0, 0.0), 0.0)
    return motion


def driven(motion: Motion, begin_s: float, end_s: float, vx: float, vy: float = 0.0) -> None:
    """A client moves on from where it is, and says so each second."""
    x, y = motion.x, motion.y
    for second in range(1, int(end_s - begin_s) + 1):
        motion.update(Intent(x + vx * second, y + vy * second), begin_s + second)


def test_a_velocity_is_learnt() -> None:
    motion = Motion()
    motion.update(Intent(100.0, 50.0), 10.0)
    assert (motion.jumps, motion.speed_mps, motion.travelled_m) == (1, 0.0, 0.0)
    driven(motion, 10.0, 20.0, 8.0, -6.0)
    assert (motion.vx, motion.vy) == pytest.approx((8.0, -6.0))
    assert (motion.fastest_mps, motion.travelled_m) == pytest.approx((10.0, 100.0))
    assert motion.jumps == 1


def test_poses_close_together_are_learnt_from_together(at_origin: Motion) -> None:
    """Two poses a few milliseconds apart show no velocity."""
    for step in range(1, 101):
        jitter = 0.05 if step % 2 else -0.05
        at_origin.update(Intent(0.1 * step + jitter, 0.0), 0.01 * step)
    assert at_origin.vx == pytest.approx(10.0, abs=0.5)
    assert at_origin.fastest_mps == pytest.approx(10.0, abs=0.5)


def test_a_velocity_that_is_sent_counts() -> None:
    motion = Motion()
    motion.update(Intent(0.0, 0.0, vx=3.0, vy=4.0), 0.0)
    assert (motion.vx, motion.vy, motion.fastest_mps) == (3.0, 4.0, 5.0)
    motion.update(Intent(1.0, 0.0, vx=1e300, vy=0.0), 1.0)
    assert motion.speed_mps == pytest.approx(MAX_SPEED_MPS)


def test_how_far_it_has_come_straight_ahead(at_origin: Motion) -> None:
    """Bends count as straight until they add up to a corner; a client that stands does not turn."""
    driven(at_origin, 0.0, 10.0, 10.0)
    driven(at_origin, 10.0, 20.0, 10.0, 2.0)
    straight_m = at_origin.straight_m
    assert straight_m == pytest.approx(at_origin.travelled_m)
    driven(at_origin, 20.0, 40.0, 0.0, -0.5)  # crawls to the side
    assert at_origin.straight_m == pytest.approx(straight_m + 10.0)
    driven(at_origin, 40.0, 41.0, 10.0, 5.0)
    assert at_origin.straight_m == 0.0
    driven(at_origin, 41.0, 44.0, 10.0, 5.0)
    assert at_origin.straight_m == pytest.approx(3 * math.hypot(10.0, 5.0))
    at_origin.update(Intent(5000.0, 0.0), 45.0)
    assert at_origin.straight_m == 0.0


def test_a_jump_resets_everything(at_origin: Motion) -> None:
    driven(at_origin, 0.0, 10.0, 15.0)
    at_origin.update(Intent(5000.0, 0.0), 11.0)
    assert (at_origin.jumps, at_origin.speed_mps) == (2, 0.0)
    assert (at_origin.fastest_mps, at_origin.travelled_m) == (0.0, 0.0)
    at_origin.update(Intent(5010.0, 0.0), 12.0)
    assert at_origin.vx == pytest.approx(10.0)


def test_a_red_light_is_no_jump(at_origin: Motion) -> None:
    """However long a client stands and is silent: it will go on, as fast as before."""
    driven(at_origin, 0.0, 10.0, 15.0)
    at_origin.update(Intent(151.0, 0.0), 50.0)
    assert at_origin.jumps == 1
    assert at_origin.speed_mps < 0.1
    assert at_origin.fastest_mps == pytest.approx(15.0 * math.exp(-40.0 / 60.0))
    assert at_origin.travelled_m == pytest.approx(151.0)


def test_what_was_fast_is_forgotten_slowly(at_origin: Motion) -> None:
    driven(at_origin, 0.0, 10.0, 20.0)
    driven(at_origin, 10.0, 70.0, 5.0)
    assert at_origin.fastest_mps == pytest.approx(20.0 * math.exp(-1.0), rel=0.02)
    driven(at_origin, 70.0, 400.0, 5.0)
    assert at_origin.fastest_mps == pytest.approx(5.0)


LOOP = ((0.0, 0.0), (500.0, 0.0), (500.0, 400.0), (0.0, 400.0), (0.0, 0.0), (500.0, 0.0))


def test_along_its_route() -> None:
    motion = Motion()
    for second in range(170):
        along = 12.0 * second
        legs = [(500.0, 1, 0), (400.0, 0, 1), (500.0, -1, 0), (400.0, 0, -1), (500.0, 1, 0)]
        x, y = 0.0, 0.0
        for length, dx, dy in legs:
            part = min(along, length)
            x, y, along = x + part * dx, y + part * dy, along - part
        motion.update(Intent(x, y, route=LOOP), float(second))
        assert motion.route is not None
        assert motion.along_m == pytest.approx(12.0 * second, abs=11.0)
    assert motion.along_m == pytest.approx(12.0 * 169)


def test_off_its_route_and_on_it_again() -> None:
    motion = Motion()
    on_it, along = [], []
    for second, (x, y) in enumerate([(0.0, 0.0), (0.0, -60.0), (0.0, -120.0), (60.0, -90.0)]):
        motion.update(Intent(x, y, route=LOOP), float(second))
        on_it.append(motion.route is not None)
        along.append(motion.along_m)
    assert on_it == [True, True, False, True]
    assert along == pytest.approx([0.0, 0.0, 0.0, 60.0])


def test_another_route_begins_at_its_start() -> None:
    motion = Motion()
    motion.update(Intent(480.0, 0.0, route=LOOP), 0.0)
    assert motion.along_m == pytest.approx(480.0)
    motion.update(Intent(490.0, 0.0, route=((490.0, 0.0), (490.0, 900.0))), 1.0)
    assert motion.along_m == pytest.approx(0.0)
    assert motion.route is not None
    assert motion.route.length_m == pytest.approx(900.0)
    motion.update(Intent(500.0, 0.0), 2.0)
    assert motion.route is None


@settings(deadline=None)
@given(st.lists(st.tuples(hostile, hostile, hostile, hostile, routes, st.floats(0, 100)), max_size=12))
def test_hostile_poses(
    steps: list[tuple[float, float, float, float, tuple[tuple[float, float], ...], float]],
) -> None:
    motion, now_s = Motion(), 0.0
    for x, y, vx, vy, route, later_s in steps:
        now_s += later_s
        before = motion.travelled_m
        motion.update(Intent(x, y, vx, vy, route=route), now_s)
        assert max(abs(motion.x), abs(motion.y)) <= FARTHEST_M
        assert motion.speed_mps <= MAX_SPEED_MPS * 2.01
        assert motion.fastest_mps >= motion.speed_mps * (1 - 1e-9)
        assert 0.0 <= motion.travelled_m <= before + MAX_SPEED_MPS * 10.0
        assert motion.route is None or 0.0 <= motion.along_m <= motion.route.length_m * (1 + 1e-9)


coordinates = st.floats(-1e5, 1e5)
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


def test_a_street_is_taken_both_ways() -> None:
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
    from scipy.spatial import cKDTree  # takes long to import

    vertices = town(100, 6.0)[:4096]
    assert len(vertices) > 7 * MAX_VERTICES
    route = Route(vertices)
    kept = route.at(np.linspace(0.0, route.length_m, 20_000))
    away, _ = cKDTree(kept).query(vertices)
    assert away.max() < 1.0
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
