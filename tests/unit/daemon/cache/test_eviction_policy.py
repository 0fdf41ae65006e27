# SPDX-License-Identifier: Apache-2.0
"""The order in which segments go when memory is short."""

from __future__ import annotations

import itertools
import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.eviction_policy import POLICIES, by_distance, by_last_use
from shmmap.daemon.config import load_config
from shmmap.daemon.records import Key, Resident

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


@given(residents(), st.lists(st.tuples(coordinates, coordinates), max_size=4))
def test_least_recently_used(candidates: list[Resident], poses: list[tuple[float, float]]) -> None:
    ordered = by_last_use(candidates, poses)
    times = [resident.last_use_s for resident in ordered]
    assert times == sorted(times)
    assert {r.name for r in ordered} == {r.name for r in candidates}


@given(residents(), st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=4))
def test_farthest_from_every_client(candidates: list[Resident], poses: list[tuple[float, float]]) -> None:
    """The distance to the nearest client counts, weighted by size; nobody is lost or doubled."""
    ordered = by_distance(candidates, poses)
    assert sorted(r.name for r in ordered) == sorted(r.name for r in candidates)
    if len(candidates) > 1:
        median = statistics.median(r.nbytes for r in candidates)
        weights = [min(distance(r, x, y) for x, y in poses) * math.sqrt(r.nbytes / median) for r in ordered]
        for first, second in itertools.pairwise(weights):
            assert first >= second * (1 - 1e-9) - 1e-6


def made(name: str, x: float, nbytes: int = 100, last_use_s: float = 0.0) -> Resident:
    return Resident(
        name, Key(name, "points"), 1, nbytes, 0, (x, 0.0, x + 10, 10.0), 0.0, 0.0, last_use_s=last_use_s
    )


def test_examples() -> None:
    near, middle, far = made("near", 0), made("middle", 100), made("far", 500)
    assert [r.name for r in by_distance([near, far, middle], [(5.0, 5.0)])] == ["far", "middle", "near"]
    both_ends = [(5.0, 5.0), (505.0, 5.0)]
    assert by_distance([near, far, middle], both_ends)[0] is middle
    large = made("large", 300, nbytes=400)
    assert by_distance([near, middle, far, large], [(5.0, 5.0)])[0] is large
    old, new = made("old", 50, last_use_s=1.0), made("new", 50, last_use_s=2.0)
    assert by_distance([new, old], [(0.0, 0.0)]) == [old, new]
    assert by_distance([new, old], []) == by_last_use([new, old], []) == [old, new]


@pytest.mark.parametrize(("name", "first"), [("distance", "far, just used"), ("lru", "near, long unused")])
def test_a_policy_does_what_its_name_says(name: str, first: str) -> None:
    candidates = [made("near, long unused", 0, last_use_s=1.0), made("far, just used", 500, last_use_s=2.0)]
    for order in (candidates, candidates[::-1]):
        assert POLICIES[name](order, [(5.0, 5.0)])[0].name == first
        assert POLICIES[name](order, [])[0].name == "near, long unused", "of distance without any pose"


def test_every_policy_can_be_configured() -> None:
    for name in POLICIES:
        assert load_config({"map_path": "/map", "eviction": name}, environ={}).eviction == name
