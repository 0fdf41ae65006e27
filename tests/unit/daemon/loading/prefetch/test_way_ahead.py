# SPDX-License-Identifier: Apache-2.0
"""Which cells a client will ask for next."""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmmap.daemon.loading.look_ahead import BESIDE_M, MOST_CELLS, LookAhead, WayAhead
from shmmap.daemon.travel.motion import Motion
from shmmap.geometry import Area, AutowareSquare, Box, Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import Intent
from shmmap.segment.layout import SourceStamp

AHEAD = LookAhead(way_s=20.0, straight_s=8.0, sides_s=4.0)
STEP_M = 10.0
RADIUS_M = 50.0


@cache
def town(columns: int = 100, rows: int = 40) -> Catalogue:
    """Cells of 20 m: x from -200 m, y from -400 m."""
    return Catalogue.from_cells(
        (
            f"/m/{x:03}_{y:03}.pcd",
            (20.0 * x - 200, 20.0 * y - 400, 20.0 * x - 180, 20.0 * y - 380),
            SourceStamp(1, 1, 1),
        )
        for x in range(columns)
        for y in range(rows)
    )


def way_of(motion: Motion, area: Area | None = None) -> WayAhead:
    return WayAhead(motion, area or Circle(motion.x, motion.y, RADIUS_M), ("points",))


def looked(
    way: WayAhead, ahead: LookAhead = AHEAD, catalogue: Catalogue | None = None
) -> list[tuple[float, int]]:
    """Look along all of the way; what was found, with the time until it is needed."""
    way.begin(0.0)
    for _ in range(2000):
        if way.over:
            break
        way.look(catalogue or town(), ahead, STEP_M)
    assert way.over
    found = []
    while (first := way.first()) is not None:
        found.append(first)
        way.take()
    return found


def driving(vx: float, *route: tuple[float, float]) -> Motion:
    """A client at the origin that has driven so fast."""
    motion = Motion()
    motion.update(Intent(-vx, 0.0, route=route), 0.0)
    motion.update(Intent(0.0, 0.0, route=route), 1.0)
    return motion


def asked_along(path: list[tuple[float, float]], radius: float = RADIUS_M) -> set[int]:
    """All cells that a client asks for along a path, looking closely."""
    found: set[int] = set()
    for (x0, y0), (x1, y1) in pairwise(path):
        for share in np.linspace(0.0, 1.0, 400).tolist():
            at = Circle(x0 + share * (x1 - x0), y0 + share * (y1 - y0), radius)
            found.update(town().query(at)[0].tolist())
    return found


def test_along_a_route_all_that_will_be_asked_for_in_order_of_time() -> None:
    route = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (700.0, 100.0)]
    motion = driving(10.0, *route)
    found = looked(way_of(motion))
    times, cells = zip(*found, strict=True)
    assert list(times) == sorted(times)
    assert len(cells) < 1.1 * len(set(cells)), "few are left and come to again"
    here = set(town().query(Circle(0.0, 0.0, RADIUS_M))[0].tolist())
    asked = asked_along([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)]) - here  # 20 s of it
    assert asked <= set(cells)
    wide = asked_along([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)], RADIUS_M + BESIDE_M)
    assert set(cells) <= wide
    for needed_s, cell in {cell: (time, cell) for time, cell in reversed(found)}.values():
        # nobody asks for it sooner
        metres = np.linspace(0.0, max(0.0, 10.0 * needed_s - 0.1), 50)
        for x, y in motion.route.at(metres).tolist() if motion.route else []:
            assert cell not in town().query(Circle(x, y, RADIUS_M))[0]


def test_a_client_may_be_a_little_beside_its_route() -> None:
    route = [(0.0, 0.0), (150.0, 0.0), (150.0, 400.0)]
    found = {cell for _, cell in looked(way_of(driving(10.0, *route)))}
    here = set(town().query(Circle(0.0, 0.0, RADIUS_M))[0].tolist())
    beside = [(x + 0.7 * BESIDE_M, y - 0.7 * BESIDE_M) for x, y in [(0.0, 0.0), (150.0, 0.0), (150.0, 50.0)]]
    assert asked_along(beside) - here <= found


def test_without_a_route_straight_on_and_to_the_sides() -> None:
    found = looked(way_of(driving(10.0)))
    cells = {cell for _, cell in found}
    here = set(town().query(Circle(0.0, 0.0, RADIUS_M))[0].tolist())
    assert asked_along([(0.0, 0.0), (80.0, 0.0)]) - here <= cells
    # two gentle turns; the way to the sides is a second shorter
    for angle in (0.25, -0.25):
        x, y = 30.0 * math.cos(angle), 30.0 * math.sin(angle)
        assert asked_along([(0.0, 0.0), (x, y)]) - here <= cells
    middles = town().boxes[sorted(cells)].reshape(-1, 2, 2).mean(axis=1)
    assert middles[:, 0].max() < 80.0 + RADIUS_M + 20.0
    assert middles[:, 0].min() > -10.0, "not behind"


def test_who_has_long_come_straight_on_is_looked_for_farther_ahead() -> None:
    """After 500 m as far again as it came since, but no farther than along a way told; until it turns."""
    motion = Motion()
    told = []
    for second in range(0, 100, 5):
        motion.update(Intent(10.0 * second, 0.0), float(second))
        told.append(way_of(motion).looks_s(AHEAD))
    assert told[:13] == [AHEAD.straight_s] * 12 + [pytest.approx(10.0)]
    assert told[14:] == [AHEAD.way_s] * 6
    far_m = max(town().boxes[[cell for _, cell in looked(way_of(motion))]][:, 0]) - motion.x
    assert 200.0 <= far_m <= 200.0 + RADIUS_M
    motion.update(Intent(950.0, 50.0), 100.0)
    assert way_of(motion).looks_s(AHEAD) == AHEAD.straight_s


