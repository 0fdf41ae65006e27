# SPDX-License-Identifier: Apache-2.0
"""`MapWindow` against a real daemon: every step equals an independent set difference."""

from __future__ import annotations

import gc
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.client.connection_watch import running
from shmmap.client.window.follower import WindowFollower
from shmmap.client.window.retention import RetentionCandidate
from shmmap.errors import BadRequest, ConnectionLost, DaemonUnreachable, NoAnswer
from tests.support.cpp_client import CppWindow
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.divided_map import DividedMap, make_map, random_points

Factory = Callable[..., DaemonProcess]
MakeWindow = Callable[..., Any]
LONG_S = 60.0

KINDS = ("background", "blocking", pytest.param("c++", marks=pytest.mark.slow))
WITHOUT_A_THREAD = KINDS[1:]

ROUTE = [(-50 + 7.0 * i, 20 * np.sin(i / 3)) for i in range(15)]


@pytest.fixture
def make(kind: str, request: pytest.FixtureRequest) -> MakeWindow:
    """Return what makes a window of the kind that the test is about: `shmmap.MapWindow`, or that in C++."""
    if kind != "c++":
        return partial(shmmap.MapWindow, background=kind == "background")
    return partial(CppWindow, request.getfixturevalue("cpp_program"))


def by_name(cells: tuple[shmmap.Cell, ...]) -> dict[str, shmmap.Cell]:
    return {Path(cell.id).name: cell for cell in cells}


def assert_window(window: shmmap.MapWindow, made: DividedMap, x: float, y: float, radius: float) -> None:
    """The window holds exactly the cells of the circle, with the bits of the files."""
    cells = by_name(window.cells)
    assert sorted(cells) == made.in_circle(x, y, radius)
    for name, cell in cells.items():
        source = made.points(name)
        assert cell.xyz.tobytes() == np.stack([source["x"], source["y"], source["z"]], axis=1).tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_every_step_is_the_set_difference(
    standing: DaemonProcess, standing_map: DividedMap, kind: str, make: MakeWindow
) -> None:
    before: set[str] = set()
    with make(standing.endpoint, 35, update_distance=0) as window:
        for x, y in ROUTE:
            update = window.move_to(x, y, vx=7.0, wait=LONG_S)
            inside = set(standing_map.in_circle(x, y, 35))
            assert set(by_name(update.added)) == inside - before
            assert set(by_name(update.kept)) == inside & before
            assert {Path(cell_id).name for cell_id in update.removed} == before - inside
            assert (update.changed, update.pending, update.failed) == ((), (), ())
            assert window.complete
            assert_window(window, standing_map, x, y, 35)
            before = inside
        unmoved = window.move_to(*ROUTE[-1], wait=LONG_S)
        assert not unmoved.any
        assert set(by_name(unmoved.kept)) == before
        assert window.error is None
        assert window.stale_since is None


@pytest.mark.parametrize("kind", KINDS)
def test_more_cells_than_one_reply_has(daemon: Factory, tmp_path: Path, kind: str, make: MakeWindow) -> None:
    """Cold, warm, and after a step that most of the cells stay for."""
    made = make_map(tmp_path / "many", columns=17, rows=17, points=5)
    with make(daemon(made.root).endpoint, 150, layers=("points", "voxel(leaf=1.0)")) as window:
        for x in (-100.0, 0.0):
            window.move_to(x, 0.0, wait=LONG_S)
            inside = {
                (made.id(name), layer)
                for name in made.in_circle(x, 0.0, 150)
                for layer in ("points", "voxel(leaf=1.0)")
            }
            assert len(inside) > 128
            assert {(cell.id, cell.layer) for cell in window.cells} == inside
            assert window.complete
    with make(daemon(made.root).endpoint, 1000) as window:
        window.move_to(0.0, 0.0, wait=LONG_S)
        assert [cell.id for cell in window.cells] == sorted(map(made.id, made.corners))
        assert not window.move_to(200.0, 0.0, wait=LONG_S).any


