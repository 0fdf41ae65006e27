# SPDX-License-Identifier: Apache-2.0
"""``shmmap view --browser`` against a real daemon: who may look, what is sent, and that nothing is left."""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shmmap as library
from shmmap.errors import PackageMissing
from tests.process.conftest import DaemonFactory
from tests.support.cloud_bytes import write_las
from tests.support.command_line import Shmmap
from tests.support.daemon_process import DaemonProcess, Deadline
from tests.support.divided_map import DividedMap, make_map
from tests.support.live_drive import FILTER, drive
from tests.support.live_reference import LiveDaemon
from tests.support.pages import read_page

pytest.importorskip("viser", reason="viser is not installed")

from tests.support.viewer import Viewer

ABOVE = (0.0, 0.0, 20.0)


class View:
    """A running ``shmmap view --browser``; it ends as by Ctrl-C."""

    def __init__(self, one: DaemonProcess, *words: str, command: str = "shmmap view --browser") -> None:
        assert command.split()[0] == "shmmap"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "shmmap.cli", *command.split()[1:], "--listen", "0", *words],
            env=Shmmap(one, Path()).environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("open http://127.0.0.1:"), line + self.process.communicate()[1]
        self.url = line.split()[1]

    def __enter__(self) -> View:
        return self

    def __exit__(self, *exception: object) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            said = self.process.communicate(timeout=60.0)[1]
        finally:
            self.process.kill()
        assert (self.process.returncode, said) == (0, "")


def seen(page: Viewer, done: Callable[[], object]) -> None:
    """Take messages until something is so."""
    waiting = Deadline()
    while waiting(not done(), lambda: f"{page.nodes} {page.texts}"):
        page.receive(0.2)


def status(page: Viewer) -> str:
    """What stands beside the map."""
    return " ".join(str(one.get("_markdown", "")) for one in page.texts.values())


def whole(page: Viewer, cells: int) -> bool:
    """Whether all cells are on the page."""
    return f"points of {cells} cells  \n" in status(page)


def answered(url: str, headers: dict[str, str], *, path: str | None = None) -> tuple[int, bytes]:
    """Status and body of a request with only these headers."""
    host, port, given = re.fullmatch(r"http://([\d.]+):(\d+)(/.*)", url).groups()  # type: ignore[union-attr]
    connection = http.client.HTTPConnection(host, int(port), timeout=30.0)
    with contextlib.closing(connection):
        connection.putrequest("GET", path or given, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        response = connection.getresponse()
        return response.status, response.read()


def holds_nothing(one: DaemonProcess) -> None:
    """The viewer holds and maps no cell."""
    with library.connect(one.endpoint, shm_dir=one.shm_dir, name="judge") as client:
        waiting = Deadline()
        while waiting(
            any(
                row.cells or row.mapped_bytes
                for row in client.stats().sessions
                if row.client == "shmmap view"
            )
        ):
            pass


def test_who_may_look(standing: DaemonProcess) -> None:
    with View(standing) as view:
        host = view.url.split("/")[2]
        code, body = answered(view.url, {"Host": host})
        assert (code, body[:15]) == (200, b"<!doctype html>")
        upgrade = {
            "Host": host, "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Origin": f"http://{host}",
        }  # fmt: skip
        secret = view.url.split("/")[3]
        for headers, path in (
            ({"Host": host}, "/"),
            ({"Host": host}, "/x" + secret),
            ({"Host": "evil.example"}, None),
            ({}, None),
            ({"Host": host, "Origin": "http://evil.example"}, None),
            (upgrade | {"Origin": "http://evil.example"}, None),
            (upgrade | {"Origin": "null"}, None),
            ({name: value for name, value in upgrade.items() if name != "Origin"}, None),
            (upgrade | {"Host": "evil.example", "Origin": "http://evil.example"}, None),
            (upgrade, "/"),
        ):
            assert answered(view.url, headers, path=path)[0] == 403, (headers, path)
        with Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: page.clouds)


def test_points_are_those_of_the_map_and_a_move_sends_what_changes(
    standing: DaemonProcess, standing_map: DividedMap
) -> None:
    with View(standing, "--circle", "0,0,30") as view, Viewer(view.url) as page:
        page.look(ABOVE)
        seen(page, lambda: whole(page, len(standing_map.corners)))
        page.quiet(2.0)  # colours may have been settled again
        origin = np.array(page.positions.get("/map", (0.0, 0.0, 0.0)))  # 0 is not said
        assert np.abs(origin[:2]).max() < 1.0
        for name, points in page.clouds.items():
            assert points.dtype == np.float16
            at = points.astype(np.float64) + page.positions[name]
            assert (np.abs(at[:, :2]) < 100.0).all()
        everything = np.concatenate([page.clouds[name] + page.positions[name] for name in page.clouds])
        theirs = np.concatenate(
            [
                np.stack([standing_map.points(name)[axis] for axis in "xyz"], axis=1)
                for name in standing_map.corners
            ]
        )
        assert everything.min(axis=0) == pytest.approx(np.nanmin(theirs, axis=0), abs=0.5)
        assert everything.max(axis=0) == pytest.approx(np.nanmax(theirs, axis=0), abs=0.5)
        before, sent = dict(page.clouds), page.nbytes
        page.look(ABOVE, (5.0, 5.0, 0.0))
        page.quiet(2.0)
        assert page.nbytes - sent < 10_000, "a turn needs nothing"
        assert page.clouds.keys() == before.keys()
        page.look((0.0, 0.0, 900.0))
        seen(page, lambda: set(page.sizes.values()) & {2.0, 5.0})
        page.quiet(2.0)
    holds_nothing(standing)


