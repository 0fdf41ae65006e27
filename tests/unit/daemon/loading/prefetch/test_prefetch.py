# SPDX-License-Identifier: Apache-2.0
"""Which cell is fetched next before anybody asks."""

from __future__ import annotations

import math
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.loading.look_ahead import (
    COMPARED_AT_ONCE,
    IN_A_ROW,
    LOOKS_AT_ONCE,
    PASS_S,
    PROBE_S,
    SLACK_S,
    Prefetch,
    WayAhead,
    Wish,
)
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import Intent
from shmmap.segment.layout import SourceStamp

RADIUS_M = 50.0
OUTAGE_TOLERANCE_S = 10.0


@cache
def street(columns: int = 80, version: int = 1) -> Catalogue:
    """Cells of 20 m along the x axis: x from -200 m, y from -200 m to 200 m."""
    return Catalogue.from_cells(
        (
            f"/m/{x:03}_{y:03}.pcd",
            (20.0 * x - 200, 20.0 * y - 200, 20.0 * x - 180, 20.0 * y - 180),
            SourceStamp(version, 1, 1),
        )
        for x in range(columns)
        for y in range(20)
    )


class Daemon:
    """What a scheduler keeps of cells: which are there, which are under way, which are not to be tried."""

    def __init__(self, outage_tolerance_s: float = OUTAGE_TOLERANCE_S) -> None:
        self.present: set[tuple[int, str]] = set()
        self.loading: set[tuple[int, str]] = set()
        self.failed: set[tuple[int, str]] = set()
        self.prefetch = Prefetch(self.is_absent, outage_tolerance_s)
        self.catalogue = street()

    def is_absent(self, index: int, layer: str) -> bool:
        return (index, layer) not in self.present | self.loading | self.failed

    def client(
        self, name: str, y: float = 0.0, layers: tuple[str, ...] = ("points",), route: bool = True
    ) -> Motion:
        """Somebody at x = 0 who drives 10 m/s along the street, and asks for a circle."""
        motion = Motion()
        for second in (0, 1):
            vertices = ((-20.0, y), (1300.0, y)) if route else ()
            motion.update(Intent(10.0 * (second - 1), y, route=vertices), float(second))
        self.prefetch.ways[name] = WayAhead(motion, Circle(0.0, y, RADIUS_M), layers)
        return motion

    def next(self, now_s: float) -> Wish | None:
        """Ask until there is a wish, or none can be."""
        for _ in range(10_000):
            wish = self.prefetch.next(self.catalogue, now_s)
            if wish is not None or not self.prefetch.more:
                return wish
        raise AssertionError("it never ends")

    def wishes(self, now_s: float, most: int = 100_000) -> list[Wish]:
        """Take one wish after the other, as if all were loading."""
        found: list[Wish] = []
        while len(found) < most and (wish := self.next(now_s)) is not None:
            assert self.is_absent(wish.cell, wish.layer)
            self.loading.add((wish.cell, wish.layer))
            found.append(wish)
        return found


def test_nobody_is_there() -> None:
    daemon = Daemon()
    assert daemon.next(1.0) is None
    assert daemon.prefetch.next_s(1.0) == math.inf


def test_in_order_of_time_each_once() -> None:
    daemon = Daemon()
    daemon.client("a")
    found = daemon.wishes(1.0)
    times = [wish.needed_in_s for wish in found]
    assert times == sorted(times)
    assert len({wish.cell for wish in found}) == len(found) > 50
    assert times[-1] > OUTAGE_TOLERANCE_S, "what is needed after the longest outage is wished for, too"
    assert daemon.next(1.0) is None
    assert not daemon.prefetch.more


def test_of_two_clients_what_either_needs_first() -> None:
    daemon = Daemon()
    daemon.client("a", y=-100.0)
    daemon.client("b", y=100.0)
    found = daemon.wishes(1.0)
    times = [wish.needed_in_s for wish in found]
    assert times == sorted(times)
    assert len({wish.cell for wish in found}) == len(found)
    alone = []
    for y in (-100.0, 100.0):
        one = Daemon()
        one.client("only", y)
        alone += [wish.cell for wish in one.wishes(1.0)]
    assert {wish.cell for wish in found} == set(alone)