@pytest.mark.parametrize("kind", KINDS)
def test_a_reload_mid_drive(daemon: Factory, divided_map: DividedMap, kind: str, make: MakeWindow) -> None:
    one = daemon(divided_map.root)
    rng = np.random.default_rng(3)
    with (
        shmmap.connect(one.endpoint) as admin,
        make(one.endpoint, 30, update_distance=0) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        old = by_name(window.cells)
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(rng, (0, 0), 99))
        divided_map.write_cell("20_0.pcd", (20, 0), random_points(rng, (20, 0), 1))
        divided_map.remove_cell("-20_-20.pcd")
        divided_map.write_metadata()
        admin.reload()
        update = window.move_to(0.5, 0, wait=LONG_S)
        assert set(by_name(update.changed)) == {"0_0.pcd", "20_0.pcd"}
        assert [Path(cell_id).name for cell_id in update.removed] == ["-20_-20.pcd"]
        assert update.added == ()
        assert_window(window, divided_map, 0.5, 0, 30)
        old["0_0.pcd"].verify()
        assert old["0_0.pcd"].points == 500


def test_a_window_that_stands_still_learns_of_a_reload(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with (
        shmmap.connect(one.endpoint) as admin,
        shmmap.MapWindow(one.endpoint, 30, refresh_interval=0.05) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(3), (0, 0), 99))
        reloaded = admin.reload()
        wait_for(window, lambda: window.map_version == reloaded.map_version and window.complete)
        assert by_name(window.cells)["0_0.pcd"].points == 99
        (changed,) = window.move_to(0, 0).changed
        assert changed.points == 99


def wait_for(window: shmmap.MapWindow, reached: Callable[[], bool]) -> None:
    """Wait until the window's thread has published a state that fits."""
    assert isinstance(window._follower, WindowFollower)
    assert window._follower.wait_for(lambda _: reached(), LONG_S)


@pytest.mark.parametrize("kind", WITHOUT_A_THREAD)
def test_small_moves_ask_nothing(daemon: Factory, divided_map: DividedMap, make: MakeWindow) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, name="admin") as admin:
        window = make(one.endpoint, 30, name="me", update_distance=20, refresh_interval=1e6)
        window.move_to(0, 0)

        def mine() -> Any:
            (found,) = (session for session in admin.stats().sessions if session.client == "me")
            return found

        asked = mine().requests
        for x in (3.0, 19.9, -19.9):
            assert not window.move_to(x, 0).any
        assert mine().requests == asked
        assert window.move_to(20.0, 0).any
        assert_window(window, divided_map, 20, 0, 30)
        window.close()
        waiting = Deadline()
        while waiting(len(admin.stats().sessions) > 1):
            pass


@pytest.mark.parametrize("kind", WITHOUT_A_THREAD)
def test_the_square_and_heights(standing: DaemonProcess, standing_map: DividedMap, make: MakeWindow) -> None:
    with shmmap.connect(standing.endpoint) as client:
        client.around(0, 0, 200)  # heights are known from the first load on
    with make(standing.endpoint, 25, shape="square") as window:
        window.move_to(1, 2)
        assert sorted(by_name(window.cells)) == standing_map.in_square(1, 2, 25)
    with make(standing.endpoint, 25, z=(50, 60)) as window:
        window.move_to(1, 2)
        assert window.cells == ()


@pytest.mark.parametrize("kind", WITHOUT_A_THREAD)
def test_points_around_and_retention(daemon: Factory, divided_map: DividedMap, make: MakeWindow) -> None:
    one = daemon(divided_map.root)
    keep = shmmap.Retention(distance=200.0)
    with shmmap.connect(one.endpoint) as admin:
        with make(one.endpoint, 25, update_distance=0, retention=keep) as window:
            window.move_to(-30, 0)
            first = window.cells
            assert len(window.points_around(-30, 0, 5)) == 2
            near = window.points_around(-30, 3, 17)
            points = [divided_map.points(name) for name in divided_map.in_circle(-30, 3, 17)]
            inside = [
                np.hypot(some["x"].astype(float) + 30, some["y"].astype(float) - 3) <= 17 for some in points
            ]
            assert near.count() == sum(int(some.sum()) for some in inside) > 0
            assert near.covered
            window.move_to(30, 0)
            assert_window(window, divided_map, 30, 0, 25)
            assert not len(window.points_around(-30, 0, 5)), "what is retained is not in the window"
            handed_out = admin.stats().counters["handles_sent"]
            window.move_to(-30, 0)
            assert admin.stats().counters["handles_sent"] == handed_out + len(first)
            assert all(a is b for a, b in zip(window.cells, first, strict=True)), "nothing was attached again"
        del first, near, window
        waiting = Deadline()
        while waiting(len(admin.stats().sessions) > 1):
            pass