def test_a_client_is_followed(standing: DaemonProcess) -> None:
    with library.connect(standing.endpoint, shm_dir=standing.shm_dir, name="planner") as client:
        window = library.MapWindow(client, radius=12)
        window.move_to(3.0, 4.0, heading=0.5)
        with View(standing, "--follow", "planner") as view, Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: "planner" in page.labels.values())
            assert page.positions["/map"][:2] == pytest.approx((-3.0, -4.0))
            kinds = [kind for name, kind in page.nodes.items() if "/clients/" in name]
            assert sorted(kinds) == ["LabelMessage", "LineSegmentsMessage", "MeshMessage"]
            window.move_to(5.0, -2.0, heading=0.6)
            seen(page, lambda: page.positions["/map"][:2] == pytest.approx((-5.0, 2.0)))
            window.close()
            client.close()
            seen(page, lambda: "planner" not in page.labels.values())
            assert page.positions["/map"][:2] == pytest.approx((-5.0, 2.0)), "the view stays"


def test_a_client_is_followed_far_from_the_origin(standing: DaemonProcess) -> None:
    """A step is small beside coordinates in UTM."""
    with library.connect(standing.endpoint, shm_dir=standing.shm_dir, name="planner") as client:
        window = library.MapWindow(client, radius=12)
        window.move_to(450_003.0, 5_410_004.0, heading=0.5)
        with View(standing, "--follow", "planner") as view, Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: "planner" in page.labels.values())
            assert page.positions["/map"][:2] == (-450_003.0, -5_410_004.0)
            window.move_to(450_003.0, 5_410_004.5, heading=0.5)
            seen(page, lambda: page.positions["/map"][:2] == (-450_003.0, -5_410_004.5))
            markers = [at for name, at in page.positions.items() if "/clients/" in name]
            assert len(markers) == 3
            assert {at[:2] for at in markers} == {(450_003.0, 5_410_004.5)}
        window.close()


def test_hostile_names(standing: DaemonProcess) -> None:
    """A list with one text twice is shown by no browser, and Markdown may be HTML."""
    with View(standing) as view, Viewer(view.url) as page, contextlib.ExitStack() as clients:
        for name in ("no client", "twice", "twice", "<b>x</b>"):
            client = library.connect(standing.endpoint, shm_dir=standing.shm_dir, name=name)
            window = library.MapWindow(clients.enter_context(client), radius=12)
            clients.enter_context(window).move_to(3.0, 4.0)
        page.look(ABOVE)
        seen(page, lambda: {"no client", "twice", "<b>x</b>"} <= set(page.labels.values()))
        seen(page, lambda: any("<b>x</b>" in one.get("options", ()) for one in page.texts.values()))
        options = [one["options"] for one in page.texts.values() if "options" in one]
        assert [sorted(one) for one in options] == [["<b>x</b>", "no client", "twice"]]


@pytest.mark.slow
def test_a_killed_daemon_and_a_changed_cell(daemon: DaemonFactory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with View(one, "--circle", "0,0,30") as view, Viewer(view.url) as page:
        page.look(ABOVE)
        seen(page, lambda: whole(page, len(divided_map.corners)))
        page.quiet(2.0)
        one.kill()
        seen(page, lambda: "the daemon is gone" in status(page))
        before = dict(page.clouds)
        name = next(iter(divided_map.corners))
        divided_map.change(name, seed=77, count=333)
        one.start()
        seen(page, lambda: "the daemon is gone" not in status(page))
        seen(page, lambda: page.clouds.keys() != before.keys())
        seen(page, lambda: whole(page, len(divided_map.corners)))
        fresh = page.clouds.keys() - before.keys()
        assert sum(len(page.clouds[node]) for node in fresh) <= 333
        assert len({node.split("/")[3].partition(".")[0] for node in fresh}) == 1, "what did not change stays"
    holds_nothing(one)


def test_memory_is_short(daemon: DaemonFactory, tmp_path: Path) -> None:
    """Where clients' points fill the budget these are shown, thinned; none of them is evicted."""
    made = make_map(tmp_path / "map", columns=6, rows=6, points=3000)
    measured, everywhere = daemon(made.root), library.Box(-1e3, -1e3, 1e3, 1e3)
    with library.connect(measured.endpoint) as client:
        assert client.area(everywhere, wait=60.0).complete
        budget = sum(client.stats().counters[name] for name in ("bytes_resident", "bytes_statistics"))
    one = daemon(made.root, "--budget", str(budget + (512 << 10)))
    with library.connect(one.endpoint) as client:
        held = client.area(everywhere, wait=60.0)
        assert held.complete
        before = client.stats().counters
        with View(one) as view, Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: whole(page, len(made.corners)))
            assert 0 < page.points <= sum(cell.points for cell in held)
        after = client.stats().counters
        assert after["evictions"] == before["evictions"]
        assert after["loads_finished"] - before["loads_finished"] < len(made.corners) / 2
        assert len(client.area(everywhere).cells) == len(made.corners)
    holds_nothing(one)