def test_of_many_clients_some_are_compared_at_a_time() -> None:
    """The order is that of all of them, though a call looks at few."""
    daemon = Daemon()
    count = 3 * COMPARED_AT_ONCE
    for number in range(count):
        daemon.client(str(number), y=float(number % 40) * 10.0 - 200.0)
    calls = 1
    while (first := daemon.prefetch.next(daemon.catalogue, 1.0)) is None:
        assert daemon.prefetch.more
        calls += 1
    assert calls > count // COMPARED_AT_ONCE
    daemon.loading.add((first.cell, first.layer))
    found = daemon.wishes(1.0)
    times = [wish.needed_in_s for wish in found]
    assert times == sorted(times)
    assert first.needed_in_s <= times[0]
    assert len({wish.cell for wish in found}) == len(found) > 200


def test_clients_that_need_the_same() -> None:
    daemon = Daemon()
    daemon.client("a")
    daemon.client("b")
    found = daemon.wishes(1.0)
    assert len({wish.cell for wish in found}) == len(found)


def test_every_layer_that_is_asked_for() -> None:
    daemon = Daemon()
    daemon.client("a", layers=("points", "ndt(leaf=2.0)"))
    found = daemon.wishes(1.0)
    assert len({(wish.cell, wish.layer) for wish in found}) == len(found)
    cells = {wish.cell for wish in found}
    assert {(wish.cell, wish.layer) for wish in found} == {
        (cell, layer) for cell in cells for layer in ("points", "ndt(leaf=2.0)")
    }


def test_what_has_failed_is_passed_over_and_wished_for_later() -> None:
    daemon = Daemon()
    motion = daemon.client("a")
    first = daemon.next(1.0)
    assert first is not None
    daemon.failed.add((first.cell, first.layer))
    assert first.cell not in {wish.cell for wish in daemon.wishes(1.0)}
    daemon.failed.clear()
    assert daemon.next(1.0 + 0.5 * PASS_S) is None
    motion.update(Intent(10.0, 0.0, route=((-20.0, 0.0), (1300.0, 0.0))), 2.0)
    again = daemon.next(1.0 + PASS_S)
    assert again is not None
    assert again.cell == first.cell


def test_a_long_pass_begins_again_too() -> None:
    """Where loads take longer than a pass, what failed at its beginning is not forgotten."""
    daemon = Daemon(outage_tolerance_s=60.0)
    daemon.client("a")
    first = daemon.next(1.0)
    assert first is not None
    daemon.failed.add((first.cell, first.layer))
    second = daemon.next(1.5)
    assert second is not None
    assert second.cell != first.cell
    daemon.failed.clear()
    assert [wish.cell for wish in daemon.wishes(1.0 + PASS_S, 1)] == [first.cell]


def failing(daemon: Daemon, took_s: float = 0.0) -> None:
    for _ in range(IN_A_ROW):
        daemon.prefetch.health.ended(took_s, failed=True)


def test_in_an_outage_one_try_now_and_then() -> None:
    daemon = Daemon()
    daemon.client("a")
    assert len(daemon.wishes(1.0, 3)) == 3
    failing(daemon)
    assert daemon.next(1.0 + 0.5 * PROBE_S) is None
    assert daemon.prefetch.next_s(1.0 + 0.5 * PROBE_S) == 1.0 + PROBE_S
    assert len(daemon.wishes(1.0 + PROBE_S)) == 1
    assert len(daemon.wishes(1.0 + 2 * PROBE_S)) == 1