# --- failing daemons ------------------------------------------------------------------------------


def test_a_background_window_survives_its_daemon(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = shmmap.connect(one.endpoint, timeout=0.3)
    with shmmap.MapWindow(client, 30, update_distance=0, refresh_interval=0.05) as window:
        window.move_to(0, 0, wait=LONG_S)
        one.kill()
        wait_for(window, lambda: window.error is not None)
        assert isinstance(window.error, DaemonUnreachable)
        assert window.stale_since is not None
        for x in range(5):
            update = window.move_to(x * 5.0, 0)
            assert not update.any
            assert len(window.points_around(0, 0, 10)) == 4
        assert not window.wait_until_current(0)
        one.start()
        assert window.wait_until_current(LONG_S)
        assert [window.error, window.stale_since] == [None, None]
        assert_window(window, divided_map, 20, 0, 30)
        inside, before = set(divided_map.in_circle(20, 0, 30)), set(divided_map.in_circle(0, 0, 30))
        update = window.move_to(20, 0)
        assert set(by_name(update.kept)) == inside & before
        assert set(by_name(update.added)) == inside - before
    client.close()


@pytest.mark.parametrize("kind", KINDS)
def test_a_jump_is_not_complete_before_it_is_answered(
    daemon: Factory, divided_map: DividedMap, kind: str, make: MakeWindow
) -> None:
    one = daemon(divided_map.root)
    with make(one.endpoint, 30, timeout=1.0) as window:
        assert [window.complete, window.covers(0, 0)] == [False, False]
        assert window.move_to(0, 0, wait=LONG_S).complete
        assert [window.complete, window.covers(0, 0)] == [True, True]
        assert window.covers(10, 0, 20)
        assert not window.covers(10, 0, 21)
        assert window.points_around(10, 0, 20).covered
        one.send(signal.SIGSTOP)  # a read now returns what was answered before
        if kind == "background":
            update = window.move_to(45, 0)
            assert not update.complete
            assert not update.any
        else:
            with pytest.raises(NoAnswer):
                # in C++ a call takes no longer than its wait, and silence is an error after `timeout`
                window.move_to(45, 0, wait=LONG_S if kind == "c++" else 0)
            assert isinstance(window.error, NoAnswer)
            assert window.stale_since is not None
        assert [window.complete] == [False]
        assert not window.wait_until_current(0)
        near = window.points_around(45, 0, 10)
        assert not near.covered
        assert window.points_around(10, 0, 20).covered, "what is behind is still there"
        one.send(signal.SIGCONT)
        assert window.move_to(45, 0, wait=LONG_S).complete
        assert window.complete
        assert window.points_around(45, 0, 10).covered
        assert [window.error, window.stale_since] == [None, None]


def test_a_vehicle_that_outruns_a_dead_daemon_gets_an_error(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with shmmap.MapWindow(one.endpoint, 40, update_distance=10) as window:
        window.move_to(0, 0, wait=LONG_S)
        one.kill()
        reloaded = [
            (window.move_to(x, 0).complete, window.covers(x, 0, 30)) for x in (5.0, 9.9, 10.0, 11.0, 60.0)
        ]
    assert reloaded == [(True, True), (True, True), (False, True), (False, False), (False, False)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_broken_cell_is_a_hole_where_it_lies(
    daemon: Factory, divided_map: DividedMap, make: MakeWindow
) -> None:
    """And nowhere else: the reply says where it lies."""
    broken = Path(divided_map.id("20_0.pcd"))
    broken.write_bytes(broken.read_bytes()[:-9])
    one = daemon(divided_map.root)
    with make(one.endpoint, 45, update_distance=0) as window:
        for x in (0.0, -1.0, -2.0):
            update = window.move_to(x, 0, wait=LONG_S)
            assert [Path(failure.cell_id).name for failure in update.failed] == ["20_0.pcd"]
            assert not update.complete
            assert window.points_around(-10, 0, 29).covered
            assert not window.points_around(-10, 0, 31).covered
            assert not window.covers(30, 10)


def test_a_daemon_that_ends_is_noticed_at_once(daemon: Factory, divided_map: DividedMap) -> None:
    """By an event: nothing is asked in this test, and no timer of window or client runs out."""
    one = daemon(divided_map.root)
    with (
        shmmap.connect(one.endpoint) as client,
        shmmap.MapWindow(client, 30, refresh_interval=1e6, timeout=3 * LONG_S) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        assert [client.disconnected_since] == [None]
        lost: SimpleQueue[None] = SimpleQueue()
        client.session.notify_when_lost(lost)
        one.kill()
        lost.get(timeout=LONG_S)
        assert type(window.error) is ConnectionLost
        assert [window.stale_since] == [client.disconnected_since] != [None]
        assert not window.wait_until_current(0)
        assert window.complete, "it still answers the pose"
        one.start()
        assert window.wait_until_current(LONG_S), "it asks again by itself"
        assert [window.error, window.stale_since, client.disconnected_since] == [None, None, None]


def test_a_window_s_timeout_is_its_own(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with (
        shmmap.connect(one.endpoint, timeout=3 * LONG_S) as client,
        shmmap.MapWindow(client, 30, update_distance=0, timeout=0.2) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        one.send(signal.SIGSTOP)
        window.move_to(1, 0)
        wait_for(window, lambda: window.error is not None)
        assert [type(window.error), client.disconnected_since] == [NoAnswer, None], "it hangs, but is there"
        one.send(signal.SIGCONT)
        assert window.wait_until_current(LONG_S)
    with pytest.raises(BadRequest, match="timeout must be a positive number"):
        shmmap.MapWindow(one.endpoint, timeout=0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_restart_with_a_changed_map(
    daemon: Factory, divided_map: DividedMap, kind: str, make: MakeWindow
) -> None:
    one = daemon(divided_map.root)
    with make(one.endpoint, 30, refresh_interval=0.05) as window:
        window.move_to(0, 0, wait=LONG_S)
        one.kill()
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(4), (0, 0), 50))
        divided_map.remove_cell("-20_0.pcd")
        divided_map.write_metadata()
        one.start()
        before = window.map_version
        if kind == "background":
            wait_for(window, lambda: window.map_version != before and window.complete)
        update = window.move_to(25, 0, wait=LONG_S)
        assert {"0_0.pcd"} == set(by_name(update.changed))
        assert "-20_0.pcd" in {Path(cell_id).name for cell_id in update.removed}
        assert_window(window, divided_map, 25, 0, 30)


@pytest.mark.parametrize("kind", WITHOUT_A_THREAD)
def test_a_blocking_window_raises_and_keeps_what_it_has(
    daemon: Factory, divided_map: DividedMap, kind: str, make: MakeWindow
) -> None:
    one = daemon(divided_map.root)
    with make(one.endpoint, 30, timeout=0.3) as window:
        window.move_to(0, 0, wait=LONG_S)
        held = window.cells
        one.send(signal.SIGSTOP)
        with pytest.raises(NoAnswer):
            window.move_to(50, 0, wait=LONG_S if kind == "c++" else 0)
        assert window.cells == held
        one.send(signal.SIGCONT)
        window.move_to(50, 0, wait=LONG_S)
        assert_window(window, divided_map, 50, 0, 30)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_reload_finishes_in_a_budget_of_the_window_and_one_cell(
    daemon: Factory, tmp_path: Path, kind: str, make: MakeWindow
) -> None:
    made = make_map(tmp_path / "map", columns=4, rows=4, points=20_000)
    everything = (0, 0, 100)
    roomy = daemon(made.root)
    with shmmap.connect(roomy.endpoint) as client:
        assert client.around(*everything, wait=LONG_S).complete
        largest = max(os.stat(f"{roomy.shm_dir}/{name}").st_blocks * 512 for name in roomy.segments())
        statistics = Path(roomy.shm_dir, f"shmmap.{roomy.instance}.statistics").stat().st_blocks * 512
        need = roomy.segment_bytes() + statistics
    roomy.stop()
    # the quota is about several clients: here one may fill all of it
    tight = daemon(made.root, "--budget", str(need + largest + 65_536), "--session-quota", "1.0")
    with (
        shmmap.connect(tight.endpoint) as admin,
        make(
            tight.endpoint,
            100,
            update_distance=0,
            refresh_interval=0.05,
            retention=shmmap.Retention(1e6),
        ) as window,
    ):
        window.move_to(0, 0, wait=LONG_S)
        assert_window(window, made, *everything)
        rng = np.random.default_rng(8)
        for name, corner in list(made.corners.items()):
            made.write_cell(name, corner, random_points(rng, corner, 20_000))
        reloaded = admin.reload()
        if kind == "background":
            wait_for(window, lambda: window.map_version == reloaded.map_version and window.complete)
        for turn in range(100):
            window.move_to(1e-3 * turn, 0, wait=LONG_S)
            if window.complete and window.map_version == reloaded.map_version:
                break
        assert_window(window, made, *everything)


# --- threads and system calls -----------------------------------------------------------------------


def test_an_unclosed_window_ends_with_the_program(standing: DaemonProcess, standing_map: DividedMap) -> None:
    before = len(running)
    window = shmmap.MapWindow(standing.endpoint, 30)
    window.move_to(0, 0, wait=LONG_S)
    view = window.cells[0].xyz
    assert len(running) == before + 2, "the window's, and its connection's"
    del window
    assert len(running) == before
    assert np.isfinite(view).all()
    program = f"""
import shmmap
window = shmmap.MapWindow({standing.endpoint!r}, 30)
print(len(window.move_to(0, 0, wait={LONG_S}).added))
cells = window.cells
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) == len(standing_map.in_circle(0, 0, 30))


def test_a_window_collected_in_its_own_thread(standing: DaemonProcess) -> None:
    """Garbage is collected in whatever thread: the window's own one ends all the same, and keeps nothing."""
    dropped, collected = threading.Event(), threading.Event()

    class Collects:
        """A policy that is asked in the window's thread."""

        def keep(self, departed: Sequence[RetentionCandidate]) -> list[bool]:
            assert dropped.wait(LONG_S)
            gc.collect()
            collected.set()
            return [False] * len(departed)

    with shmmap.connect(standing.endpoint) as client:
        window = shmmap.MapWindow(client, 30, retention=Collects())
        window.move_to(0, 0, wait=LONG_S)
        view = window.cells[0].xyz
        over = window._follower._over  # type: ignore[union-attr]
        gc.collect()
        gc.disable()
        try:
            window.move_to(60, 60)
            cycle = [window]
            cycle.append(cycle)  # type: ignore[arg-type]
            del window, cycle
            dropped.set()
            assert collected.wait(LONG_S)
        finally:
            gc.enable()
        over.get(timeout=LONG_S)
        cells, waits = client._session.attacher._cells, Deadline()
        while waits(sum(cell() is not None for cell in list(cells.values())) > 1):
            pass  # its thread leaves its last function
        client.release()
        assert np.isfinite(view).all()
        del view
        assert client.release() == 1, "what ends now is unmapped at once, and released"


def test_a_window_whose_thread_ended(standing: DaemonProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy of the user's that fails: the window says so, and what is dropped is unmapped."""
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)

    class Fails:
        def keep(self, departed: Sequence[RetentionCandidate]) -> list[bool]:
            raise ZeroDivisionError(len(departed))

    with shmmap.connect(standing.endpoint) as client:
        window = shmmap.MapWindow(client, 30, retention=Fails())
        window.move_to(0, 0, wait=LONG_S)
        assert isinstance(window._follower, WindowFollower)
        over = window._follower._over
        window.move_to(60, 60)
        over.get(timeout=LONG_S)
        assert "ZeroDivisionError" in str(window.error)
        cells = client.around(-50, -50, 5)
        client.release()
        del cells
        assert client.release() > 0
        window.close()


@pytest.mark.parametrize("background", [True, False])
def test_poses_as_planners_have_them(standing: DaemonProcess, background: bool) -> None:
    """A route may be an array; what makes no sense is refused in the caller's thread."""
    with shmmap.MapWindow(standing.endpoint, 30, update_distance=0, background=background) as window:
        route = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
        assert window.move_to(0, 0, vx=np.float32(1.0), route=route, wait=LONG_S).complete
        for odd in (
            {"vx": np.nan}, {"heading": np.inf}, {"route": [(1.0, np.nan)]}, {"route": [(1.0,)]},
            {"route": np.zeros((2, 3))}, {"route": ["ab"]}, {"route": [3.0]}, {"vy": None}, {"heading": "N"},
            {"wait": np.nan}, {"wait": -1.0},
        ):  # fmt: skip
            with pytest.raises(BadRequest):
                window.move_to(50, 50, **odd)
        assert window.move_to(1, 0, route=route, wait=np.inf).complete
        assert window.wait_until_current(np.inf)
        assert window.error is None


def test_a_closed_window(standing: DaemonProcess) -> None:
    with shmmap.connect(standing.endpoint) as client:
        window = shmmap.MapWindow(client, 30)
        window.move_to(0, 0, wait=LONG_S)
        cell = window.cells[0]
        window.close()
        window.close()
        assert window.cells == ()
        with pytest.raises(BadRequest, match="closed"):
            window.move_to(0, 0)
        cell.verify()
        assert client.around(0, 0, 30).complete, "the client is the caller's"


def test_impossible_parameters_are_refused(standing: DaemonProcess) -> None:
    before = threading.active_count()
    impossible: list[dict[str, Any]] = [
        {"radius": -1.0},
        {"shape": "hexagon"},
        {"update_distance": -1.0},
        {"refresh_interval": 0.0},
        {"timeout": 0.0},
        {"z": (2.0, 1.0)},
    ]
    for options in impossible:
        with pytest.raises(BadRequest):
            shmmap.MapWindow(standing.endpoint, **options)
    assert threading.active_count() == before


SWAP = """
import os, sys, threading
import shmmap
endpoint, length = sys.argv[1], float(sys.argv[2])
sys.setswitchinterval(1e-5)  # this loop never rests: the window's thread would wait 5 ms after every call
window = shmmap.MapWindow(endpoint, 180, update_distance=0, refresh_interval=1e6)
def drive(rounds):
    most = 0
    for number in range(rounds):
        x = length if number % 2 else -length
        window.move_to(x, 0.0)
        while True:
            update = window.move_to(x, 0.0)
            around = window.points_around(x, 0.0, 50.0)
            sum(len(view) for view in around)
            if update.added:
                most = max(most, len(update.added))
                break
    return most
drive(6)
print(threading.get_native_id(), flush=True)
os.write(2, b"BEGIN\\n")
most = drive(4)
os.write(2, b"END\\n")
print(most, flush=True)
os._exit(0)
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_a_swap_makes_no_system_call_that_maps_on_the_control_thread(daemon: Factory, tmp_path: Path) -> None:
    made = make_map(tmp_path / "map", columns=50, rows=16, points=20)
    one = daemon(made.root)
    with shmmap.connect(one.endpoint) as client:
        waiting = Deadline()
        while waiting(not client.area(shmmap.Box(-500, -160, 500, 160), wait=LONG_S).complete):
            pass
    calls = tmp_path / "calls.txt"
    done = subprocess.run(
        [
            "strace", "-f", "--seccomp-bpf", "-o", str(calls), "-e",
            "trace=open,openat,mmap,munmap,mremap,close,write",
            sys.executable, "-c", SWAP, one.endpoint, "250",
        ],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    control, swapped = (int(word) for word in done.stdout.split())
    assert swapped >= 256
    lines = calls.read_text().splitlines()
    (begin,) = [i for i, line in enumerate(lines) if '"BEGIN' in line]
    (end,) = [i for i, line in enumerate(lines) if '"END' in line]
    between = lines[begin:end]
    elsewhere = [line for line in between if not line.startswith(f"{control} ")]
    assert sum("munmap(" in line for line in elsewhere) >= 256, "the window's thread does it"
    here = [line for line in between if line.startswith(f"{control} ")]
    watched = [line for line in here if re.search(r" (open|openat|mmap|munmap|mremap|close)\(", line)]
    assert [line for line in watched if not _is_the_allocator_s(line, lines)] == []


def _is_the_allocator_s(call: str, lines: list[str]) -> bool:
    """Whether a call maps or unmaps memory without a file, as Python's and C's allocators do now and then."""
    if "MAP_ANONYMOUS" in call:
        return True
    unmapped = re.search(r" munmap\((0x[0-9a-f]+), ", call)
    if unmapped is None:
        return False
    at = int(unmapped[1], 16)
    found = re.findall(r" mmap\(\S+, (\d+), .*MAP_ANONYMOUS.* = (0x[0-9a-f]+)", "\n".join(lines))
    return any(int(start, 16) <= at < int(start, 16) + int(size) for size, start in found)
