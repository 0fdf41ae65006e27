# SPDX-License-Identifier: Apache-2.0
"""Which cells clients will ask for next, and which of them is fetched first."""

from __future__ import annotations

import math
from functools import cache
from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.loading import look_ahead
from shmmap.daemon.loading.look_ahead import (
    BESIDE_M,
    CELL_WORK,
    IN_A_ROW,
    LOOK_WORK,
    MAX_CELLS,
    PASS_S,
    PROBE_S,
    READ_PER_CALL,
    SLACK_S,
    WORK_PER_CALL,
    ClientPath,
    LookAhead,
    OriginHealth,
    Prefetch,
    Reader,
    Wish,
)
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import WORK_S
from shmmap.geometry import Area, Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.spatial_index import touches
from shmmap.protocol.messages import Intent
from shmmap.segment.layout import SourceStamp

AHEAD = LookAhead(route_s=20.0, straight_s=8.0, sides_s=4.0)
STEP_M = 10.0
RADIUS_M = 50.0
TOLERANCE_S = 10.0
ROUTE = ((-20.0, 0.0), (1300.0, 0.0))

Vertices = tuple[tuple[float, float], ...]


def move(motion: Motion, x: float, y: float, now_s: float, route: Vertices = ()) -> None:
    motion.update(Intent(x, y, route=route), now_s)


def driving(vx: float, *route: tuple[float, float], y: float = 0.0) -> Motion:
    """A client at x = 0 that has driven at this speed."""
    motion = Motion()
    move(motion, -vx, y, 0.0, route)
    move(motion, 0.0, y, 1.0, route)
    return motion


@cache
def town(columns: int = 100, version: int = 1) -> Catalogue:
    """Cells of 20 m: x from -200 m, y from -400 m to 400 m."""
    return Catalogue.from_cells(
        (
            f"/m/{x:03}_{y:03}.pcd",
            (20.0 * x - 200, 20.0 * y - 400, 20.0 * x - 180, 20.0 * y - 380),
            SourceStamp(version, 1, 1),
        )
        for x in range(columns)
        for y in range(40)
    )


# --- the origin's health ----------------------------------------------------------------------


def test_many_failures_in_a_row_are_an_outage_until_one_load_succeeds() -> None:
    health = OriginHealth()
    assert (health.slow_s, health.is_out, health.next_try_s()) == (0.0, False, -math.inf)
    for _ in range(IN_A_ROW - 1):
        assert not health.ended(0.1, failed=True)
    assert not health.is_out
    assert not health.ended(0.1, failed=False), "it was not away"
    health.tried(7.0)
    for _ in range(IN_A_ROW):
        health.ended(0.1, failed=True)
    assert (health.is_out, health.next_try_s()) == (True, 7.0 + PROBE_S)
    health.tried(8.0)
    assert health.next_try_s() == 8.0 + PROBE_S
    assert health.ended(0.1, failed=False)
    assert not health.ended(0.1, failed=False), "once"
    assert health.next_try_s() == -math.inf


def test_loads_from_the_disk_are_not_held_back_by_an_outage() -> None:
    health = OriginHealth(unreachable=True)
    health.tried(10.0)
    health.ended(0.1, failed=False)
    assert (health.is_out, health.next_try_s()) == (True, -math.inf)
    health.tried(11.0)
    health.ended(0.1, failed=True)
    assert health.next_try_s() == 11.0 + PROBE_S


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=200))
def test_times_are_those_of_the_last_successful_loads(times: list[float]) -> None:
    health = OriginHealth()
    for took_s in times:
        health.ended(took_s, failed=False)
        health.ended(1e9, failed=True)
    last = times[-64:]
    assert sum(took_s > health.slow_s for took_s in last) <= len(last) / 20
    assert health.slow_s in last


# --- one client's path ------------------------------------------------------------------------


def path_of(motion: Motion, area: Area | None = None) -> ClientPath:
    return ClientPath(motion, area or Circle(motion.x, motion.y, RADIUS_M), ("points",))


def looked(
    path: ClientPath, ahead: LookAhead = AHEAD, catalogue: Catalogue | None = None
) -> list[tuple[float, int]]:
    """What is found along all of a path: seconds, and indices."""
    steps = list(islice(path.look(catalogue or town(), ahead, STEP_M), 2000))
    assert len(steps) < 2000
    return [(needed_in_s, cell) for needed_in_s, cells in steps for cell in cells]


