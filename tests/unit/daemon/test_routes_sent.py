# SPDX-License-Identifier: Apache-2.0
"""Pose, velocity and route of a vehicle reach the daemon with each request of its window, and by no other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.client.arguments import MAX_ROUTE_PLACES, thinned
from shmmap.daemon.requests import dispatch, limits
from shmmap.protocol.messages import Intent
from tests.support.cpp_client import CppWindow
from tests.support.divided_map import DividedMap
from tests.unit.daemon.whole_daemon import WholeDaemon

MakeWindow = Callable[..., Any]
KINDS = ("background", "blocking", pytest.param("c++", marks=pytest.mark.slow))
NEVER = 1e9
SOON_S = 0.02
TIMEOUT_S = 60.0
STRAIGHT = ((0.0, 0.0), (30.0, 0.0))
LEFT = ((0.0, 0.0), (0.0, 30.0))


@pytest.fixture(params=KINDS)
def make(request: pytest.FixtureRequest) -> MakeWindow:
    """Return what makes a window that asks when `SOON_S` have passed, however far it has moved."""
    if request.param == "c++":
        kind: MakeWindow = partial(CppWindow, request.getfixturevalue("cpp_program"))
    else:
        kind = partial(shmmap.MapWindow, background=request.param == "background")
    return partial(kind, radius=15.0, update_distance=NEVER, refresh_interval=SOON_S)


@pytest.fixture
def received(monkeypatch: pytest.MonkeyPatch) -> list[Intent]:
    """Intents that have come to the daemon."""
    found: list[Intent] = []

    def check_and_note(intent: Intent) -> None:
        found.append(intent)
        limits.check_intent(intent)

    monkeypatch.setattr(dispatch, "check_intent", check_and_note)
    return found


@pytest.fixture
def one(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> Iterator[WholeDaemon]:
    served = whole(small_map.root)
    with served.turning():
        yield served


def move_until(received: list[Intent], move: Callable[[], object], fits: Callable[[Intent], bool]) -> Intent:
    """Keep moving until an intent that fits has come to the daemon."""
    end_s = time.monotonic() + TIMEOUT_S
    while not any(map(fits, received)):
        move()
        assert time.monotonic() < end_s, f"only these came: {received}"
    return next(filter(fits, received))


def anything(_: Intent) -> bool:
    return True


def test_another_route_and_another_velocity_come(
    make: MakeWindow, one: WholeDaemon, received: list[Intent]
) -> None:
    with make(one.endpoint) as window:
        window.move_to(0, 0, vx=5.0, route=STRAIGHT, wait=TIMEOUT_S)
        came = move_until(received, lambda: window.move_to(0, 0, vx=5.0, route=STRAIGHT), anything)
        assert (came.vx, came.route) == (5.0, STRAIGHT)
        came = move_until(
            received, lambda: window.move_to(0, 0, vx=5.0, route=LEFT), lambda i: i.route == LEFT
        )
        assert came.vx == 5.0
        move_until(received, lambda: window.move_to(0, 0, vx=9.0, route=LEFT), lambda i: i.vx == 9.0)
        move_until(received, lambda: window.move_to(0, 6.0, vx=9.0, route=LEFT), lambda i: i.y == 6.0)
        move_until(received, lambda: window.move_to(0, 6.0, vx=9.0), lambda i: i.y == 6.0 and not i.route)
        (session,) = [s for s in one.memory.sessions if s.intent is not None]
        move_until(received, lambda: None, lambda _: session.motion.route is None)


def test_nothing_is_asked_before_it_has_moved_or_time_has_passed(
    make: MakeWindow, one: WholeDaemon, received: list[Intent]
) -> None:
    with make(one.endpoint, refresh_interval=NEVER) as window:
        window.move_to(0, 0, vx=5.0, route=STRAIGHT, wait=TIMEOUT_S)
        before = len(received)
        for step in range(200):
            window.move_to(step * 0.02, 0, vx=5.0 + step, route=LEFT)
        assert received[before:] == []


def test_a_route_that_is_given_once_comes(one: WholeDaemon, received: list[Intent]) -> None:
    """The window is not moved again: its thread asks when its interval is over."""
    with shmmap.MapWindow(one.endpoint, 15.0, update_distance=NEVER, refresh_interval=SOON_S) as window:
        window.move_to(0, 0, route=STRAIGHT, wait=TIMEOUT_S)
        window.move_to(0, 0, route=LEFT)
        move_until(received, lambda: time.sleep(0.01), lambda i: i.route == LEFT)


def test_long_routes_are_thinned(make: MakeWindow, one: WholeDaemon, received: list[Intent]) -> None:
    """Many more places than the daemon takes; in C++ the same places are sent as in Python."""
    turns = np.linspace(0.0, 9.0, 6000)
    route = np.stack([20.0 * turns * np.cos(turns), 20.0 * turns * np.sin(turns)], axis=-1)
    with make(one.endpoint) as window:
        window.move_to(0, 0, route=route.tolist(), wait=TIMEOUT_S)
        came = move_until(received, lambda: window.move_to(0, 0, route=route.tolist()), anything)
        assert np.array(came.route) == pytest.approx(thinned(route), abs=1e-9)
        assert len(came.route) == MAX_ROUTE_PLACES
        still = [(7.0, 8.0)] * 5000
        came = move_until(received, lambda: window.move_to(0, 0, route=still), lambda i: len(i.route) == 1)
        assert came.route == ((7.0, 8.0),)


def test_long_routes_beside_a_window(one: WholeDaemon, received: list[Intent]) -> None:
    """Each request of a client takes a route of any length."""
    route = [(float(x), 0.0) for x in range(5000)]
    area = shmmap.Circle(0.0, 0.0, 5.0)
    with shmmap.connect(one.endpoint) as client:
        client.area(area, pose=(0.0, 0.0), route=route)
        client.differential(area, [], pose=(0.0, 0.0), route=route)
        client.selected(["0_0.pcd"], pose=(0.0, 0.0), route=route)
    assert [len(each.route) for each in received] == [MAX_ROUTE_PLACES] * 3
    assert {each.route[-1] for each in received} == {(4999.0, 0.0)}