def test_beyond_a_routes_end_only_as_far_as_to_the_sides() -> None:
    motion = driving(10.0, (-10.0, 0.0), (20.0, 0.0))
    found = {cell for _, cell in looked(way_of(motion))}
    middles = town().boxes[sorted(found)].reshape(-1, 2, 2).mean(axis=1)
    assert 40.0 + RADIUS_M - 15.0 < middles[:, 0].max() < 40.0 + RADIUS_M + 20.0


def test_a_trajectory_told_again_each_second() -> None:
    """150 m ahead, from where the client is: whatever it asks for was found before."""
    motion, found = Motion(), set[int]()
    way = way_of(motion)
    for second in range(40):
        x = 12.0 * second
        motion.update(Intent(x, 0.2, route=tuple((x + 10.0 * n, 0.0) for n in range(16))), float(second))
        inside = set(town().query(Circle(x, 0.2, RADIUS_M))[0].tolist())
        if second > 2:
            assert inside <= found
        way.asks(Circle(x, 0.2, RADIUS_M), ("points",))
        found |= inside | {cell for _, cell in looked(way)}


@pytest.mark.parametrize("route", [(), ((0.0, 0.0), (500.0, 0.0))])
def test_who_stands_goes_nowhere(route: tuple[tuple[float, float], ...]) -> None:
    motion = Motion()
    for second in range(20):
        motion.update(Intent(0.0, 0.0, route=route), float(second))
    way = way_of(motion)
    assert not way.moves
    assert looked(way) == []


def test_a_red_light_on_a_route() -> None:
    """Who has driven of late and has a route goes on; without one, nobody knows where to."""
    for route, moves in ((((-50.0, 0.0), (500.0, 0.0)), True), ((), False)):
        motion = driving(10.0, *route)
        for second in range(2, 30):
            motion.update(Intent(0.0, 0.0, route=route), float(second))
        way = way_of(motion)
        assert way.moves is moves
        assert bool(looked(way)) is moves


def test_it_goes_on_from_where_the_client_has_come_to() -> None:
    """A client that moves while its way is looked over: nothing is found twice, nothing is left out."""
    motion = driving(10.0, (-10.0, 0.0), (800.0, 0.0))
    way = way_of(motion)
    way.begin(0.0)
    cells: list[int] = []
    for second in range(2, 22):
        way.look(town(), AHEAD, STEP_M)
        way.look(town(), AHEAD, STEP_M)
        motion.update(Intent(10.0 * (second - 1), 0.0, route=((-10.0, 0.0), (800.0, 0.0))), float(second))
        while (first := way.first()) is not None:
            cells.append(first[1])
            way.take()
    assert len(set(cells)) == len(cells)
    here = set(town().query(Circle(0.0, 0.0, RADIUS_M))[0].tolist())
    assert asked_along([(0.0, 0.0), (10.0 * 20 + 150.0, 0.0)]) - here <= set(cells)


def test_what_is_passed_meanwhile_is_needed_now() -> None:
    motion = driving(10.0, (-10.0, 0.0), (800.0, 0.0))
    way = way_of(motion)
    way.begin(0.0)
    for _ in range(4):
        way.look(town(), AHEAD, STEP_M)
    motion.update(Intent(60.0, 0.0, route=((-10.0, 0.0), (800.0, 0.0))), 7.0)
    first = way.first()
    assert first is not None
    assert first[0] == 0.0


def test_a_jump_begins_anew() -> None:
    motion = driving(10.0, (-10.0, 0.0), (800.0, 0.0))
    way = way_of(motion)
    way.begin(0.0)
    for _ in range(5):
        way.look(town(), AHEAD, STEP_M)
    for second in range(3):
        motion.update(Intent(1200.0 + 10.0 * second, 100.0), 10.0 + second)
    way.asks(Circle(1220.0, 100.0, RADIUS_M), ("points",))
    way.look(town(), AHEAD, STEP_M)
    found = []
    while (first := way.first()) is not None:
        found.append(first[1])
        way.take()
    assert found
    assert town().boxes[found][:, 0].min() > 1200.0


@pytest.mark.parametrize("area", [AutowareSquare(0.0, 0.0, 40.0), Box(-30.0, -40.0, 30.0, 40.0)])
def test_other_areas_than_circles(area: Area) -> None:
    found = {cell for _, cell in looked(way_of(driving(10.0), area))}
    here = set(town().query(area)[0].tolist())
    assert set(town().query(area.around(70.0, 0.0))[0].tolist()) - here <= found


def test_of_an_area_with_very_many_cells_nothing() -> None:
    huge = Catalogue.from_cells(
        (f"/{n:06}", (float(n % 200), float(n // 200), n % 200 + 1.0, n // 200 + 1.0), SourceStamp(1, 1, 1))
        for n in range(2 * MOST_CELLS)
    )
    way = way_of(driving(10.0), Circle(0.0, 0.0, 1000.0))
    assert looked(way, catalogue=huge) == []


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
    """Whatever a client says, the way has an end, and every cell is found once."""
    motion = Motion()
    motion.update(Intent(*pose, route=tuple(route)), 0.0)
    motion.update(Intent(*pose, route=tuple(route)), 1.0)
    found = looked(way_of(motion), LookAhead(look_s, look_s, look_s))
    assert all(0.0 <= needed_s < math.inf for needed_s, _ in found)