def cells_at(x: float, y: float, radius: float = RADIUS_M) -> set[int]:
    return set(town().query(Circle(x, y, radius))[0].tolist())


def asked_along(vertices: list[tuple[float, float]], radius: float = RADIUS_M) -> set[int]:
    """All cells that a client newly asks for along a line from the origin, looking closely."""
    found: set[int] = set()
    for (x0, y0), (x1, y1) in pairwise(vertices):
        for share in np.linspace(0.0, 1.0, 400).tolist():
            found |= cells_at(x0 + share * (x1 - x0), y0 + share * (y1 - y0), radius)
    return found - cells_at(0.0, 0.0)


def test_along_a_route_all_that_will_be_asked_for_in_order_of_time() -> None:
    route = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (700.0, 100.0)]
    motion = driving(10.0, *route)
    found = looked(path_of(motion))
    times, cells = zip(*found, strict=True)
    assert list(times) == sorted(times)
    assert len(cells) < 1.1 * len(set(cells)), "few are left and come to again"
    assert asked_along(route[:3]) <= set(cells), "20 s of it"
    assert set(cells) <= asked_along(route[:3], RADIUS_M + BESIDE_M)
    assert motion.route is not None
    for needed_s, cell in {cell: (time, cell) for time, cell in reversed(found)}.values():
        for x, y in motion.route.at(np.linspace(0.0, max(0.0, 10.0 * needed_s - 0.1), 50)).tolist():
            assert cell not in cells_at(x, y), "not before it is needed"


def test_a_client_may_be_a_little_beside_its_route() -> None:
    route = [(0.0, 0.0), (150.0, 0.0), (150.0, 400.0)]
    found = {cell for _, cell in looked(path_of(driving(10.0, *route)))}
    beside = [(x + 0.7 * BESIDE_M, y - 0.7 * BESIDE_M) for x, y in [*route[:2], (150.0, 50.0)]]
    assert asked_along(beside) <= found


def test_without_a_route_straight_ahead_and_to_the_sides() -> None:
    cells = {cell for _, cell in looked(path_of(driving(10.0)))}
    assert asked_along([(0.0, 0.0), (80.0, 0.0)]) <= cells
    # two gentle turns; what lies to the sides is needed a second later
    for angle in (0.25, -0.25):
        assert asked_along([(0.0, 0.0), (30.0 * math.cos(angle), 30.0 * math.sin(angle))]) <= cells
    middles = town().boxes[sorted(cells)].reshape(-1, 2, 2).mean(axis=1)
    assert middles[:, 0].max() < 80.0 + RADIUS_M + 20.0
    assert middles[:, 0].min() > -10.0, "not behind"


def test_after_a_long_straight_the_look_ahead_is_longer_until_the_client_turns() -> None:
    """After 500 m as far again as the client came since, but no farther than along a route."""
    motion = Motion()
    seconds = []
    for second in range(0, 100, 5):
        move(motion, 10.0 * second, 0.0, float(second))
        seconds.append(path_of(motion).looks_s(AHEAD))
    assert seconds[:13] == [AHEAD.straight_s] * 12 + [pytest.approx(10.0)]
    assert seconds[14:] == [AHEAD.route_s] * 6
    far_m = max(town().boxes[[cell for _, cell in looked(path_of(motion))]][:, 0]) - motion.x
    assert 200.0 <= far_m <= 200.0 + RADIUS_M
    move(motion, 950.0, 50.0, 100.0)
    assert path_of(motion).looks_s(AHEAD) == AHEAD.straight_s


def test_beyond_a_routes_end_only_as_far_as_to_the_sides() -> None:
    found = {cell for _, cell in looked(path_of(driving(10.0, (-10.0, 0.0), (20.0, 0.0))))}
    middles = town().boxes[sorted(found)].reshape(-1, 2, 2).mean(axis=1)
    assert 40.0 + RADIUS_M - 15.0 < middles[:, 0].max() < 40.0 + RADIUS_M + 20.0


def test_a_trajectory_sent_again_each_second() -> None:
    """150 m ahead, from where the client is: whatever it asks for was found before."""
    motion, found = Motion(), set[int]()
    path = path_of(motion)
    for second in range(40):
        x = 12.0 * second
        move(motion, x, 0.2, float(second), tuple((x + 10.0 * n, 0.0) for n in range(16)))
        inside = cells_at(x, 0.2)
        assert second <= 2 or inside <= found
        path.area = Circle(x, 0.2, RADIUS_M)
        found |= inside | {cell for _, cell in looked(path)}


