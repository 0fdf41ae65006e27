# SPDX-License-Identifier: Apache-2.0
"""The order in which segments are evicted: by scores, as a plain sort says, and how little work it takes."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from shmmap.daemon.cache.eviction_order import BATCH, FRONT, TRIES, Deferred, EvictionOrder, Score
from shmmap.daemon.cache.evictor import SOON_S, eviction_scores
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import Places, merged_places, places_of, until_needed
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


def numbered(number: int, last_use_s: float = 0.0) -> Resident:
    return Resident(
        f"/{number}", Key(f"/{number}.pcd", "points"), number, 100, 0, (0.0,) * 4, 0.0, 0.0,
        last_use_s=last_use_s,
    )  # fmt: skip


class Worth:
    """Scores as a test says."""

    def __init__(self) -> None:
        self.of_number: dict[int, float] = {}
        self.version = 0
        self.calls = 0

    def __call__(self, some: Sequence[Resident]) -> list[float]:
        self.calls += 1
        return [self.of_number[one.version] for one in some]

    @property
    def score(self) -> Score:
        return Score(self, self.version)

    def rank(self, one: Resident) -> tuple[bool, float, float]:
        """The least goes first."""
        return bool(one.sessions), -self.of_number[one.version], one.last_use_s


def offered(order: EvictionOrder, worth: Worth, now_s: float) -> list[Resident]:
    """What should go first, once there are enough in order."""
    while order.fill(worth.score, now_s):
        pass
    while (front := order.front(worth.score)) is None:
        pass
    return front


class Machine(RuleBasedStateMachine):
    """As few segments as are offered at once: always exactly as a sort says, whatever moves or is used."""

    def __init__(self) -> None:
        super().__init__()
        self.order, self.worth = EvictionOrder(), Worth()
        self.known: dict[Resident, float] = {}  # since when they may go
        self.now_s = 10.0
        self.number = 0

    def any(self, draw: int) -> Resident:
        return list(self.known)[draw % len(self.known)]

    @precondition(lambda self: len(self.known) < FRONT)
    @rule(score=st.integers(0, 5), last_use_s=st.integers(0, 5))
    def enter(self, score: int, last_use_s: int) -> None:
        self.number += 1
        one = numbered(self.number, last_use_s)
        self.worth.of_number[self.number] = score
        self.known[one] = -math.inf
        self.order.new[one] = None

    @precondition(lambda self: self.known)
    @rule(draw=st.integers(0, 100))
    def leave(self, draw: int) -> None:
        one = self.any(draw)
        del self.known[one]
        self.order.leave(one)

    @precondition(lambda self: self.known)
    @rule(draw=st.integers(0, 100), delay_s=st.sampled_from([0.5, 2.0, math.inf]), in_grace=st.booleans())
    def defer(self, draw: int, delay_s: float, in_grace: bool) -> None:
        one = self.any(draw)
        self.order.defer(one, self.order.in_grace if in_grace else self.order.deferred, self.now_s + delay_s)
        self.known[one] = self.now_s + delay_s

    @precondition(lambda self: self.known)
    @rule(draw=st.integers(0, 100))
    def reconsider(self, draw: int) -> None:
        one = self.any(draw)
        if one not in self.order.in_grace:
            self.known[one] = -math.inf
        self.order.reconsider(one)

    @rule()
    def reconsider_all(self) -> None:
        self.order.reconsider_all()
        for one in self.known:
            if one not in self.order.in_grace:
                self.known[one] = -math.inf

    @precondition(lambda self: self.known)
    @rule(draw=st.integers(0, 100), held=st.booleans())
    def use(self, draw: int, held: bool) -> None:
        one = self.any(draw)
        one.last_use_s = self.now_s
        (one.sessions.add if held else one.sessions.discard)(7)

    @precondition(lambda self: self.known)
    @rule(draw=st.integers(0, 100), score=st.integers(0, 5))
    def move(self, draw: int, score: int) -> None:
        self.worth.of_number[self.any(draw).version] = score
        self.worth.version += 1

    @rule(seconds=st.sampled_from([0.0, 0.4, 3.0]))
    def tick(self, seconds: float) -> None:
        self.now_s += seconds

    @invariant()
    def offered_as_sorted(self) -> None:
        front = offered(self.order, self.worth, self.now_s)
        free = sorted((one for one, since in self.known.items() if since <= self.now_s), key=self.worth.rank)
        assert set(front) == set(free)
        assert [self.worth.rank(one) for one in front] == [self.worth.rank(one) for one in free]
        assert len(self.order) == len(self.known)


TestOrder = Machine.TestCase
TestOrder.settings = settings(max_examples=100, stateful_step_count=60, deadline=None)


@pytest.mark.parametrize("count", [100, 5000])
def test_all_of_many_in_order(count: int) -> None:
    """While nothing moves, exactly as a sort says, also what came in between and was used since."""
    random.seed(count)
    order, worth = EvictionOrder(), Worth()
    some = [numbered(number, random.random()) for number in range(count)]
    for one in some:
        worth.of_number[one.version] = random.random() * 100
        order.new[one] = None
    while order.new:
        order.score_new(worth.score)
    for one in random.sample(some, count // 3):
        one.last_use_s += 1.0
    gone: list[Resident] = []
    while front := offered(order, worth, 0.0):
        for one in front[:7]:
            order.leave(one)
            gone.append(one)
    assert gone == sorted(some, key=worth.rank)


def settled(count: int, worth: Worth) -> tuple[EvictionOrder, list[Resident]]:
    order, some = EvictionOrder(), [numbered(number) for number in range(count)]
    for one in some:
        worth.of_number[one.version] = float(one.version)
        order.new[one] = None
    while order.new:
        order.score_new(worth.score)
    return order, some


def test_when_clients_move_nothing_goes_by_an_old_score() -> None:
    """What is worth keeping now stays although its score is old; what is worth less now is found later."""
    worth = Worth()
    order, some = settled(10_000, worth)
    near, far = some[-FRONT:], some[:FRONT]
    worth.version += 1
    worth.of_number.update({one.version: 0.0 for one in near})
    worth.of_number.update({one.version: 1e9 for one in far})
    front = offered(order, worth, 0.0)
    assert front == some[-FRONT - 1 : -2 * FRONT - 1 : -1]
    order.refresh(some[:BATCH], worth.score)
    assert set(offered(order, worth, 0.0)) == set(far)


@pytest.mark.parametrize("count", [1000, 20_000])
def test_the_work_for_a_victim_does_not_depend_on_how_many_there_are(count: int) -> None:
    worth = Worth()
    order, _ = settled(count, worth)
    scored, calls = order.scored, worth.calls
    for _ in range(100):
        order.leave(offered(order, worth, 0.0)[0])
    assert order.scored == scored, "nothing has moved"
    worth.version += 1  # everything may be elsewhere
    worth.of_number = dict.fromkeys(worth.of_number, 1.0)
    for _ in range(100):
        before = order.scored
        order.leave(offered(order, worth, 0.0)[0])
        assert order.scored - before <= TRIES * FRONT
    assert worth.calls - calls <= 100 * TRIES
    assert order.scored - scored <= 100 * TRIES * FRONT
    assert len(order) == count - 200


def test_few_come_back_at_a_time() -> None:
    """Of those that are due, and of all that are reconsidered."""
    worth = Worth()
    order, some = settled(4 * BATCH, worth)
    for one in some:
        order.defer(one, order.deferred, 5.0)
    assert offered(order, worth, 4.0) == []
    before = order.scored
    assert len(offered(order, worth, 5.0)) == FRONT
    assert order.scored - before == FRONT
    assert len(order.deferred) == 2 * BATCH
    order.reconsider_all()
    assert len(order.deferred) == 0
    offered(order, worth, 5.0)
    assert order.scored - before == FRONT, "there are enough"
    order.score_new(worth.score)
    assert order.scored - before == FRONT + BATCH


def test_very_many_that_are_released_at_once_are_forgotten_a_few_at_a_time() -> None:
    """As when a client that has mapped them leaves."""
    deferred, some = Deferred(), [numbered(number) for number in range(4 * BATCH)]
    for one in some:
        deferred.put(one, float(one.version))
    for one in some[:-1]:
        deferred.take(one)
    assert deferred.first() == (BATCH, some[BATCH])
    assert [deferred.first() for _ in range(3)][-1] == (4 * BATCH - 1, some[-1])
