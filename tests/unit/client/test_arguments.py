# SPDX-License-Identifier: Apache-2.0
"""Arguments of requests: routes are thinned to 512 places, and what cannot be sent is refused before."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import shmmap
from shmmap.client.arguments import (
    FARTHEST_M,
    MAX_ROUTE_PLACES,
    MAX_WAIT_S,
    given_intent,
    pose_intent,
    request_waits,
    thinned,
)
from shmmap.client.live.live_map import LiveMap, _area
from shmmap.errors import BadRequest
from shmmap.protocol.areas import SphereMessage
from shmmap.protocol.messages import Intent

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


def spiral(places: int) -> np.ndarray:
    turns = np.linspace(0.0, 12.0, places)
    return np.stack([30.0 * turns * np.cos(turns), 30.0 * turns * np.sin(turns)], axis=-1)


def test_a_short_one_is_sent_as_it_is() -> None:
    route = spiral(MAX_ROUTE_PLACES)
    assert thinned(route) is route
    assert pose_intent(1, 2, 0, 0, None, route).route == tuple(map(tuple, route.tolist()))
    assert given_intent((1.0, 2.0), (0.0, 0.0), None, [(3.0, 4.0)]) == Intent(1.0, 2.0, route=((3.0, 4.0),))
    assert given_intent(None, (0.0, 0.0), None, ()) is None


def test_of_a_long_one_places_equally_far_apart() -> None:
    route = spiral(20_000)
    found = thinned(route)
    assert found.shape == (MAX_ROUTE_PLACES, 2)
    assert found[0].tolist() == route[0].tolist()
    assert found[-1] == pytest.approx(route[-1], abs=1e-9)
    apart = np.hypot(*np.diff(found, axis=0).T)
    assert apart.max() / apart.min() < 1.01
    nearest = np.hypot(*(found[:, np.newaxis] - route[np.newaxis]).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() < 0.15, "they lie on the route"
    sent = given_intent((1, 2), (3, 4), 0.5, route)
    assert sent is not None
    assert sent == pose_intent(1, 2, 3, 4, 0.5, route)
    assert sent.route == tuple(map(tuple, found.tolist()))


def test_places_passed_twice_and_places_stood_at() -> None:
    there_and_back = np.concatenate([spiral(400), spiral(400)[::-1], np.tile(spiral(400)[0], (300, 1))])
    found = thinned(there_and_back)
    assert len(found) == MAX_ROUTE_PLACES
    assert found[0].tolist() == found[-1].tolist() == [0.0, 0.0]
    assert np.hypot(*found.T).max() > 359.0, "it turns at the far end"
    assert thinned(np.tile([7.0, 8.0], (5000, 1))).tolist() == [[7.0, 8.0]]


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=40), st.integers(14, 40))
def test_whatever_is_finite_stays_so(some: list[tuple[float, float]], repeats: int) -> None:
    found = thinned(np.array(some * repeats))
    assert len(found) <= max(MAX_ROUTE_PLACES, 1)
    assert np.isfinite(found).all()
    if len(some) * repeats > MAX_ROUTE_PLACES:
        assert np.abs(found).max() <= FARTHEST_M


@pytest.mark.parametrize(
    "route",
    [[(1.0, 2.0), (3.0,)], [(1.0, 2.0, 3.0)], [1.0, 2.0], [("x", "y")], [(1.0, math.nan)], [(None, 1)]],
)
def test_what_is_no_route_is_refused(route: Any) -> None:
    with pytest.raises(BadRequest):
        pose_intent(0, 0, 0, 0, None, route)
    with pytest.raises(BadRequest):
        given_intent((0.0, 0.0), (0.0, 0.0), None, route)


@pytest.mark.parametrize(
    "intent",
    [((1, 2, 3), (0, 0), None, ()), (5, (0, 0), None, ()), ((1, 2), 5.0, None, ()), (None, (1, 0), None, ())],
)
def test_poses_and_velocities_that_make_no_sense(intent: Any) -> None:
    with pytest.raises(BadRequest, match="pose"):
        given_intent(*intent)


def test_a_long_wait_is_several_requests() -> None:
    """Each of them notices a daemon that hangs."""
    assert list(request_waits(None)) == [None]
    assert list(request_waits(0)) == [0.0]
    assert list(request_waits(2.5 * MAX_WAIT_S)) == [MAX_WAIT_S, MAX_WAIT_S, 0.5 * MAX_WAIT_S]
    endless = request_waits(math.inf)
    assert [next(endless) for _ in range(5)] == [MAX_WAIT_S] * 5


@pytest.mark.parametrize(
    "route",
    [[(1, 2), [3, 4]], np.array([[1, 2], [3, 4]]), np.array([[1, 2], [3, 4]], np.float32), ((1, 2), (3, 4))],
)
def test_as_planners_have_them(route: Any) -> None:
    assert pose_intent(0, 0, 0, 0, None, route).route == ((1.0, 2.0), (3.0, 4.0))
    assert pose_intent(0, 0, 0, 0, None, ()).route == ()
    assert pose_intent(0, 0, 0, 0, None, np.empty((0, 2))).route == ()


# --- areas and places of live maps ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "numbers",
    [
        (0, 0, 0, 1.4e154), (0, 0, 0, 1.7e308), (0, 0, 0, 1e150), (1e155, 0, 0, 1), (0, -1.7e308, 0, 1),
        (0, 0, 10**400, 1), (0, 0, 0, 10**400), (math.nan, 0, 0, 1), (0, 0, math.inf, 1), (0, 0, 0, math.inf),
        (0, 0, 0, -1e-9), (0, 0, 0, math.nan),
    ],
)  # fmt: skip
def test_spheres_that_make_no_sense(numbers: tuple[float, float, float, float]) -> None:
    with pytest.raises(BadRequest, match="finite"):
        _area(shmmap.live.Sphere(*numbers))


def test_spheres_that_do() -> None:
    assert _area(shmmap.live.Sphere(1, -2, 3, 0)) == SphereMessage(1.0, -2.0, 3.0, 0.0)
    assert _area(shmmap.live.Sphere(0, 0, 0, 9e149)) == SphereMessage(0.0, 0.0, 0.0, 9e149)
    assert _area(None) is None


def test_a_place_beyond_all_floats() -> None:
    with pytest.raises(BadRequest, match="not finite"):
        LiveMap.move_to(object.__new__(LiveMap), 10**400, 0, 0)