@pytest.mark.parametrize(
    ("speed", "route", "moves"),
    [(0.0, (), False), (0.0, ROUTE, False), (10.0, (), False), (10.0, ROUTE, True)],
)
def test_at_a_red_light_a_client_with_a_route_will_go_on(speed: float, route: Vertices, moves: bool) -> None:
    """If it has driven before; without a route it is unknown where to."""
    motion = driving(speed, *route)
    for second in range(2, 30):
        move(motion, 0.0, 0.0, float(second), route)
    path = path_of(motion)
    assert path.moves is moves
    assert bool(looked(path)) is moves


def test_of_an_area_with_very_many_cells_nothing() -> None:
    huge = Catalogue.from_cells(
        (f"/{n:06}", (float(n % 200), float(n // 200), n % 200 + 1.0, n // 200 + 1.0), SourceStamp(1, 1, 1))
        for n in range(2 * MAX_CELLS)
    )
    assert looked(path_of(driving(10.0), Circle(0.0, 0.0, 1000.0)), catalogue=huge) == []


hostile = st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(hostile, hostile), max_size=6),
    st.tuples(hostile, hostile, hostile, hostile),
    st.floats(0, 1e4),
)
def test_hostile_clients(
    route: list[tuple[float, float]], pose: tuple[float, float, float, float], look_s: float
) -> None:
    """Whatever a client sends, a pass has an end, and times are finite."""
    motion = Motion()
    for second in (0.0, 1.0):
        motion.update(Intent(*pose, route=tuple(route)), second)
    found = looked(path_of(motion), LookAhead(look_s, look_s, look_s))
    assert all(0.0 <= needed_s < math.inf for needed_s, _ in found)


# --- wishes of all clients --------------------------------------------------------------------


class Daemon:
    """What a scheduler knows of cells: which are there, which are loading, which are not to be tried."""

    def __init__(self, outage_tolerance_s: float = TOLERANCE_S) -> None:
        self.present: set[tuple[int, str]] = set()
        self.loading: set[tuple[int, str]] = set()
        self.failed: set[tuple[int, str]] = set()
        self.prefetch, self.reader = Prefetch(self.is_absent, outage_tolerance_s), Reader(self.is_absent)
        self.catalogue = town()

    def is_absent(self, index: int, layer: str) -> bool:
        return (index, layer) not in self.present | self.loading | self.failed

    def client(
        self, name: str, y: float = 0.0, layers: tuple[str, ...] = ("points",), route: bool = True
    ) -> Motion:
        """A client at x = 0 that drives 10 m/s along the street, and asks for a circle."""
        motion = driving(10.0, *(((-20.0, y), (1300.0, y)) if route else ()), y=y)
        self.prefetch.follow(name, motion, Circle(0.0, y, RADIUS_M), layers)
        return motion

    def next(self, now_s: float) -> Wish | None:
        """Ask until there is a wish, or none can be."""
        for _ in range(10_000):
            wish = self.prefetch.next(self.catalogue, now_s, self.reader)
            if wish is not None or self.next_s(now_s) > now_s:
                return wish
        raise AssertionError("it never ends")

    def next_s(self, now_s: float) -> float:
        return self.prefetch.next_s(now_s, self.reader)

    def wishes(self, now_s: float, most: int = 100_000) -> list[Wish]:
        """Take one wish after the other, as if all were loading."""
        found: list[Wish] = []
        while len(found) < most and (wish := self.next(now_s)) is not None:
            assert self.is_absent(wish.cell, wish.layer)
            self.loading.add((wish.cell, wish.layer))
            found.append(wish)
        return found

    def outage(self, took_s: float = 0.0) -> None:
        for _ in range(IN_A_ROW):
            self.prefetch.health.ended(took_s, failed=True)


@pytest.mark.parametrize(
    "clients",
    [
        [(0.0, ("points",))],
        [(-100.0, ("points",)), (100.0, ("points",))],
        [(0.0, ("points",)), (0.0, ("points",))],
        [(0.0, ("points", "ndt(leaf=2.0)"))],
        [(number % 40 * 10.0 - 200.0, ("points",)) for number in range(200)],
    ],
    ids=["one", "two", "two that need the same", "two layers", "very many"],
)
def test_all_in_order_of_time_each_once(clients: list[tuple[float, tuple[str, ...]]]) -> None:
    daemon = Daemon()
    alone: set[tuple[int, str]] = set()
    for number, (y, layers) in enumerate(clients):
        daemon.client(str(number), y, layers)
        if number < 3:
            one = Daemon()
            one.client("only", y, layers)
            alone |= {(wish.cell, wish.layer) for wish in one.wishes(1.0)}
    found = daemon.wishes(1.0)
    times = [wish.needed_in_s for wish in found]
    assert times == sorted(times)
    assert times[-1] > TOLERANCE_S, "what is needed after the longest outage is wished for, too"
    wished = {(wish.cell, wish.layer) for wish in found}
    assert len(wished) == len(found) > 50
    assert wished >= alone
    assert len(clients) > 3 or wished == alone
    assert daemon.next(1.0) is None


def test_clients_that_stand_or_have_left_wish_for_nothing() -> None:
    daemon = Daemon()
    assert daemon.next(1.0) is None
    daemon.client("a")
    daemon.wishes(1.0, 4)
    del daemon.prefetch.paths["a"]
    motion = Motion()
    for second in range(5):
        move(motion, 0.0, 0.0, float(second))
    daemon.prefetch.follow("b", motion, Circle(0.0, 0.0, RADIUS_M), ("points",))
    assert daemon.next(5.0) is None
    assert daemon.next_s(5.0) == math.inf


def test_what_has_failed_is_passed_over_and_wished_for_in_a_later_pass() -> None:
    daemon = Daemon()
    motion = daemon.client("a")
    first = daemon.next(1.0)
    assert first is not None
    daemon.failed.add((first.cell, first.layer))
    assert first.cell not in {wish.cell for wish in daemon.wishes(1.0)}
    daemon.failed.clear()
    assert daemon.next(1.0 + 0.5 * PASS_S) is None
    move(motion, 10.0, 0.0, 2.0, ROUTE)
    assert [wish.cell for wish in daemon.wishes(1.0 + PASS_S, 1)] == [first.cell]


def test_what_has_failed_comes_first_in_the_next_pass() -> None:
    """Though the list of the last one has not been read to its end."""
    daemon = Daemon(outage_tolerance_s=60.0)
    daemon.client("a")
    first = daemon.next(1.0)
    assert first is not None
    daemon.failed.add((first.cell, first.layer))
    second = daemon.next(1.1)
    assert second is not None
    assert second.cell != first.cell
    daemon.failed.clear()
    for _ in range(1000):
        wish = daemon.next(1.0 + PASS_S)
        assert wish is not None
        if wish.cell == first.cell:
            break
    else:
        raise AssertionError("it never comes")


def test_after_a_jump_another_pass_begins_soon() -> None:
    """And until then nothing is wished for on its old path; nor when the client has left."""
    daemon = Daemon()
    motion = daemon.client("a")
    daemon.client("b", y=200.0)
    assert len(daemon.wishes(1.0, 5)) == 5
    move(motion, 1200.0, -300.0, 1.1)
    move(motion, 1210.0, -300.0, 2.1)
    daemon.prefetch.follow("a", motion, Circle(1210.0, -300.0, RADIUS_M), ("points",))
    now_s = 1.0 + 0.9 * PASS_S
    on_old_list = daemon.wishes(now_s)
    assert on_old_list
    assert min(town().box(wish.cell)[1] for wish in on_old_list) > 200.0 - 2.0 * RADIUS_M
    assert daemon.next_s(now_s) == 1.0 + PASS_S
    found = daemon.wishes(1.0 + PASS_S)
    assert found
    assert all(town().box(wish.cell)[0] > 1200.0 for wish in found)
    assert daemon.next_s(2.0) == 1.0 + 2.0 * PASS_S
    daemon.loading.clear()
    assert daemon.next(1.9) is None, "the list has been read"


def test_in_an_outage_a_list_that_has_been_read_is_left_alone() -> None:
    """Whether loads fail, or succeed from the disk."""
    for failed in (True, False):
        daemon = Daemon()
        daemon.client("a")
        assert daemon.wishes(1.0)
        daemon.prefetch.health.unreachable = True
        daemon.prefetch.health.ended(0.1, failed=failed)
        assert daemon.next(1.1) is None
        assert daemon.next_s(1.1) >= 1.0 + PROBE_S


def test_two_readers_of_one_list_lack_different_cells() -> None:
    """What a client that has left would have needed is lacked by none."""
    daemon = Daemon()
    daemon.client("a")
    everything = daemon.wishes(1.0)
    on_disk = {(wish.cell, wish.layer) for wish in everything[::2]}
    disk = Reader(lambda index, layer: (index, layer) not in on_disk)
    found: list[Wish] = []
    daemon.reader = disk
    while (wish := daemon.next(1.1)) is not None:
        assert wish.needed_in_s == pytest.approx(max(0.0, everything[2 * len(found) + 1].needed_in_s - 0.1))
        on_disk.add((wish.cell, wish.layer))
        found.append(wish)
    assert [wish.cell for wish in found] == [wish.cell for wish in everything[1::2]]
    daemon.reader = Reader(lambda _index, _layer: True)
    assert daemon.next(1.2) is not None
    del daemon.prefetch.paths["a"]
    assert daemon.next(1.2) is None


def test_without_a_route_outages_are_prepared_for_after_the_first() -> None:
    """An outage begins with the loads that fail, not when they have failed; short ones do not count."""
    daemon = Daemon()
    daemon.client("a", route=False)
    before = daemon.prefetch.look_ahead
    assert before.straight_s == before.sides_s < TOLERANCE_S < before.route_s
    for begin_s, took_s, away_s, expected_s in (
        (10.0, 0.0, 8.5, 8.5),
        (104.0, 4.0, 5.0, 9.0),
        *((200.0 + 100.0 * n, 0.0, 0.5 * SLACK_S, 9.0) for n in range(5)),
        *((1000.0 + 100.0 * n, 0.0, SLACK_S + 0.1, None) for n in range(5)),
        (2000.0, 0.0, SLACK_S + 0.1, SLACK_S + 0.1),
    ):
        daemon.outage(took_s)
        daemon.next(begin_s)
        daemon.prefetch.health.ended(0.1, failed=False)
        daemon.next(begin_s + away_s)
        after = daemon.prefetch.look_ahead
        assert after.sides_s == pytest.approx(before.sides_s, abs=0.5)
        if expected_s is not None:
            assert after.straight_s == pytest.approx(after.sides_s + expected_s)


def test_slow_loads_are_wished_for_earlier() -> None:
    daemon = Daemon()
    quick = daemon.prefetch.look_ahead
    for _ in range(20):
        daemon.prefetch.health.ended(3.0, failed=False)
    slow = daemon.prefetch.look_ahead
    assert slow.route_s - quick.route_s == slow.sides_s - quick.sides_s > 3.0


def test_another_map_means_other_cells() -> None:
    daemon = Daemon()
    daemon.client("a")
    boxes = [town().box(wish.cell) for wish in daemon.wishes(1.0, 5)]
    daemon.catalogue = town(99, 2)
    daemon.loading.clear()
    assert [daemon.catalogue.box(wish.cell) for wish in daemon.wishes(1.1, 5)] == boxes
    daemon.catalogue = Catalogue.from_cells([])
    assert daemon.wishes(1.2) == []


class Work:
    """Counts the work of looking along paths, beside the code that limits it."""

    def __init__(self, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done = 0
        count, query, is_absent = self, Catalogue.query, daemon.is_absent

        class Counted(Catalogue):
            def query(self, *arguments, **named):  # type: ignore[no-untyped-def]
                count.done += LOOK_WORK
                return query(self, *arguments, **named)

        def counted_touches(area, boxes):  # type: ignore[no-untyped-def]
            count.done += len(boxes)
            return touches(area, boxes)

        def counted_is_absent(index: int, layer: str) -> bool:
            count.done += CELL_WORK
            return is_absent(index, layer)

        monkeypatch.setattr(look_ahead, "touches", counted_touches)
        daemon.prefetch = Prefetch(counted_is_absent, TOLERANCE_S)
        boxes = [town().box(index) for index in range(len(town()))]
        daemon.catalogue = Counted.from_cells(
            (f"/{number:05}", box, SourceStamp(1, 1, 1)) for number, box in enumerate(boxes)
        )


def test_one_call_looks_at_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever there is to look at, one call does a bounded part of it, and says that there is more."""
    daemon = Daemon()
    work, calls = Work(daemon, monkeypatch), 0
    for number in range(40):
        daemon.client(str(number), y=5.0 * number - 100.0)
    daemon.present = {(index, "points") for index in range(len(daemon.catalogue))}
    while not calls or daemon.next_s(1.0) == 1.0:
        before = work.done
        assert daemon.prefetch.next(daemon.catalogue, 1.0, daemon.reader) is None
        assert work.done - before <= 2 * WORK_PER_CALL + LOOK_WORK
        calls += 1
    assert calls >= 0.5 * work.done / WORK_PER_CALL


@pytest.mark.parametrize("clients", [1, 8, pytest.param(128, marks=pytest.mark.slow)])
def test_looking_takes_a_twentieth_of_a_core_at_most(clients: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit of work takes 20 ns.  With many clients all paths are looked along less often, and farther."""
    daemon = Daemon()
    work = Work(daemon, monkeypatch)
    motions = [daemon.client(str(number), y=number % 40 * 10.0 - 200.0) for number in range(clients)]
    daemon.present = {(index, "points") for index in range(len(daemon.catalogue))}
    alone, passes = daemon.prefetch.look_ahead, list[tuple[float, int]]()
    for half in range(2, 30):
        now_s = 0.5 * half
        for number, motion in enumerate(motions):
            y = number % 40 * 10.0 - 200.0
            move(motion, 10.0 * (now_s - 1.0), y, now_s, ((-20.0, y), (1300.0, y)))
        before = work.done
        assert daemon.next(now_s) is None
        if work.done > before:
            passes.append((now_s, work.done - before))
    for (begin_s, done), (end_s, _) in pairwise(passes):
        assert done * WORK_S <= end_s - begin_s
    ahead = daemon.prefetch.look_ahead
    assert ahead.route_s - alone.route_s == pytest.approx(ahead.sides_s - alone.sides_s)
    assert (ahead.route_s > alone.route_s) is (passes[-1][1] * WORK_S > PASS_S)
    assert (len(passes) > 10) is (clients <= 8)


def test_one_call_passes_over_few() -> None:
    """However much of the list has been loaded since it was made."""
    daemon = Daemon(outage_tolerance_s=60.0)
    daemon.client("a")
    assert daemon.next(1.0) is not None
    asked = 0

    def lacks(_index: int, _layer: str) -> bool:
        nonlocal asked
        asked += 1
        return False

    reader, calls = Reader(lacks), 0
    while not calls or daemon.prefetch.next_s(1.0, reader) == 1.0:
        asked, calls = 0, calls + 1
        assert daemon.prefetch.next(daemon.catalogue, 1.0, reader) is None
        assert asked <= READ_PER_CALL
    assert calls > 3


def test_of_very_many_cells_those_needed_first_are_listed_and_the_others_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(look_ahead, "MAX_LISTED", 20)
    daemon, all_at_once = Daemon(), Daemon()
    daemon.client("a")
    found = daemon.wishes(1.0)
    assert len(found) == 20
    assert daemon.next_s(1.0) == 1.0 + PASS_S
    for number in range(1, 20):
        found += daemon.wishes(1.0 + number * PASS_S)
    monkeypatch.undo()
    all_at_once.client("a")
    assert [wish.cell for wish in found] == [wish.cell for wish in all_at_once.wishes(1.0)]


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
        loading = sorted(daemon.loading)
        if what == "wish":
            daemon.wishes(now_s, number)  # which checks it
        elif what in ("done", "fail") and loading:
            key = loading[number % len(loading)]
            daemon.loading.discard(key)
            (daemon.present if what == "done" else daemon.failed).add(key)
            if daemon.prefetch.health.ended(later_s, failed=what == "fail"):
                daemon.failed.clear()
        elif what == "forget":
            daemon.failed.clear()
        elif what == "evict":
            daemon.present = set(sorted(daemon.present)[number:])
        elif what == "map":
            daemon.catalogue = town(80 - number, number)
            daemon.present, daemon.loading, daemon.failed = set(), set(), set()
        else:
            motion = motions[number % 2]
            x, y = {"move": (motion.x + 10 * later_s, motion.y), "jump": (400.0 - motion.x, motion.y)}.get(
                what, (motion.x, motion.y + 10 * later_s)
            )
            move(motion, x, y, now_s, ROUTE if number % 2 == 0 else ())
            daemon.prefetch.follow("ab"[number % 2], motion, Circle(x, y, RADIUS_M), ("points",))
    wish = daemon.next(now_s + PASS_S)
    assert wish is None or 0.0 <= wish.needed_in_s < math.inf
