# SPDX-License-Identifier: Apache-2.0
"""Windows that skip requests which would bring nothing are like windows that never do."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

import shmmap
from shmmap.client.connection import Connection
from shmmap.client.window import change_counter, nothing_new
from shmmap.client.window.blocking import BlockingFollower
from shmmap.client.window.map_window import MapWindow
from shmmap.protocol.messages import Differential, Metadata
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap

Factory = Callable[..., DaemonProcess]
LONG_S = 60.0
OFTEN_S = 1e-9  # asks at each call, where nothing else keeps it from that


@pytest.fixture(autouse=True)
def no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pose is not told for the sake of time: how long a test takes is left out of it."""
    monkeypatch.setattr(nothing_new, "TELL_S", 1e9)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[type]:
    """Kinds of the requests that this process sent."""
    kinds: list[type] = []
    ask = Connection.ask

    def ask_and_tell(connection: Connection, message: Any, kind: Any, **options: Any) -> Any:
        kinds.append(type(message))
        return ask(connection, message, kind, **options)

    monkeypatch.setattr(Connection, "ask", ask_and_tell)
    return kinds


def window_of(one: DaemonProcess, radius: float, *, skips: bool = True, **options: Any) -> MapWindow:
    window = MapWindow(
        one.endpoint, radius, background=False, update_distance=0, refresh_interval=OFTEN_S, **options
    )
    if not skips:
        assert isinstance(window._follower, BlockingFollower)
        window._follower._refresher._nothing_new.certain = lambda *_: False  # type: ignore[method-assign]
    return window


def shown(window: MapWindow) -> tuple[object, ...]:
    failed = window._follower.state.failed
    return (
        window.versions(),
        window.complete,
        window.map_version,
        sorted((f.cell_id, f.layer) for f in failed),
    )


def change_something(chance: random.Random, made: DividedMap, admin: shmmap.Client, seed: int) -> None:
    """Cells change, go, come back, are damaged, and leave memory; the daemon is told where it has to be."""
    name = chance.choice(sorted(made.corners))
    what = chance.choice(["change", "change", "remove", "add", "damage", "unnoticed", "evict", "load"])
    if what == "change":
        made.change(name, seed)
    elif what == "remove":
        made.remove_cell(name)
        made.write_metadata()
    elif what == "add":
        corner = chance.randrange(-3, 3) * 20, chance.randrange(-3, 3) * 20
        name = f"{corner[0]}_{corner[1]}.pcd"
        made.corners[name] = corner
        made.change(name, seed)
        made.write_metadata()
    elif what == "damage":
        interim = made.root / "damaged"
        interim.write_bytes(b"no cloud at all\n")
        interim.rename(made.pcd_dir / name)
    elif what == "unnoticed":
        made.change(name, seed)
        admin.evict(made.id(name))
        admin.selected(made.id(name), wait=LONG_S)  # its loader finds the new file
        return
    elif what == "evict":
        admin.evict()
        return
    else:
        x, y = chance.uniform(-60, 60), chance.uniform(-60, 60)
        admin.around(x, y, 10, layers="voxel(leaf=2.0)", wait=LONG_S)
        return
    admin.reload()


@pytest.mark.parametrize(("shape", "z"), [("circle", None), ("square", None), ("circle", (0.0, 3.0))])
def test_whatever_happens_it_shows_what_one_that_always_asks_shows(
    daemon: Factory, divided_map: DividedMap, asked: list[type], shape: str, z: tuple[float, float] | None
) -> None:
    """Random steps of both, and between them random changes of the map; compared after every step."""
    one = daemon(divided_map.root)
    chance = random.Random(12)
    skipped = 0
    with (
        shmmap.connect(one.endpoint, timeout=LONG_S) as admin,
        window_of(one, 30, shape=shape, z=z) as skips,
        window_of(one, 30, skips=False, shape=shape, z=z) as always,
    ):
        x = y = 0.0
        for number in range(400):
            kind = chance.random()
            if kind < 0.6:
                x, y = x + chance.uniform(-1, 1), y + chance.uniform(-1, 1)
            elif kind < 0.65:
                x, y = chance.uniform(-70, 70), chance.uniform(-70, 70)
            elif kind < 0.7:
                x, y = round(x / 10) * 10.0, round(y / 10) * 10.0  # on borders
            elif kind < 0.8:
                change_something(chance, divided_map, admin, number)
            for window in (always, skips):
                asked.clear()
                window.move_to(x, y, wait=LONG_S)
            skipped += not asked
            rounds = 50  # what has failed is tried again, between one's question and the other's perhaps
            while shown(skips) != shown(always) and not always.complete and (rounds := rounds - 1):
                for window in (always, skips):
                    window.move_to(x, y, wait=LONG_S)
            assert shown(skips) == shown(always), number
    assert skipped > 60, "else nothing was tried"


def test_standing_still_asks_nothing_and_a_reload_is_seen_at_once(
    daemon: Factory, divided_map: DividedMap, asked: list[type]
) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as admin, window_of(one, 30) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        for _ in range(10):
            assert window.move_to(0, 0).complete
        assert asked == []
        divided_map.change("0_0.pcd", 5)
        told = admin.reload()
        update = window.move_to(0, 0, wait=LONG_S)
        assert [cell.name for cell in update.changed] == ["0_0.pcd"]
        assert window.map_version == told.map_version


def test_small_steps_ask_where_the_cells_are_and_then_only_at_their_borders(
    daemon: Factory, divided_map: DividedMap, asked: list[type]
) -> None:
    one = daemon(divided_map.root)
    with window_of(one, 30) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        for step in range(1, 41):
            window.move_to(step * 0.1, 0)
            assert [c.name for c in window.cells] == divided_map.in_circle(step * 0.1, 0, 30)
        assert asked.count(Metadata) == 1
        assert asked.count(Differential) <= 1


@pytest.mark.parametrize("limit", ["TELL_S", "TELL_M"])
def test_the_pose_is_told_all_the_same(
    daemon: Factory, divided_map: DividedMap, asked: list[type], monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    one = daemon(divided_map.root)
    with window_of(one, 500) as window:
        window.move_to(0, 0, wait=LONG_S)
        window.move_to(0.5, 0)
        asked.clear()
        window.move_to(1, 0)
        assert asked == []
        monkeypatch.setattr(nothing_new, limit, 0.0)
        window.move_to(1.5, 0)
        assert asked == [Differential]


def test_after_a_restart_it_asks(daemon: Factory, divided_map: DividedMap, asked: list[type]) -> None:
    """The segment of the daemon that died says for ever that nothing is new."""
    one = daemon(divided_map.root)
    with window_of(one, 30, timeout=LONG_S) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        window.move_to(0, 0)
        assert asked == []
        one.kill()
        divided_map.change("0_0.pcd", 5)
        one.start()
        update = window.move_to(0, 0, wait=LONG_S)
        assert [cell.name for cell in update.changed] == ["0_0.pcd"]
        window.move_to(0, 0)
        asked.clear()
        window.move_to(0, 0)
        assert asked == [], "the new one's segment is read"


def test_without_the_counter_it_asks(
    daemon: Factory, divided_map: DividedMap, asked: list[type], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: str) -> NoReturn:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(change_counter, "ChangeCounter", refuse)
    one = daemon(divided_map.root)
    with window_of(one, 30) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        window.move_to(0, 0)
        assert asked == [Differential]