def test_after_an_outage_what_failed_in_it_comes_first() -> None:
    daemon = Daemon()
    daemon.client("a")
    begun = [wish.cell for wish in daemon.wishes(1.0, 5)]
    failing(daemon)
    assert daemon.next(1.1) is None
    daemon.loading.clear()
    assert daemon.prefetch.health.ended(0.1, failed=False)
    assert [wish.cell for wish in daemon.wishes(1.4, 5)] == begun


def test_without_a_route_outages_are_prepared_for_after_the_first() -> None:
    daemon = Daemon()
    daemon.client("a", route=False)
    before = daemon.prefetch.look_ahead
    assert before.straight_s == before.sides_s < OUTAGE_TOLERANCE_S < before.way_s
    failing(daemon)
    daemon.next(10.0)
    daemon.next(18.0)
    daemon.prefetch.health.ended(0.1, failed=False)
    daemon.next(18.5)
    after = daemon.prefetch.look_ahead
    assert after.straight_s == pytest.approx(after.sides_s + 8.5)
    assert after.sides_s == pytest.approx(before.sides_s, abs=0.5)
    for away_s, expected_s in ((0.5 * SLACK_S, 8.5), (SLACK_S + 0.1, SLACK_S + 0.1)):
        for begin_s in (100.0, 200.0, 300.0, 400.0, 500.0):
            failing(daemon)
            daemon.next(begin_s)
            daemon.prefetch.health.ended(0.1, failed=False)
            daemon.next(begin_s + away_s)
        straight_s = daemon.prefetch.look_ahead.straight_s
        assert straight_s == pytest.approx(after.sides_s + expected_s, abs=0.6), "only longer ones count"


def test_an_outage_begins_with_the_loads_that_fail_not_when_they_have() -> None:
    """A silent server is noticed only after seconds; the next outage is prepared for in full length."""
    daemon = Daemon()
    daemon.client("a", route=False)
    before = daemon.prefetch.look_ahead
    failing(daemon, took_s=4.0)  # begun at 10 s
    daemon.next(14.0)
    failing(daemon, took_s=0.1)
    daemon.next(18.0)
    daemon.prefetch.health.ended(0.1, failed=False)
    daemon.next(19.0)
    after = daemon.prefetch.look_ahead
    assert after.straight_s == pytest.approx(after.sides_s + 9.0)
    assert after.sides_s == pytest.approx(before.sides_s, abs=0.5)


def test_slow_loads_are_wished_for_earlier() -> None:
    daemon = Daemon()
    quick = daemon.prefetch.look_ahead
    for _ in range(20):
        daemon.prefetch.health.ended(3.0, failed=False)
    slow = daemon.prefetch.look_ahead
    assert slow.way_s - quick.way_s == slow.sides_s - quick.sides_s > 3.0


def test_another_map_means_other_cells() -> None:
    daemon = Daemon()
    motion = daemon.client("a")
    before = daemon.wishes(1.0, 5)
    daemon.catalogue = street(79, 2)
    daemon.loading.clear()
    after = daemon.wishes(1.1, 5)
    assert len(after) == 5
    boxes = [daemon.catalogue.box(wish.cell) for wish in after]
    assert boxes == [street().box(wish.cell) for wish in before]
    assert motion.route is not None


def test_a_map_without_cells() -> None:
    daemon = Daemon()
    daemon.client("a")
    daemon.catalogue = Catalogue.from_cells([])
    assert daemon.wishes(1.0) == []


def test_after_a_jump_nothing_of_the_way_before_is_wished_for() -> None:
    daemon = Daemon()
    motion = daemon.client("a")
    assert len(daemon.wishes(1.0, 3)) == 3
    for second in (1.5, 2.5):
        motion.update(Intent(1000.0 + 10.0 * second, 0.0), second)
    daemon.prefetch.ways["a"].asks(Circle(1025.0, 0.0, RADIUS_M), ("points",))
    wishes = daemon.wishes(2.5)
    assert wishes
    assert all(daemon.catalogue.box(wish.cell)[0] > 1000.0 for wish in wishes)


