# SPDX-License-Identifier: Apache-2.0
"""The order in which segments go when memory is short."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.eviction.eviction_policy import (
    MOST_PLACES,
    POLICIES,
    by_distance,
    by_last_use,
    places_of,
)
from shmmap.daemon.config import load_config
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import SQUARE_M, squares_of

coordinates = st.floats(-1e5, 1e5)


@st.composite
def residents(draw: st.DrawFn) -> list[Resident]:
    found = []
    for number in range(draw(st.integers(0, 12))):
        x, y = draw(coordinates), draw(coordinates)
        found.append(
            Resident(
                f"/{number}",
                Key(f"/{number}.pcd", "points"),
                number + 1,
                draw(st.integers(1, 1 << 24)),
                0,
                (x, y, x + draw(st.floats(0, 50)), y + draw(st.floats(0, 50))),
                0.0,
                0.0,
                last_use_s=draw(st.floats(0, 1e6)),
            )
        )
    return found


def distance(resident: Resident, x: float, y: float) -> float:
    """Distance from (x, y) to the nearest point of a resident's box."""
    nearest_x = min(max(x, resident.box[0]), resident.box[2])
    nearest_y = min(max(y, resident.box[1]), resident.box[3])
    return math.hypot(x - nearest_x, y - nearest_y)


def ordered(policy: str, some: list[Resident], *places: tuple[float, float]) -> list[Resident]:
    """Sorted as a policy says, the one that goes first in front."""
    scores = POLICIES[policy](some, np.array(places, dtype=np.float64).reshape(-1, 2)).tolist()
    ranks = {one: (-score, one.last_use_s) for one, score in zip(some, scores, strict=True)}
    return sorted(some, key=ranks.__getitem__)


@given(residents(), st.lists(st.tuples(coordinates, coordinates), max_size=4))
def test_least_recently_used(candidates: list[Resident], places: list[tuple[float, float]]) -> None:
    for policy in ("lru", "distance"):
        found = ordered(policy, candidates, *(places if policy == "lru" else []))
        times = [resident.last_use_s for resident in found]
        assert times == sorted(times)


@given(residents(), st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=4))
def test_farthest_from_every_client(candidates: list[Resident], places: list[tuple[float, float]]) -> None:
    """The distance to the nearest client counts, weighted by size."""
    scores = by_distance(candidates, np.array(places))
    for resident, score in zip(candidates, scores.tolist(), strict=True):
        expected = min(distance(resident, x, y) for x, y in places) * math.sqrt(resident.nbytes)
        assert score == pytest.approx(expected, rel=1e-9, abs=1e-6)


@given(st.lists(st.tuples(coordinates, coordinates), max_size=600))
def test_places_in_few_squares(points: list[tuple[float, float]]) -> None:
    """Each is within half a square of one of the middles; above a number the squares are larger."""
    squares = {square for point in points for square in squares_of([point])}
    found = places_of(squares)
    assert len(found) == len(squares) if len(squares) <= MOST_PLACES else len(found) <= MOST_PLACES
    if len(points) > 0:
        offsets = np.abs(np.array(points)[:, np.newaxis] - found).max(axis=2).min(axis=1)
        half = SQUARE_M / 2
        while len(squares) > MOST_PLACES and half < offsets.max():
            half *= 2.0
        assert offsets.max() <= half <= 2e5
    assert len(places_of({})) == 0


def test_a_crowd_costs_no_more_than_so_many_places() -> None:
    """300 clients with routes all over the map, and two that drive apart from them."""
    crowd = {square for n in range(300) for square in squares_of([(n * 131.0, n * 77.0), (4e4, n * 100.0)])}
    assert len(crowd) > 10 * MOST_PLACES
    assert MOST_PLACES // 8 < len(places_of(crowd)) <= MOST_PLACES


def made(name: str, x: float, nbytes: int = 100, last_use_s: float = 0.0) -> Resident:
    return Resident(
        name, Key(name, "points"), 1, nbytes, 0, (x, 0.0, x + 10, 10.0), 0.0, 0.0, last_use_s=last_use_s
    )


def test_examples() -> None:
    near, middle, far = made("near", 0), made("middle", 100), made("far", 500)
    assert [r.name for r in ordered("distance", [near, far, middle], (5.0, 5.0))] == ["far", "middle", "near"]
    assert ordered("distance", [near, far, middle], (5.0, 5.0), (505.0, 5.0))[0] is middle
    large = made("large", 300, nbytes=400)
    assert ordered("distance", [near, middle, far, large], (5.0, 5.0))[0] is large
    old, new = made("old", 50, last_use_s=1.0), made("new", 50, last_use_s=2.0)
    assert ordered("distance", [new, old], (0.0, 0.0)) == [old, new]
    assert ordered("distance", [new, old]) == [old, new]
    assert by_last_use([], np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize(("name", "first"), [("distance", "far, just used"), ("lru", "near, long unused")])
def test_a_policy_does_what_its_name_says(name: str, first: str) -> None:
    candidates = [made("near, long unused", 0, last_use_s=1.0), made("far, just used", 500, last_use_s=2.0)]
    for order in (candidates, candidates[::-1]):
        assert ordered(name, order, (5.0, 5.0))[0].name == first
        assert ordered(name, order)[0].name == "near, long unused", "of distance without any place"


def test_every_policy_can_be_configured() -> None:
    for name in POLICIES:
        assert load_config({"map_path": "/map", "eviction": name}, environ={}).eviction == name
