# SPDX-License-Identifier: Apache-2.0
"""What windows are told of the way ahead reaches the daemon: nothing of it is dropped or kept back."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.client.route import MOST_PLACES, thinned
from shmmap.daemon.requests import dispatch, limits
from shmmap.protocol.messages import Intent
from tests.support.cpp_client import CppWindow
from tests.support.divided_map import DividedMap
from tests.unit.daemon.whole_daemon import WholeDaemon

MakeWindow = Callable[..., Any]
KINDS = ("background", "blocking", "c++")
NEVER = 1e9
PATIENCE_S = 60.0
STRAIGHT = ((0.0, 0.0), (30.0, 0.0))
LEFT = ((0.0, 0.0), (0.0, 30.0))


@pytest.fixture(params=KINDS)
def make(request: pytest.FixtureRequest) -> MakeWindow:
    """Return what makes a window that asks for nothing but what it has to."""
    if request.param == "c++":
        kind: MakeWindow = partial(CppWindow, request.getfixturevalue("cpp_program"))
    else:
        kind = partial(shmmap.MapWindow, background=request.param == "background")
    return partial(kind, radius=15.0, update_distance=NEVER, refresh_interval=NEVER)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[Intent]:
    """What clients have said to the daemon of where they are and go."""
    found: list[Intent] = []

    def hear(intent: Intent) -> None:
        found.append(intent)
        limits.check_intent(intent)

    monkeypatch.setattr(dispatch, "check_intent", hear)
    return found


@contextlib.contextmanager
def serving(whole: Callable[..., WholeDaemon], small_map: DividedMap) -> Iterator[WholeDaemon]:
    one = whole(small_map.root)
    with one.turning():
        yield one


def tell_until(told: list[Intent], tell: Callable[[], object], fits: Callable[[Intent], bool]) -> Intent:
    """Tell again and again until the daemon has heard something that fits."""
    end_s = time.monotonic() + PATIENCE_S
    while not any(map(fits, told)):
        tell()
        assert time.monotonic() < end_s, f"it has only heard {told}"
    return next(filter(fits, told))


def anything(_: Intent) -> bool:
    return True


def test_another_route_and_another_velocity_are_told(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, make: MakeWindow, told: list[Intent]
) -> None:
    """A window that nothing else makes ask, neither time nor the metres that it moved."""
    with serving(whole, small_map) as one, make(one.endpoint) as window:
        window.move_to(0, 0, vx=5.0, route=STRAIGHT, wait=PATIENCE_S)
        heard = tell_until(told, lambda: window.move_to(0, 0, vx=5.0, route=STRAIGHT), anything)
        assert (heard.vx, heard.route) == (5.0, STRAIGHT)
        heard = tell_until(told, lambda: window.move_to(0, 0, vx=5.0, route=LEFT), lambda i: i.route == LEFT)
        assert heard.vx == 5.0
        tell_until(told, lambda: window.move_to(0, 0, vx=9.0, route=LEFT), lambda i: i.vx == 9.0)
        tell_until(told, lambda: window.move_to(0, 6.0, vx=9.0, route=LEFT), lambda i: i.y == 6.0)
        tell_until(told, lambda: window.move_to(0, 6.0, vx=9.0), lambda i: i.y == 6.0 and not i.route)
        (session,) = [s for s in one.memory.sessions if s.intent is not None]
        tell_until(told, lambda: None, lambda _: session.motion.route is None)


def test_what_is_the_same_is_not_told_again(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, make: MakeWindow, told: list[Intent]
) -> None:
    with serving(whole, small_map) as one, make(one.endpoint) as window:
        window.move_to(0, 0, vx=5.0, route=STRAIGHT, wait=PATIENCE_S)
        before = len(told)
        for step in range(200):
            window.move_to(step * 0.02, 0, vx=5.0 + step * 0.004, route=STRAIGHT)
        assert told[before:] == []


def test_a_route_that_is_told_once_is_heard(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, told: list[Intent]
) -> None:
    """Nobody moves the window again: its thread tells when a second is over."""
    with (
        serving(whole, small_map) as one,
        shmmap.MapWindow(one.endpoint, 15.0, update_distance=NEVER, refresh_interval=NEVER) as window,
    ):
        window.move_to(0, 0, route=STRAIGHT, wait=PATIENCE_S)
        window.move_to(0, 0, route=LEFT)
        tell_until(told, lambda: time.sleep(0.01), lambda i: i.route == LEFT)


def test_long_routes_are_thinned(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, make: MakeWindow, told: list[Intent]
) -> None:
    """Many more places than the daemon takes; in C++ the same places are sent as in Python."""
    turns = np.linspace(0.0, 9.0, 6000)
    route = np.stack([20.0 * turns * np.cos(turns), 20.0 * turns * np.sin(turns)], axis=-1)
    with serving(whole, small_map) as one, make(one.endpoint) as window:
        window.move_to(0, 0, route=route.tolist(), wait=PATIENCE_S)
        heard = tell_until(told, lambda: window.move_to(0, 0, route=route.tolist()), anything)
        assert np.array(heard.route) == pytest.approx(thinned(route), abs=1e-9)
        assert len(heard.route) == MOST_PLACES
        still = [(7.0, 8.0)] * 5000
        heard = tell_until(told, lambda: window.move_to(0, 0, route=still), lambda i: len(i.route) == 1)
        assert heard.route == ((7.0, 8.0),)


def test_long_routes_beside_a_window(
    whole: Callable[..., WholeDaemon], small_map: DividedMap, told: list[Intent]
) -> None:
    """Each request of a client takes a route of any length."""
    intent = Intent(0.0, 0.0, route=tuple((float(x), 0.0) for x in range(5000)))
    area = shmmap.Circle(0.0, 0.0, 5.0)
    with serving(whole, small_map) as one, shmmap.connect(one.endpoint) as client:
        client.area(area, intent=intent)
        client.differential(area, [], intent=intent)
        client.selected(["0_0.pcd"], intent=intent)
    assert [len(each.route) for each in told] == [MOST_PLACES] * 3
    assert {each.route[-1] for each in told} == {(4999.0, 0.0)}
