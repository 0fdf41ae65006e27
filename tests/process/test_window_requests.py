# SPDX-License-Identifier: Apache-2.0
"""What a window asks for, and when: it has moved, or its interval is over; and it never lists the map."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

import shmmap
from shmmap.client.connection import Connection
from shmmap.client.window.map_window import MapWindow
from shmmap.protocol.messages import Differential
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap

Factory = Callable[..., DaemonProcess]
LONG_S = 60.0
NEVER_S = 1e9
ALWAYS_S = 1e-9


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[type]:
    """Kinds of the requests that this process sent, hello left out."""
    kinds: list[type] = []
    ask = Connection.ask

    def ask_and_note(connection: Connection, message: Any, kind: Any, **options: Any) -> Any:
        kinds.append(type(message))
        return ask(connection, message, kind, **options)

    monkeypatch.setattr(Connection, "ask", ask_and_note)
    return kinds


def window_of(one: DaemonProcess, *, update_distance: float, refresh_interval: float) -> MapWindow:
    return MapWindow(
        one.endpoint, 30, background=False, update_distance=update_distance,
        refresh_interval=refresh_interval, timeout=LONG_S,
    )  # fmt: skip


def test_it_asks_when_it_has_moved_or_its_interval_is_over(served: DaemonProcess, asked: list[type]) -> None:
    with window_of(served, update_distance=2.0, refresh_interval=NEVER_S) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        for step in range(1, 10):
            window.move_to(step * 0.2, 0)
        assert asked == []
        window.move_to(2.0, 0)
        assert asked == [Differential]
    with window_of(served, update_distance=NEVER_S, refresh_interval=ALWAYS_S) as window:
        window.move_to(0, 0, wait=LONG_S)
        asked.clear()
        for _ in range(3):
            assert window.move_to(0, 0).complete
        assert asked == [Differential] * 3


def test_a_reload_is_seen_by_the_next_request(
    served: DaemonProcess, divided_map: DividedMap, asked: list[type]
) -> None:
    with (
        shmmap.connect(served.endpoint) as admin,
        window_of(served, update_distance=0, refresh_interval=ALWAYS_S) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        divided_map.change("0_0.pcd", 5)
        reloaded = admin.reload()
        asked.clear()
        update = window.move_to(0, 0, wait=LONG_S)
        assert [cell.name for cell in update.changed] == ["0_0.pcd"]
        assert window.map_version == reloaded.map_version
        assert set(asked) == {Differential}


@pytest.mark.parametrize("background", [True, False])
def test_it_knows_where_failed_cells_lie_without_asking_for_a_list(
    daemon: Factory, divided_map: DividedMap, asked: list[type], background: bool
) -> None:
    (divided_map.pcd_dir / "20_0.pcd").write_bytes(b"no cloud at all\n")
    one = daemon(divided_map.root)
    with MapWindow(one.endpoint, 38, background=background, timeout=LONG_S) as window:
        update = window.move_to(0, 0, wait=LONG_S)
        (failure,) = update.failed
        assert (failure.layer, failure.box) == ("points", (20.0, 0.0, 40.0, 20.0))
        assert not window.covers(15.0, 10.0, 5.0)
        assert not window.points_around(30.0, 10.0, 1.0).covered
        assert window.covers(-10.0, -10.0, 9.0)
        assert set(asked) == {Differential}


def test_nothing_says_where_an_unknown_cell_lies(served: DaemonProcess) -> None:
    with shmmap.connect(served.endpoint) as client:
        (failure,) = client.selected(["nowhere.pcd"], strict=None).failed
        assert failure.box is None