def test_ctrl_c_and_a_browser_that_leaves(standing: DaemonProcess) -> None:
    with View(standing) as view:
        for _ in range(3):
            page = Viewer(view.url)
            page.look(ABOVE)
            seen(page, lambda page=page: page.clouds)  # type: ignore[misc]
            page.close()
        holds_nothing(standing)
        with Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: page.clouds)
            began_s = time.monotonic()
            view.process.send_signal(signal.SIGINT)
            assert view.process.wait(60.0) == 0
            assert time.monotonic() - began_s < 30.0
    with library.connect(standing.endpoint, shm_dir=standing.shm_dir, name="judge") as client:
        waiting = Deadline()
        while waiting(any(row.client == "shmmap view" for row in client.stats().sessions)):
            pass


def test_chunks_of_a_live_map(live_daemon: LiveDaemon) -> None:
    one = live_daemon()
    with library.connect(one.endpoint) as client, client.live("lidar").mapper("front", FILTER) as mapper:
        for points, pose in drive(1):
            mapper.add(points, pose)
        mapper.wait_applied()
        chunks = len(client.live("lidar").chunks())
        assert chunks
        with View(one) as view, Viewer(view.url) as page:
            page.look(ABOVE)
            seen(page, lambda: sum("/chunks/lidar/" in name for name in page.nodes) == chunks)


def test_two_commands_turn_an_own_cloud(daemon: DaemonFactory, tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    columns = {axis: random.uniform(0.0, 60.0, 20_000) for axis in "xyz"}
    write_las(tmp_path / "own.las", columns | {"intensity": random.integers(0, 99, 20_000)})
    one = daemon(tmp_path / "own.las")
    (command,) = read_page("shmmap/dividing/OWN_CLOUD.md").commands("browser")
    with View(one, "--by", "intensity", command=command) as view, Viewer(view.url) as page:
        page.look(ABOVE)
        seen(page, lambda: page.points > 10_000)


def refused(one: DaemonProcess, tmp_path: Path, *words: str, environment: dict[str, str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "shmmap.cli", "view", "--browser", *words],
        env=Shmmap(one, tmp_path).environment | environment,
        capture_output=True,
        text=True,
        timeout=120.0,
    )
    return done.returncode, done.stderr


def test_without_viser(standing: DaemonProcess, tmp_path: Path) -> None:
    (tmp_path / "viser.py").write_text("raise ModuleNotFoundError('No module named viser', name='viser')\n")
    environment = Shmmap(standing, tmp_path).environment
    path = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{environment['PYTHONPATH']}"}
    code, said = refused(standing, tmp_path, "--listen", "0", environment=path)
    assert code == PackageMissing.exit_code
    assert "shmmap view --browser needs the package viser" in said
    assert "pip install 'shmmap[view]'" in said


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("--image m.png", 2, "not allowed with argument"),
        ("map.pcd", 2, "without PATH"),
        ("--layer ndt(leaf=2.0)", 2, "without --layer"),
        ("--from north", 2, "--from is for a picture"),
        ("--json", 2, "--json describes a picture"),
        ("--listen nowhere", 2, "no address to listen at"),
        ("--listen 192.0.2.7:80", 2, "cannot listen at 192.0.2.7 port 80"),
        ("--follow stranger", 2, "no client is called 'stranger'"),
    ],
)
def test_what_is_refused(reading: Shmmap, words: str, code: int, said: str) -> None:
    done = reading.run("view", "--browser", *words.split())
    assert (done.returncode, said in done.stderr) == (code, True), done.stderr


def test_no_such_column(standing: DaemonProcess) -> None:
    view = View(standing, "--by", "ring")
    with contextlib.suppress(Exception), Viewer(view.url) as page:
        page.look(ABOVE)
        while page.receive(60.0):
            pass
    _, said = view.process.communicate(timeout=60.0)
    assert view.process.returncode == 2
    assert "has no column 'ring'" in said
