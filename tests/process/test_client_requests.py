# SPDX-License-Identifier: Apache-2.0
"""The client library against a real daemon: every verb, its failures, restarts, threads and fork."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import zmq

import shmmap
import shmmap.aio
from shmmap.client import connection, map_listing
from shmmap.client.connection import _Exchange, program_name
from shmmap.errors import (
    BadRequest,
    LoadFailed,
    NoAnswer,
    NoSocket,
    SegmentError,
    SocketPermission,
    StaleSocket,
    UnknownCell,
)
from shmmap.protocol import messages
from shmmap.protocol.endpoint import SYSTEM_RUNTIME_DIR
from shmmap.segment.attach import attach
from tests.support.cpp_client import CppClient
from tests.support.daemon_process import DaemonProcess, Deadline, open_files
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.process_costs import descriptors
from tests.support.segment_reader import names

Factory = Callable[..., DaemonProcess]
Connect = Callable[..., Any]
LONG_S = 60.0
Late = Callable[[str, Callable[[], object], float], AbstractContextManager[Any]]

BOTH = pytest.mark.parametrize("language", ["python", pytest.param("c++", marks=pytest.mark.slow)])
"""For tests that the client in C++ has to pass, too."""


@pytest.fixture
def connect(language: str, request: pytest.FixtureRequest) -> Connect:
    """Return what makes a client in the language that the test is about."""
    if language == "python":
        return shmmap.connect
    return partial(CppClient, request.getfixturevalue("cpp_program"))


@pytest.fixture
def late(connect: Connect, language: str, monkeypatch: pytest.MonkeyPatch) -> Late:
    """Return what makes a client that attaches only after something was done, the first ``times`` times."""

    @contextmanager
    def make(endpoint: str, act: Callable[[], object], times: float) -> Iterator[Any]:
        if language == "c++":
            client = connect(endpoint, environment={"SHMMAP_TEST_STOP": "client.answer"})
            with client, client.program.acting_at_stops(act, times):
                yield client
            return
        left = iter(range(int(min(times, 1000))))

        def attach_late(*args: Any, **options: Any) -> Any:
            if next(left, None) is not None:
                act()
            return attach(*args, **options)

        monkeypatch.setattr("shmmap.client.attaching.attach", attach_late)
        with connect(endpoint) as client:
            yield client

    return make


def assert_bits(cell: Any, made: DividedMap) -> None:
    """The cell's columns are the file's, bit by bit, by an independent reader."""
    source = made.points(Path(cell.id).name)
    xyz = np.stack([source["x"], source["y"], source["z"]], axis=1)
    assert cell.xyz.tobytes() == xyz.tobytes()
    assert cell["intensity"].tobytes() == source["intensity"].tobytes()
    assert cell.box == made.box(Path(cell.id).name)
    assert cell.points == len(xyz)


def test_the_first_program(
    standing: DaemonProcess, standing_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHMMAP_ENDPOINT", standing.endpoint)
    cells = shmmap.connect().around(3.0, 4.0, radius=50)
    assert sum(len(cell.xyz) for cell in cells) == 500 * len(standing_map.in_circle(3.0, 4.0, 50))


@BOTH
def test_more_cells_than_one_reply_has(daemon: Factory, connect: Connect, tmp_path: Path) -> None:
    """A client goes on by itself, and what it returns is the whole, in order."""
    made = make_map(tmp_path / "many", columns=17, rows=17, points=5)
    every, layers = sorted(map(made.id, made.corners)), ("voxel(leaf=1.0)", "points")
    everywhere = shmmap.Box(-1e4, -1e4, 1e4, 1e4)
    with connect(daemon(made.root).endpoint) as client:
        cold = client.area(everywhere, wait=0.0)
        assert {cell.id for cell in cold.pending} | {cell.id for cell in cold.cells} == set(every)
        whole = client.area(everywhere, wait=300.0)
        assert [cell.id for cell in whole.cells] == every
        assert (whole.pending, whole.failed, whole.complete) == ((), (), True)
        two = client.area(everywhere, layers, wait=300.0)
        assert [(cell.id, cell.layer) for cell in two] == [
            (cell, layer) for cell in every for layer in layers
        ]
        held = whole.cells[::3]
        del cold, whole, two
        lacked = client.differential(everywhere, held, wait=300.0)
        assert [cell.id for cell in lacked] == [cell for at, cell in enumerate(every) if at % 3]
        assert lacked.removed == ()
        west = sum(x < 0 for x, _ in made.corners.values())
        part = client.differential(shmmap.Box(-1e4, -1e4, -1.0, 1e4), [*held, *lacked.cells], wait=300.0)
        assert (len(part.cells), len(part.removed)) == (0, len(every) - west)
        ids = [*every[::-1], *every[:50], "no such cell", "0_0.pcd"]
        some = client.selected(ids, layers, wait=300.0)
        assert [(cell.id, cell.layer) for cell in some] == [
            (made.id(Path(cell).name), layer) for cell in ids if cell != "no such cell" for layer in layers
        ]
        assert [error.code for error in some.failed] == ["unknown_cell"] * 2


def test_the_map_changes_between_two_replies(daemon: Factory, tmp_path: Path) -> None:
    """A cell that was pending is gone when it is asked for again, one behind is removed, one is new."""
    made = make_map(tmp_path / "many", columns=13, rows=13, points=5)
    every = sorted(made.corners)
    with shmmap.connect(daemon(made.root).endpoint) as client:
        session, before = client.session, client.map_version
        area = messages.BoxMessage(-1e4, -1e4, 1e4, 1e4)
        steps = session.cells(
            lambda n, start, left_s: messages.Area(n, area, ("points",), left_s, None, start), LONG_S
        )
        asked = next(steps)
        first = session.ask(asked.make, asked.kind)
        assert len(first.pending) == 128
        made.remove_cell(every[3])
        made.remove_cell(every[-2])
        made.write_cell("zz.pcd", (900, 900), random_points(np.random.default_rng(1), (900, 900), 9))
        made.write_metadata()
        after = client.reload().map_version
        asked = steps.send(first)

        def rest() -> Any:
            now = asked
            while True:
                try:
                    now = steps.send((yield now))
                except StopIteration as end:  # noqa: PERF203  the steps end with their answer
                    return end.value

        found = session.run(rest())
        assert names(found) == sorted(made.corners)
        assert (found.complete, found.map_version) == (True, before)
        assert before != after == client.differential(shmmap.Circle(0, 0, 1), ()).map_version


def test_everything_says_what_it_is(standing: DaemonProcess, standing_map: DividedMap) -> None:
    with shmmap.connect(standing.endpoint) as client:
        assert repr(client) == f"<Client of {standing.endpoint}, map {standing_map.root}>"
        listing = client.metadata()
        assert repr(listing) == f"<MapListing of {len(listing)} cells, 0 removed>"
        with shmmap.MapWindow(client, 5.0) as window:
            window.move_to(10.0, 10.0, wait=30.0)
            assert repr(window) == f"<MapWindow of radius 5 m, {len(window.cells)} cells of points>"
            around = window.points_around(10.0, 10.0, 1.5)
            assert repr(around) == f"<PointsAround (10, 10), 1.5 m: {len(around)} cells>"
            del around
        assert repr(window) == "<MapWindow closed, 0 cells of points>"
        with pytest.raises(TypeError, match="AutowareSquare"):
            client.area((1.0, 2.0, 3.0))  # type: ignore[arg-type]


def test_a_client_goes_by_its_script(daemon: Factory, divided_map: DividedMap, tmp_path: Path) -> None:
    one = daemon(divided_map.root)
    script = tmp_path / "localize.py"
    script.write_text(
        "import sys, shmmap\n"
        "for options in ({}, {'name': 'own'}):\n"
        "    with shmmap.connect(sys.argv[1], **options) as client:\n"
        "        print(*sorted(session.client for session in client.stats().sessions))\n"
        "with shmmap.MapWindow(sys.argv[1]) as window:\n"
        "    print(*sorted(session.client for session in window.client.stats().sessions))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script), one.endpoint], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["localize.py", "own", "localize.py"]


@BOTH
def test_areas(standing: DaemonProcess, standing_map: DividedMap, connect: Connect) -> None:
    with connect(standing.endpoint, name="areas") as client:
        circle = client.area(shmmap.Circle(5.0, -7.0, 33.0))
        assert circle.complete
        assert names(circle) == standing_map.in_circle(5.0, -7.0, 33.0)
        for cell in circle:
            assert_bits(cell, standing_map)
            cell.verify()
        square = client.area(shmmap.AutowareSquare(5.0, -7.0, 33.0))
        assert names(square) == standing_map.in_square(5.0, -7.0, 33.0)
        assert names(client.area(shmmap.Box(1.0, 1.0, 2.0, 2.0))) == ["0_0.pcd"]
        assert client.around(0, 0, 50, z=(100.0, 200.0)).cells == (), "no point is as high"
        assert circle.epoch == client.epoch
        assert circle.map_version == client.map_version


@BOTH
def test_cells_are_mapped_once(standing: DaemonProcess, connect: Connect) -> None:
    with connect(standing.endpoint) as client:
        first = client.around(0, 0, 30)
        again = client.around(0, 0, 30)
        assert first.cells == again.cells
        assert all(a is b for a, b in zip(first, again, strict=True))


@BOTH
def test_differential(standing: DaemonProcess, standing_map: DividedMap, connect: Connect) -> None:
    with connect(standing.endpoint) as client:
        held = {cell.id: cell for cell in client.around(-30, -30, 30)}
        for x in range(-30, 40, 7):
            before = set(held)
            inside = {standing_map.id(name) for name in standing_map.in_circle(x, x / 2, 30)}
            answer = client.differential(shmmap.Circle(x, x / 2, 30), held.values())
            assert {cell.id for cell in answer} == inside - before
            assert answer.removed == tuple(cell_id for cell_id in held if cell_id not in inside)
            for cell_id in answer.removed:
                del held[cell_id]
            held.update({cell.id: cell for cell in answer})
            assert set(held) == inside


@BOTH
def test_differential_with_ids_by_hand(
    standing: DaemonProcess, standing_map: DividedMap, connect: Connect
) -> None:
    area = shmmap.Circle(10, 10, 5)
    with connect(standing.endpoint) as client:
        (cell,) = client.area(area)
        gone = standing_map.id("-60_-60.pcd")
        answer = client.differential(area, ["nowhere", cell.id, gone])
        assert (answer.cells, answer.removed) == ((), ("nowhere", gone))
        assert client.differential(area, [(cell.id, cell.version)]).cells == ()
        assert names(client.differential(area, [(cell.id, cell.version + 1)])) == names([cell])
        assert client.differential(area, [cell], by_name=True).cells == ()


@BOTH
def test_selected_keeps_order_and_duplicates(
    standing: DaemonProcess, standing_map: DividedMap, connect: Connect
) -> None:
    with connect(standing.endpoint) as client:
        wanted = ["20_20.pcd", standing_map.id("0_0.pcd"), "none.pcd", "20_20.pcd", "-20_0.pcd"]
        answer = client.selected(wanted)
        assert names(answer) == ["20_20.pcd", "0_0.pcd", "20_20.pcd", "-20_0.pcd"]
        assert answer[0] is answer[2]
        (failure,) = answer.failed
        assert isinstance(failure, UnknownCell)
        assert failure.cell_id == "none.pcd"
        with pytest.raises(UnknownCell, match=r"none\.pcd"):
            answer.raise_for_failures()
        assert names(client.selected("0_0.pcd")) == ["0_0.pcd"], "one id needs no list"


@BOTH
def test_a_broken_cell_costs_only_itself(daemon: Factory, divided_map: DividedMap, connect: Connect) -> None:
    broken = divided_map.pcd_dir / "0_0.pcd"
    broken.write_bytes(broken.read_bytes()[:-100])
    with connect(daemon(divided_map.root).endpoint) as client:
        answer = client.around(0, 0, 30)
        assert set(names(answer)) == set(divided_map.in_circle(0, 0, 30)) - {"0_0.pcd"}
        (failure,) = answer.failed
        assert isinstance(failure, LoadFailed)
        assert (failure.cell_id, failure.layer) == (divided_map.id("0_0.pcd"), "points")
        assert not answer.complete


@BOTH
def test_without_waiting_the_rest_is_pending(
    daemon: Factory, divided_map: DividedMap, connect: Connect
) -> None:
    with connect(daemon(divided_map.root).endpoint) as client:
        answer = client.around(0, 0, 30, wait=None)
        assert set(names(answer)) | {Path(p.id).name for p in answer.pending} == set(
            divided_map.in_circle(0, 0, 30)
        )
        assert answer.pending
        assert client.around(0, 0, 30).complete


def test_metadata_and_what_changed_since(daemon: Factory, divided_map: DividedMap) -> None:
    with shmmap.connect(daemon(divided_map.root).endpoint) as client:
        listing = client.metadata()
        assert [cell.id for cell in listing] == sorted(divided_map.id(name) for name in divided_map.corners)
        assert listing[0].box == divided_map.box(Path(listing[0].id).name)
        assert listing[3:5] == list(listing)[3:5]
        assert listing[-1] == list(listing)[-1]
        assert listing.boxes.tolist() == [list(cell.box) for cell in listing]
        assert all(cell.z_bounds is None for cell in listing)
        assert [cell.source_bytes for cell in listing] == [Path(c.id).stat().st_size for c in listing]
        loaded = client.around(*divided_map.corners["0_0.pcd"], 1).cells
        bounds = {cell.id: cell.z_bounds for cell in client.metadata()}
        assert loaded
        for cell in loaded:
            assert bounds[cell.id] == (cell.xyz[:, 2].min(), cell.xyz[:, 2].max())
        del loaded, cell
        inside = client.metadata(shmmap.Circle(0, 0, 25))
        assert [Path(cell.id).name for cell in inside] == divided_map.in_circle(0, 0, 25)
        rng = np.random.default_rng(5)
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(rng, (0, 0), 77))
        divided_map.write_cell("80_80.pcd", (80, 80), random_points(rng, (80, 80), 5))
        divided_map.remove_cell("-60_-60.pcd")
        divided_map.write_metadata()
        reloaded = client.reload()
        assert (reloaded.changed, reloaded.added, reloaded.removed) == (1, 1, 1)
        since = client.metadata(since=listing.map_version)
        assert since.since_known
        assert [Path(cell.id).name for cell in since] == ["0_0.pcd", "80_80.pcd"]
        assert since.removed == (divided_map.id("-60_-60.pcd"),)
        assert since.map_version == reloaded.map_version != listing.map_version
        assert len(client.metadata(since=since.map_version)) == 0
        unknown = client.metadata(since=1)
        assert not unknown.since_known
        assert len(unknown) == len(divided_map.corners)


def test_no_more_pages_are_asked_for_than_are_needed(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_listing, "_PAGE_ROWS", 10)
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        everything = client.metadata()
        assert len(everything) == len(divided_map.corners) > 30
        before = client.stats().counters["requests"]
        some = client.metadata(most=15)
        assert some[:] == everything[:20]
        # each request is counted once it is answered, so the first look is among them
        assert client.stats().counters["requests"] - before == 3
        assert client.metadata(most=len(everything))[:] == everything[:]
        assert (
            client.metadata(shmmap.Circle(0, 0, 25), most=0)[:]
            == client.metadata(shmmap.Circle(0, 0, 25))[:10]
        )


@BOTH
def test_a_reload_brings_a_new_version_and_the_old_one_stays_readable(
    daemon: Factory, divided_map: DividedMap, connect: Connect
) -> None:
    one = daemon(divided_map.root)
    with connect(one.endpoint) as client, shmmap.connect(one.endpoint) as admin:
        held = client.around(0, 0, 30)
        old = next(cell for cell in held if cell.id.endswith("/0_0.pcd"))
        copy = old.xyz.copy()
        divided_map.write_cell("0_0.pcd", (0, 0), random_points(np.random.default_rng(9), (0, 0), 321))
        admin.reload()
        (new,) = answer = client.differential(shmmap.Circle(0, 0, 30), held)
        assert answer.removed == ()
        assert new.id == old.id
        assert new.version != old.version
        assert_bits(new, divided_map)
        np.testing.assert_array_equal(old.xyz, copy)
        old.verify()


def test_show_stats_and_evict(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, name="mine") as client:
        (cell,) = client.selected(["0_0.pcd"])
        shown = client.show("0_0.pcd")
        assert (shown.id, shown.version) == (cell.id, cell.version)
        assert [segment.segment for segment in shown.segments] == [cell.segment]
        assert shown.segments[0].holders[0].session == client.welcome.session
        with pytest.raises(UnknownCell):
            client.show("none.pcd")
        (session,) = client.stats().sessions
        assert (session.client, session.cells) == ("mine", 1)
        assert client.evict("0_0.pcd").pinned == 1
        assert_bits(cell, divided_map)
        del cell
        gc.collect()
        assert client.release() == 1
        assert client.stats().sessions[0].cells == 0


@BOTH
def test_a_handle_that_went_stale_is_asked_for_again(
    daemon: Factory, divided_map: DividedMap, late: Late
) -> None:
    """Evict everything just before the first attach, through another client of the same daemon."""
    one = daemon(divided_map.root)
    evicted: list[int] = []
    with (
        shmmap.connect(one.endpoint) as other,
        late(one.endpoint, lambda: evicted.append(other.evict().freed), 1) as client,
    ):
        answer = client.selected(["20_20.pcd", "0_0.pcd", "20_20.pcd"])
        assert evicted == [2]
        assert names(answer) == ["20_20.pcd", "0_0.pcd", "20_20.pcd"]
        assert answer.complete
        for cell in answer:
            assert_bits(cell, divided_map)


@BOTH
@pytest.mark.root
def test_a_name_that_another_file_took_meanwhile(
    daemon: Factory, divided_map: DividedMap, late: Late
) -> None:
    """In /dev/shm every account may make files: only what belongs to the daemon's user is its segment."""
    one = daemon(divided_map.root)
    taken: list[Path] = []

    def take(kind: str) -> None:
        place = Path(one.shm_dir, one.segments()[0])
        forged = place.read_bytes()
        other.evict()
        taken.append(place)
        if kind == "pipe":
            os.mkfifo(place)
        elif kind == "directory":
            place.mkdir()
        else:
            place.write_bytes(forged[:4096] + bytes(len(forged) - 4096))
        place.chmod(0o755)
        os.chown(place, 12345, 12345)

    with shmmap.connect(one.endpoint) as other:
        for count, kind in enumerate(("file", "pipe", "directory"), 1):
            other.selected(["0_0.pcd", "20_20.pcd"])
            with late(one.endpoint, partial(take, kind), 1) as client:
                answer = client.selected(["0_0.pcd", "20_20.pcd"])
                assert len(taken) == count
                assert answer.complete
                for cell in answer:
                    assert_bits(cell, divided_map)
                del answer, cell
            taken[-1].rmdir() if kind == "directory" else taken[-1].unlink()


