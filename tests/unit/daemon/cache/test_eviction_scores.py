# SPDX-License-Identifier: Apache-2.0
"""The order in which segments are evicted when memory is short."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.evictor import SOON_S, eviction_scores
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import NOWHERE, Places, merged_places, places_of, until_needed
from shmmap.protocol.messages import Intent

coordinates = st.floats(-1e5, 1e5)
points = st.tuples(coordinates, coordinates)


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


def client(x: float, y: float, vx: float = 0.0, vy: float = 0.0, *route: tuple[float, float]) -> Places:
    """Where a client with a reach of 50 m will be."""
    motion = Motion()
    motion.update(Intent(x, y, vx, vy, route=route), 0.0)
    return places_of(motion, 50.0)


def ordered(some: list[Resident], *clients: Places) -> list[Resident]:
    """Sorted by score, the one that is evicted first in front."""
    scores = eviction_scores(some, merged_places(clients), 0.0).tolist()
    ranks = {one: (-score, one.last_use_s) for one, score in zip(some, scores, strict=True)}
    return sorted(some, key=ranks.__getitem__)


@given(residents())
def test_without_any_client_the_least_recently_used(candidates: list[Resident]) -> None:
    times = [resident.last_use_s for resident in ordered(candidates)]
    assert times == sorted(times)


@given(residents(), st.lists(points, min_size=1, max_size=4), st.floats(0, 100))
def test_needed_last(candidates: list[Resident], places: list[tuple[float, float]], now_s: float) -> None:
    """The time until any client comes to it counts, weighted by size."""
    clients = merged_places(client(*place, 10.0, 5.0) for place in places)
    scores = eviction_scores(candidates, clients, now_s)
    boxes = np.array([resident.box for resident in candidates]).reshape(-1, 4)
    times = until_needed(boxes, clients, now_s)
    for resident, score, until_s in zip(candidates, scores.tolist(), times.tolist(), strict=True):
        assert score == pytest.approx((until_s + SOON_S) * math.sqrt(resident.nbytes))


@given(residents(), points, points)
def test_one_more_client_keeps_nothing_from_being_needed_sooner(
    candidates: list[Resident], one: tuple[float, float], other: tuple[float, float]
) -> None:
    alone = eviction_scores(candidates, client(*one), 0.0)
    both = eviction_scores(candidates, merged_places([client(*one), client(*other)]), 0.0)
    assert (both <= alone + 1e-6).all()


def made(name: str, x: float, y: float = 0.0, nbytes: int = 100, last_use_s: float = 0.0) -> Resident:
    return Resident(
        name, Key(name, "points"), 1, nbytes, 0, (x, y, x + 10, y + 10.0), 0.0, 0.0, last_use_s=last_use_s
    )


def test_examples() -> None:
    near, middle, far = made("near", 60), made("middle", 150), made("far", 500)
    here = client(5.0, 5.0)
    assert [r.name for r in ordered([near, far, middle], here)] == ["far", "middle", "near"]
    assert ordered([near, far, middle], here, client(505.0, 5.0))[0] is middle
    large = made("large", 450, nbytes=400)
    assert ordered([near, middle, far, large], here)[0] is large
    old, new = made("old", 150, last_use_s=1.0), made("new", 150, last_use_s=2.0)
    assert ordered([new, old], client(0.0, 0.0)) == [old, new]
    assert ordered([new, old]) == [old, new]
    near_unused, far_used = made("near, long unused", 0, last_use_s=1.0), made("far, just used", 500)
    far_used.last_use_s = 2.0
    assert ordered([near_unused, far_used], here) == [far_used, near_unused]
    assert ordered([far_used, near_unused]) == [near_unused, far_used]


def test_nothing_to_score() -> None:
    for places in (NOWHERE, client(0.0, 0.0)):
        assert eviction_scores([], places, 0.0).shape == (0,)


def test_behind_goes_before_ahead() -> None:
    behind, beside, ahead = made("behind", -310), made("beside", -5, 300), made("ahead", 300)
    driver = client(0.0, 0.0, 10.0, 0.0)
    assert ordered([ahead, behind, beside], driver) == [behind, beside, ahead]


def test_a_route_counts() -> None:
    """What the client comes to after a turn stays; what is nearer, but not on its path, goes."""
    driver = client(0.0, 0.0, 10.0, 0.0, (0.0, 0.0), (400.0, 0.0), (400.0, 800.0))
    on_route, nearer = made("on the route", 390, 780), made("nearer", -200, 0)
    assert ordered([on_route, nearer], driver) == [nearer, on_route]
    assert ordered([on_route, nearer], client(0.0, 0.0, 10.0, 0.0)) == [on_route, nearer]