def test_who_leaves_wishes_for_nothing() -> None:
    daemon = Daemon()
    daemon.client("a")
    daemon.client("b", y=100.0)
    daemon.wishes(1.0, 4)
    del daemon.prefetch.ways["a"], daemon.prefetch.ways["b"]
    assert daemon.next(1.0) is None
    assert not daemon.prefetch.more


def test_who_stands_wishes_for_nothing() -> None:
    daemon = Daemon()
    motion = Motion()
    for second in range(5):
        motion.update(Intent(0.0, 0.0), float(second))
    daemon.prefetch.ways["a"] = WayAhead(motion, Circle(0.0, 0.0, RADIUS_M), ("points",))
    assert daemon.next(5.0) is None
    assert daemon.prefetch.next_s(5.0) == math.inf


def test_one_call_looks_at_little() -> None:
    """Whatever there is to look at, one call does a bounded part of it, and says that there is more."""

    class Counted(Catalogue):
        asked = 0

        def query(self, *arguments, **named):  # type: ignore[no-untyped-def]
            Counted.asked += 1
            return super().query(*arguments, **named)

    boxes = [street().box(index) for index in range(len(street()))]
    counted = Counted.from_cells((f"/{n:05}", box, SourceStamp(1, 1, 1)) for n, box in enumerate(boxes))
    daemon = Daemon()
    daemon.catalogue = counted
    for number in range(40):
        daemon.client(str(number), y=5.0 * number - 100.0)
    daemon.present = {(index, "points") for index in range(len(counted))}
    calls = 0
    while True:
        before = Counted.asked
        assert daemon.prefetch.next(counted, 1.0) is None
        assert Counted.asked - before <= 4 * LOOKS_AT_ONCE  # where it is, and three ways to go on
        calls += 1
        if not daemon.prefetch.more:
            break
    assert calls >= 40 * OUTAGE_TOLERANCE_S * 10.0 / 10.0 / LOOKS_AT_ONCE


steps = st.lists(
    st.tuples(
        st.sampled_from(["wish", "done", "fail", "forget", "move", "jump", "evict", "turn", "map"]),
        st.integers(0, 7),
        st.floats(0.01, 3.0),
    ),
    max_size=60,
)


@settings(deadline=None)
@given(steps)
def test_whatever_happens_a_wish_is_for_what_is_absent(
    happenings: list[tuple[str, int, float]],
) -> None:
    """And no cell is wished for while it loads."""
    daemon, now_s = Daemon(), 1.0
    motions = [daemon.client("a"), daemon.client("b", y=60.0, route=False)]
    for what, number, later_s in happenings:
        now_s += later_s
        under_way = sorted(daemon.loading)
        if what == "wish":
            daemon.wishes(now_s, number)  # which checks it
        elif what in ("done", "fail") and under_way:
            key = under_way[number % len(under_way)]
            daemon.loading.discard(key)
            (daemon.present if what == "done" else daemon.failed).add(key)
            if daemon.prefetch.health.ended(later_s, failed=what == "fail"):
                daemon.failed.clear()
        elif what == "forget":
            daemon.failed.clear()
        elif what == "evict":
            daemon.present = set(sorted(daemon.present)[number:])
        elif what == "map":
            daemon.catalogue = street(80 - number, number)
            daemon.present, daemon.loading, daemon.failed = set(), set(), set()
        else:
            motion = motions[number % 2]
            x, y = {"move": (motion.x + 10 * later_s, motion.y), "jump": (400.0 - motion.x, motion.y)}.get(
                what, (motion.x, motion.y + 10 * later_s)
            )
            route = ((-20.0, 0.0), (1300.0, 0.0)) if number % 2 == 0 else ()
            motion.update(Intent(x, y, route=route), now_s)
            way = daemon.prefetch.ways["ab"[number % 2]]
            way.asks(Circle(x, y, RADIUS_M), ("points",))
    wish = daemon.next(now_s + PASS_S)
    assert wish is None or 0.0 <= wish.needed_in_s < math.inf