@BOTH
def test_handles_that_stay_stale_end_as_pending(daemon: Factory, divided_map: DividedMap, late: Late) -> None:
    one = daemon(divided_map.root)
    with (
        shmmap.connect(one.endpoint) as other,
        late(one.endpoint, lambda: other.evict(), np.inf) as client,
    ):
        answer = client.selected(["0_0.pcd"])
        assert (answer.cells, answer.failed) == ((), ())
        assert answer.pending == (shmmap.PendingLayer(divided_map.id("0_0.pcd"), "points"),)


@BOTH
def test_segments_that_are_elsewhere_are_no_passing_problem(
    standing: DaemonProcess,
    connect: Connect,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in a container that has the socket, and not the directory of the segments."""
    monkeypatch.setenv("SHMMAP_SHM_DIR", str(tmp_path))
    with (
        connect(standing.endpoint) as client,
        pytest.raises(SegmentError, match=r"are not in .*SHMMAP_SHM_DIR"),
    ):
        client.around(0, 0, 5, wait=30.0)


@BOTH
def test_of_several_sockets_the_one_with_a_reason_is_named(
    daemon: Factory,
    divided_map: DividedMap,
    connect: Connect,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one = daemon(divided_map.root)
    for name in ("SHMMAP_ENDPOINT", "SHMMAP_RUNTIME_DIR", "SHMMAP_INSTANCE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("SHMMAP_INSTANCE", "unused")
    (tmp_path / "shmmap").mkdir()
    closed = os.path.isdir(SYSTEM_RUNTIME_DIR) and not os.access(SYSTEM_RUNTIME_DIR, os.X_OK)
    kind = SocketPermission if closed else NoSocket  # what root's daemon made there is closed to others
    with pytest.raises(kind, match=r"unused\.sock: (there is no socket|this user may not connect)"):
        connect("")
    one.kill()
    Path(one.endpoint).rename(tmp_path / "shmmap" / "unused.sock")
    with pytest.raises(StaleSocket, match=f"{tmp_path}.*is gone"):
        connect("")


@BOTH
def test_waits_that_make_no_sense(standing: DaemonProcess, connect: Connect) -> None:
    with connect(standing.endpoint) as client:
        for wait in (-1.0, -6.0, np.nan):
            with pytest.raises(BadRequest, match="wait"):
                client.around(0, 0, 5, wait=wait)
            assert client.around(0, 0, 5).complete


# --- the daemon's ends and beginnings -----------------------------------------------------------


def test_a_daemon_that_ends_between_its_answer_and_the_attaching(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It took its segments away: that is no reason to look for them in another directory."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, timeout=5.0) as client:  # in which the daemon has to have ended
        assert client.around(0, 0, 5).complete
        stops = iter([one.stop])
        monkeypatch.setattr("shmmap.client.session.step", lambda _: next(stops, lambda: 0)())
        with pytest.raises(NoAnswer):
            client.around(0, 0, 5, wait=None)


@BOTH
def test_views_and_client_survive_a_killed_and_restarted_daemon(
    daemon: Factory, divided_map: DividedMap, connect: Connect
) -> None:
    one = daemon(divided_map.root)
    with connect(one.endpoint) as client:
        held = client.around(0, 0, 30)
        epoch = client.epoch
        one.kill()
        for cell in held:
            assert_bits(cell, divided_map)
        one.start()
        answer = client.differential(shmmap.Circle(0, 0, 30), held, by_name=True)
        assert client.epoch != epoch
        assert answer.epoch == client.epoch
        assert (answer.cells, answer.removed) == ((), ())
        with shmmap.connect(one.endpoint) as admin:
            number = client.slot if isinstance(client, CppClient) else client.welcome.session
            assert number in {session.session for session in admin.stats().sessions}


def test_a_request_in_flight_at_a_killed_daemon_is_answered_by_the_next(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = daemon(divided_map.root)
    sent = threading.Event()
    send = connection._Exchange.send

    def send_and_record(exchange: connection._Exchange, data: bytes) -> bool:
        done = send(exchange, data)
        sent.set()
        return done

    with shmmap.connect(one.endpoint, timeout=60) as client, ThreadPoolExecutor(1) as pool:
        one.send(signal.SIGSTOP)
        monkeypatch.setattr(connection._Exchange, "send", send_and_record)
        answer = pool.submit(client.around, 0, 0, 30)
        assert sent.wait(60)
        one.kill()
        one.start()
        assert names(answer.result(60)) == divided_map.in_circle(0, 0, 30)


@BOTH
def test_a_stopped_daemon_is_no_answer_and_goes_on_later(
    daemon: Factory, divided_map: DividedMap, connect: Connect
) -> None:
    one = daemon(divided_map.root)
    with connect(one.endpoint, timeout=0.3) as client:
        before = client.around(0, 0, 30, wait=30)
        one.send(signal.SIGSTOP)
        with pytest.raises(NoAnswer, match=r"no answer within 0\.3 s"):
            client.around(0, 0, 30, wait=None)
        with pytest.raises(NoAnswer):
            connect(one.endpoint, connect_timeout=0.3)
        one.send(signal.SIGCONT)
        assert client.around(0, 0, 30, wait=30).cells == before.cells, (
            "late replies are not taken for this one"
        )


@BOTH
def test_what_a_killed_daemon_leaves_is_a_stale_socket(
    daemon: Factory, divided_map: DividedMap, connect: Connect
) -> None:
    one = daemon(divided_map.root)
    one.kill()
    with pytest.raises(StaleSocket):
        connect(one.endpoint)


def test_a_request_that_no_daemon_takes_is_refused_before_it_is_sent(standing: DaemonProcess) -> None:
    """It would end the connection; the error names the limit, and the client goes on."""
    with shmmap.connect(standing.endpoint) as client:
        session = client.welcome.session
        for ask, ids in (
            (client.selected, ["x" * (5 << 20)]),
            (client.evict, ["x" * (5 << 20)]),
            (client.evict, [f"{number:0100}.pcd" for number in range(45_000)]),
        ):
            with pytest.raises(BadRequest, match="bytes; 4,194,304 are the most") as refused:
                ask(ids)
            assert "some ids at a time" in refused.value.hint
        held = [(f"{number:0100}.pcd", 1) for number in range(45_000)]
        with pytest.raises(BadRequest, match="4,194,304"):
            client.differential(shmmap.Circle(0.0, 0.0, 5.0), held)
        assert len(client.selected(["0_0.pcd"])) == 1
        assert client.welcome.session == session, "the connection has not broken"


# --- the client's own life ----------------------------------------------------------------------


def test_views_outlive_the_client(standing: DaemonProcess, standing_map: DividedMap) -> None:
    client = shmmap.connect(standing.endpoint)
    (cell,) = client.selected(["0_0.pcd"])
    client.close()
    client.close()
    assert_bits(cell, standing_map)
    with pytest.raises(BadRequest, match="closed"):
        client.stats()


def test_closing_ends_the_session_unless_something_is_held(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as watcher:
        with shmmap.connect(one.endpoint, name="gone") as client:
            client.around(0, 0, 10)
        keeper = shmmap.connect(one.endpoint, name="keeper")
        kept = keeper.selected(["0_0.pcd"])
        keeper.close()
        assert {row.client for row in watcher.stats().sessions} == {program_name(), "keeper"}
        assert kept.complete


def test_a_client_that_left_without_a_goodbye(daemon: Factory, divided_map: DividedMap) -> None:
    """The daemon keeps no descriptor and no pose of it, and its name while the kernel says that it maps."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint, name="watcher") as watcher:
        watcher.around(0, 0, 10)  # the loaders run, and are watched
        before = descriptors(one.pid)
        kept = []
        for number in range(20):
            keeper = shmmap.connect(one.endpoint, name=f"keeper {number}")
            kept.append(keeper.around(0, 0, 10))
            keeper.close()
        waiting = Deadline()
        while waiting(descriptors(one.pid) > before):
            watcher.stats()
        rows = {row.client: row for row in watcher.stats().sessions}
        assert set(rows) == {"watcher", *(f"keeper {number}" for number in range(20))}
        assert all(rows[name].mapped_bytes and rows[name].pose is None for name in rows if name != "watcher")
        kept.clear()
        while waiting(len(watcher.stats().sessions) > 1):
            pass


def test_an_unclosed_client_leaves_no_descriptor(standing: DaemonProcess) -> None:
    before = set(open_files())
    for _ in range(3):
        cells = shmmap.connect(standing.endpoint).around(0, 0, 10)
        assert cells.complete
    del cells
    assert set(open_files()) == before


def test_one_client_in_many_threads(standing: DaemonProcess, standing_map: DividedMap) -> None:
    with shmmap.connect(standing.endpoint, timeout=30) as client:
        start = threading.Barrier(6)

        def ask(number: int) -> bool:
            start.wait()
            good = True
            for i in range(20):
                x = (number * 7 + i * 3) % 40 - 20.0
                good &= names(client.around(x, -x, 20)) == standing_map.in_circle(x, -x, 20)
                good &= client.stats().epoch == client.epoch
            return good

        with ThreadPoolExecutor(6) as pool:
            assert all(pool.map(ask, range(6)))


class OwnedLock:
    """A lock that knows which thread holds it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.owner = 0

    def __enter__(self) -> None:
        self._lock.acquire()
        self.owner = threading.get_ident()

    def __exit__(self, *_error: object) -> None:
        self.owner = 0
        self._lock.release()

    def locked(self) -> bool:
        return self._lock.locked()


def test_a_socket_is_used_by_one_thread_at_a_time(
    standing: DaemonProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also by those that begin, end or take over a connection."""
    make, add, used = _Exchange.__init__, _Exchange.add, set[tuple[str, bool]]()

    def note(what: str, lock: OwnedLock) -> None:
        used.add((what, lock.owner == threading.get_ident()))

    class Watched:
        def __init__(self, socket: Any, lock: OwnedLock) -> None:
            self._socket, self._of = socket, lock

        def __getattr__(self, name: str) -> Any:
            note(name, self._of)
            return getattr(self._socket, name)

    def made(exchange: Any, watch: Any, *of: Any) -> None:
        watch.lock = OwnedLock()
        make(exchange, watch, *of)
        exchange.socket = Watched(exchange.socket, exchange.lock)

    def added(exchange: Any, *entry: Any, **sent: Any) -> None:
        note("add", exchange.lock)
        add(exchange, *entry, **sent)

    monkeypatch.setattr(_Exchange, "__init__", made)
    monkeypatch.setattr(_Exchange, "add", added)

    async def ask() -> None:
        async with shmmap.aio.connect(standing.endpoint, timeout=LONG_S) as client:
            await client.around(0, 0, 30)

    with shmmap.connect(standing.endpoint, timeout=LONG_S) as client:
        client.around(0, 0, 30)
        assert client.release() > 0
        client.futures.around(0, 0, 30).result(LONG_S)
    asyncio.run(ask())
    calls = ("add", "send", "recv", "setsockopt", "getsockopt")
    assert used == {(call, True) for call in calls}


FORK = """
import os, sys
import shmmap
client = shmmap.connect(sys.argv[1], name="fork")
cells = client.around(0, 0, 30)
total = float(sum(cell.xyz.astype("f8").sum() for cell in cells))
session = client.welcome.session
window = shmmap.MapWindow(client, 30)
window.move_to(0, 0, wait=20)
assert window.wait_until_current(20)
pid = os.fork()
if pid == 0:
    code = 1
    try:
        assert float(sum(cell.xyz.astype("f8").sum() for cell in cells)) == total
        assert len(window.cells) == len(cells)
        try:
            window.move_to(0, 0)
        except shmmap.BadRequest as error:
            assert "after the fork" in str(error)
        else:
            raise AssertionError("a window moved in the child")
        mine = client.around(0, 0, 30)
        assert [a is b for a, b in zip(mine, cells)] == [True] * len(cells)
        assert client.welcome.session != session
        stats = client.stats()
        assert {row.pid for row in stats.sessions} == {os.getpid(), os.getppid()}, stats.sessions
        with shmmap.MapWindow(client, 30) as own:
            assert len(own.move_to(0, 0, wait=20).added) == len(cells)
        del own, mine, cells
        client.close()
        code = 0
    finally:
        os._exit(code)
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
assert client.welcome.session == session
assert client.around(0, 0, 30).cells == cells.cells
assert client.welcome.session == session
assert float(sum(cell.xyz.astype("f8").sum() for cell in cells)) == total
window.close()
print("good")
"""


def test_fork(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORK, one.endpoint],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "good\n"), done.stderr
    assert done.stderr == ""


PACKAGE = str(Path(shmmap.__file__).parent)


def test_a_warm_differential_enters_few_files(
    standing: DaemonProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the call to its return, so that a reader can follow it; with new cells and without."""
    long = (*connection._OPTIONS, (zmq.RCVTIMEO, 60_000))  # on a busy machine, too, it is answered at once
    monkeypatch.setattr(connection, "_OPTIONS", long)
    entered: set[str] = set()

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            entered.add(frame.f_code.co_filename)

    with shmmap.connect(standing.endpoint) as client:
        everywhere = shmmap.Box(-1e3, -1e3, 1e3, 1e3)
        cells = client.area(everywhere, wait=60.0).cells
        for held in (cells[:8], cells):
            sys.setprofile(note)
            try:
                found = client.differential(everywhere, held)
            finally:
                sys.setprofile(None)
            assert len(found) == len(cells) - len(held)
    assert len(entered) <= 11, sorted(entered)
