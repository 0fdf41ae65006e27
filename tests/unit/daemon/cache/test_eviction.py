# SPDX-License-Identifier: Apache-2.0
"""Which segments are evicted next: by scores, as a plain sort says, in bounded steps."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmmap.daemon.cache.eviction_plan import (
    BLOCK,
    HAND_OUT_GRACE_S,
    LIST_WORK,
    LOOK_WORK,
    MAX_LISTED,
    SOON_S,
    SQUARE_WORK,
    WORK_PER_STEP,
    EvictionPlan,
    eviction_scores,
    highest_scores,
)
from shmmap.daemon.cache.ledger import (
    DUE_PER_CALL,
    IN_USE_S,
    MAX_IN_USE_S,
    MAX_NEW,
    SHARE_S,
    Evictable,
    Square,
)
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import (
    NOWHERE,
    PAIRS_PER_BLOCK,
    Places,
    merged_places,
    places_of,
    until_needed,
    widened,
)
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


@given(residents(), st.lists(points, min_size=1, max_size=4), st.floats(0, 100))
def test_needed_last(candidates: list[Resident], places: list[tuple[float, float]], now_s: float) -> None:
    """The time until any client comes to it counts, weighted by size."""
    clients = merged_places(client(*place, 10.0, 5.0) for place in places)
    scores = eviction_scores(candidates, clients, now_s)
    boxes = np.array([resident.box for resident in candidates]).reshape(-1, 4)
    times = until_needed(boxes, clients, now_s)
    for resident, score, until_s in zip(candidates, scores.tolist(), times.tolist(), strict=True):
        assert score == pytest.approx((until_s + SOON_S) * math.sqrt(resident.nbytes))


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


def in_service(some: Iterable[Resident]) -> Evictable:
    evictable = Evictable()
    for one in some:
        evictable.enter(one)
    return evictable


def known(evictable: Evictable) -> tuple[list[Resident], bool]:
    return list(evictable.new), evictable.has_more


def made_plan(some: list[Resident], places: Places, now_s: float) -> EvictionPlan:
    plan = EvictionPlan(places, 1, now_s)
    for _ in plan.make(in_service(some).squares(), lambda _one: True):
        pass
    return plan


def in_turn(plan: EvictionPlan) -> list[Resident]:
    """Those that go, in order."""
    found = []
    while plan.listed:
        if plan.settle(lambda _one: True) and plan.listed:
            found.append(plan.listed.pop().resident)
    return found


Rank = tuple[bool, bool, float, float]


def rank(one: Resident, places: Places, now_s: float) -> Rank:
    """The least goes first: not just handed out, held by no session, needed last, unused for longest."""
    in_grace = one.last_use_s + HAND_OUT_GRACE_S > now_s
    score = 0.0 if in_grace else -float(eviction_scores([one], places, now_s)[0])
    return in_grace, bool(one.sessions), score, one.last_use_s


def numbered(number: int, last_use_s: float = 0.0) -> Resident:
    return Resident(
        f"/{number}", Key(f"/{number}.pcd", "points"), number, 100, 0, (0.0,) * 4, 0.0, 0.0,
        last_use_s=last_use_s,
    )  # fmt: skip


@given(
    residents(), st.lists(points, max_size=3), st.lists(st.booleans(), min_size=12, max_size=12), st.data()
)
def test_a_plan_is_as_a_sort_says(
    some: list[Resident], where: list[tuple[float, float]], held: list[bool], data: st.DataObject
) -> None:
    """Also when segments are used after it was made: these go last, the first used first."""
    now_s = 100.0
    places = merged_places(client(*place, 10.0, 5.0) for place in where)
    for one in some:
        one.last_use_s = data.draw(st.sampled_from([1.0, 2.0, 99.5, 99.8]))
        one.spare = data.draw(st.booleans())
        one.sessions = data.draw(st.sampled_from([set(), {7}]))
    expected = sorted(some, key=lambda one: rank(one, places, now_s))
    plan = made_plan(some, places, now_s)
    assert plan.is_whole
    found = [candidate.resident for candidate in reversed(plan.listed)]
    assert [rank(one, places, now_s) for one in found] == [rank(one, places, now_s) for one in expected]
    used = [one for one in found if data.draw(st.booleans())]
    for number, one in enumerate(used):
        one.last_use_s = now_s + number / 8.0
    rest = [one for one in found if one not in used]
    past = [one for one in rest if one.last_use_s + HAND_OUT_GRACE_S <= now_s]
    in_turn_now = in_turn(plan)
    assert in_turn_now[: len(past)] == past
    assert set(in_turn_now) == set(some)
    assert [one for one in in_turn_now if one in used] == sorted(
        used, key=lambda one: (bool(one.sessions), one.last_use_s)
    )


@pytest.mark.parametrize("clients", [0, 1, 200])
@pytest.mark.parametrize("length", [0, 20])
def test_of_very_many_the_first_are_listed_in_bounded_steps(clients: int, length: int) -> None:
    """As a sort says, although those in squares that cannot matter are not scored."""
    rng = random.Random(clients)
    some = [
        made(str(n), rng.uniform(0, 1e4), rng.uniform(0, 1e4), rng.choice([100, 150]), rng.random())
        for n in range(MAX_LISTED + 5000)
    ]
    for one in some[::7]:
        one.sessions = {7}
        one.spare, one.last_use_s = rng.random() < 0.3, rng.choice([1.0, 99.5])
    routes = [[(50.0 * n + 100.0 * m, 100.0 + 3.0 * n * m) for m in range(length)] for n in range(clients)]
    places = merged_places(client(50.0 * n, 100.0, 5.0, 2.0, *route) for n, route in enumerate(routes))
    expected = sorted(some, key=lambda one: rank(one, places, 100.0))[:MAX_LISTED]
    plan, looked, asked = EvictionPlan(places, 1, 100.0), [0], list[Resident]()

    def counted() -> Iterator[Square]:
        for square in in_service(some).squares():
            looked[-1] += 1
            yield square

    def may_go(one: Resident) -> bool:
        asked.append(one)
        return True

    work = [0]
    for _ in plan.make(counted(), may_go):
        assert not plan.listed
        work.append(plan.work)
        looked.append(0)
    block = BLOCK * (LOOK_WORK + LIST_WORK) + 4 * PAIRS_PER_BLOCK
    steps = [now - then for then, now in pairwise(work) if now > then]
    assert max(steps) <= WORK_PER_STEP + block
    assert min(steps[:-1]) >= WORK_PER_STEP
    assert len(steps) > 5
    assert sum(looked) > 4000
    assert max(looked) * SQUARE_WORK <= 2 * WORK_PER_STEP
    assert MAX_LISTED <= len(asked) < len(some) / 2
    assert not plan.is_whole
    found = in_turn(plan)
    assert [rank(one, places, 100.0) for one in found] == [rank(one, places, 100.0) for one in expected]


@given(
    st.lists(points, max_size=6),
    st.lists(st.tuples(points, st.floats(0, 40)), min_size=1, max_size=20),
    st.floats(0, 100),
)
def test_no_segment_exceeds_the_highest_score_of_its_square(
    route: list[tuple[float, float]], cells: list[tuple[tuple[float, float], float]], now_s: float
) -> None:
    places = merged_places([client(0.0, 0.0, 8.0, -3.0, *route), client(700.0, 50.0)])
    boxes = [(x, y, x + size, y + 0.5 * size) for (x, y), size in cells]
    boxes += [(0.01 * x, 0.01 * y, 0.01 * x + 20.0, 0.01 * y + 20.0) for x, y, *_ in boxes]
    some = []
    for number, box in enumerate(boxes):
        some.append(numbered(number, float(number % 7)))
        some[-1].box, some[-1].nbytes, some[-1].spare = box, 1 + number % 5, number % 3 == 1
    evictable = in_service(some)
    for one in some[::5]:
        evictable.leave(one)
    assert {one for square in evictable.squares() for one in square.segments} == {*some} - {*some[::5]}
    for where in (places, NOWHERE):
        for square in evictable.squares():
            scores = eviction_scores([*square.segments], where, now_s)
            assert scores.max() <= highest_scores([square], widened(where, now_s), now_s)[0]


def test_more_is_listed_where_it_belongs() -> None:
    here = client(5.0, 5.0)
    near, middle, far = made("near", 60), made("middle", 150), made("far", 500)
    plan = made_plan([near, far], here, 10.0)
    plan.add([middle])
    assert in_turn(plan) == [far, middle, near]
    assert plan.score(far) > plan.score(middle) > plan.score(near)


@pytest.mark.parametrize("how", ["used", "needed"])
def test_however_many_were_used_since_or_are_needed_few_are_passed_over_at_a_time(how: str) -> None:
    some = [made(str(number), number) for number in range(3 * BLOCK)]
    plan = made_plan(some, client(0.0, 0.0), 10.0)
    for one in some[1:]:
        one.last_use_s = 10.0 if how == "used" else 0.0
    asked: list[Resident] = []

    def may_go(one: Resident) -> bool:
        asked.append(one)
        return how == "used" or one is some[0]

    calls = 1
    while not plan.settle(may_go):
        assert len(asked) == calls * BLOCK
        calls += 1
    assert calls == 3
    assert plan.listed[-1].resident is some[0]
    assert len(plan.listed) == (len(some) if how == "used" else 1)


# --- what was found in use ------------------------------------------------------------------------


def test_a_segment_in_use_is_left_alone_for_longer_and_longer() -> None:
    """Where its next close is not reported, always for the same time."""
    evictable, one, now_s = Evictable(), numbered(1), 50.0
    waits = []
    for _ in range(7):
        evictable.found_in_use(one, now_s, is_watched=True)
        waits.append(evictable.next_look_s() - now_s)
        now_s = evictable.next_look_s()
        assert evictable.is_left_alone(one, math.nextafter(now_s, 0.0))
        evictable.look_again(math.nextafter(now_s, 0.0))
        assert not evictable.new
        assert not evictable.is_left_alone(one, now_s)
        evictable.look_again(now_s)
        assert evictable.take_new() == [one]
    assert waits == pytest.approx([0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0])
    assert (IN_USE_S, MAX_IN_USE_S) == (0.2, 5.0)
    for _ in range(3):
        evictable.found_in_use(one, now_s, is_watched=False)
        assert evictable.next_look_s() - now_s == pytest.approx(IN_USE_S)
        now_s = evictable.next_look_s()
        evictable.look_again(now_s)
    assert evictable.release(one), "it is another use from now on"
    assert not evictable.release(one)
    evictable.found_in_use(one, now_s, is_watched=True)
    assert evictable.next_look_s() - now_s == pytest.approx(IN_USE_S)


def test_of_very_many_in_use_few_are_looked_at_again_at_a_time() -> None:
    some = [numbered(number) for number in range(2000)]
    evictable = in_service(some)
    evictable.take_new()
    for one in some:
        evictable.found_in_use(one, 0.0, is_watched=True)
    assert evictable.is_left_alone(some[-1], 0.9 * SHARE_S * len(some))
    evictable.look_again(2.0)
    assert len(evictable.new) == DUE_PER_CALL
    for one in some[DUE_PER_CALL : 3 * DUE_PER_CALL]:
        evictable.leave(one)  # out of service
    evictable.look_again(2.0)
    evictable.look_again(2.0)
    assert len(evictable.new) == DUE_PER_CALL, "the dead are passed over, some at a time"
    evictable.look_again(2.0)
    assert len(evictable.new) == 2 * DUE_PER_CALL


def test_all_may_have_been_released() -> None:
    """As when the kernel could not report all closes: another look at all is needed."""
    some = [numbered(number) for number in range(30)]
    evictable = in_service(some)
    for one in some:
        evictable.found_in_use(one, 0.0, is_watched=True)
    evictable.take_new()
    before = evictable.changes
    evictable.release_all()
    assert evictable.changes > before
    assert known(evictable) == ([], True)
    assert not any(evictable.is_left_alone(one, 0.0) for one in some)
    evictable.found_in_use(some[0], 0.0, is_watched=True)
    assert evictable.is_left_alone(some[0], 0.1)
    assert evictable.next_look_s() == pytest.approx(IN_USE_S)
    while evictable.next_look_s() < 9.0:
        evictable.look_again(9.0)
    assert known(evictable) == ([some[0]], True), "what was found in use since"
    assert not any(evictable.release(one) for one in some[1:])
    assert evictable.release(some[0])


def test_of_very_many_new_ones_few_are_known() -> None:
    evictable = in_service(numbered(number) for number in range(MAX_NEW))
    some, has_more = known(evictable)
    assert (len(some), has_more) == (MAX_NEW, False)
    evictable.enter(numbered(MAX_NEW))
    assert known(evictable) == (some, True)
    evictable.leave(some[-1])
    assert evictable.take_new() == some[:-1]
    assert known(evictable) == ([], False)
