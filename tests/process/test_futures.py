# SPDX-License-Identifier: Apache-2.0
"""Requests of one client that are under way together: futures, threads, windows; cancelled, forked."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, as_completed
from typing import Any

import numpy as np
import pytest

import shmmap
from shmmap.client.window import follower
from shmmap.errors import BadRequest, LoadTimeout, NoAnswer, UnknownCell
from tests.process.conftest import COLD
from tests.support.daemon_process import DaemonProcess, standing_still, until
from tests.support.divided_map import DividedMap
from tests.support.segment_reader import names

LONG_S = 60.0


@pytest.fixture
def client(one: DaemonProcess) -> Iterator[shmmap.Client]:
    with shmmap.connect(one.endpoint, timeout=LONG_S) as client:
        yield client


def table_of(client: shmmap.Client) -> Any:
    assert client.session._connection is not None
    return client.session._connection._exchange.table


def test_answers_are_those_of_the_client(client: shmmap.Client) -> None:
    expected = client.around(0, 0, 30)
    held = [cell.id for cell in expected[:3]]
    area = shmmap.Box(-5, -5, 5, 5)
    futures = client.futures
    asked: list[tuple[Future[Any], Any]] = [
        (futures.around(0, 0, 30), expected.cells),
        (futures.area(area, pose=(0, 0)), client.area(area).cells),
        (futures.differential(shmmap.Circle(0, 0, 30), held), expected.cells[3:]),
        (futures.selected(held[::-1]), expected.cells[2::-1]),
    ]
    for future, cells in asked:
        assert isinstance(future, Future)
        assert future.result(LONG_S).cells == cells
        assert future.exception() is None
    points = futures.points_around(0, 0, 20).result(LONG_S)
    assert np.array_equal(points.gather(), client.points_around(0, 0, 20).gather())
    assert points.covered
    assert table_of(client).entries == {}


def test_errors(client: shmmap.Client) -> None:
    with pytest.raises(BadRequest, match="radius"):
        client.futures.around(0, 0, -1)
    with pytest.raises(BadRequest, match="wait"):
        client.futures.around(0, 0, 1, wait=-1)
    with pytest.raises(BadRequest, match="layer"):
        client.futures.around(0, 0, 1, layers="none").result(LONG_S)
    assert isinstance(client.futures.around(1e6, 0, 1, strict=True).exception(LONG_S), UnknownCell)
    with pytest.warns(shmmap.ShmmapWarning, match="no cell"):
        client.futures.around(1e6, 0, 1).result(LONG_S)


def test_warm_beside_those_that_wait(one: DaemonProcess, client: shmmap.Client) -> None:
    """Futures, callers in threads and what a caller asks meanwhile: each gets its own, when it is there."""
    with standing_still(one):
        waiting = [client.futures.around(*COLD, wait=LONG_S) for _ in range(64)]
        found: list[shmmap.CellSet] = []
        threads = [
            threading.Thread(target=lambda: found.append(client.around(*COLD, wait=LONG_S))) for _ in range(3)
        ]
        for thread in threads:
            thread.start()
        for _ in range(5):
            assert client.around(0, 0, 5).complete
            assert client.stats().epoch == client.epoch
            assert client.futures.around(0, 0, 5).result(LONG_S).complete
        late = client.futures.around(*COLD, wait=LONG_S)
        until(lambda: len(table_of(client)._held) == 4)
        assert not any(future.done() for future in (late, *waiting))
        assert found == []
    for future in (late, *waiting):
        assert names(future.result(LONG_S)) == ["40_40.pcd"]
    for thread in threads:
        thread.join(LONG_S)
    assert [names(cells) for cells in found] == [["40_40.pcd"]] * 3


def test_what_is_still_pending_when_the_wait_is_over(one: DaemonProcess, client: shmmap.Client) -> None:
    with standing_still(one):
        for _ in range(70):
            client.futures.around(*COLD, wait=LONG_S)
        late = client.futures.around(*COLD, wait=0.2, strict=None)
        assert late.result(LONG_S).pending
        error = client.futures.around(*COLD, wait=0.1, strict=True).exception(LONG_S)
        assert isinstance(error, LoadTimeout)


def test_cancelled(one: DaemonProcess, client: shmmap.Client) -> None:
    """Places become free at once, and callbacks are called."""
    with standing_still(one):
        futures = [client.futures.around(*COLD, wait=LONG_S) for _ in range(64)]
        last = client.futures.around(*COLD, wait=LONG_S)
        until(lambda: len(table_of(client)._held) == 1)
        seen: list[bool] = []
        futures[0].add_done_callback(lambda future: seen.append(future.cancelled()))
        assert futures[0].cancel()
        assert futures[0].cancel(), "again"
        until(lambda: not table_of(client)._held)
        for future in futures[1:]:
            assert future.cancel()
        with pytest.raises(CancelledError):
            futures[0].result()
        assert seen == [True]
        until(lambda: len(table_of(client).entries) == 1)
        assert not last.done()
    assert names(last.result(LONG_S)) == ["40_40.pcd"]
    assert not last.cancel()
    assert table_of(client).entries == {}


def test_a_thousand_cancelled(one: DaemonProcess, client: shmmap.Client) -> None:
    """No entry here and no place there is left."""
    with standing_still(one):
        for future in [client.futures.around(*COLD, wait=600) for _ in range(1000)]:
            assert future.cancel()
        until(lambda: not table_of(client).is_busy)
        more = [client.futures.around(*COLD, wait=600) for _ in range(64)]
        client.stats()
        assert (len(table_of(client)._held), len(table_of(client)._waiting)) == (0, 64)
    for future in more:
        assert names(future.result(LONG_S)) == ["40_40.pcd"]


def test_a_caller_that_is_interrupted_leaves_no_place(one: DaemonProcess, client: shmmap.Client) -> None:
    class Interrupt(Exception):
        pass

    def ring(*_: object) -> None:
        raise Interrupt

    before = signal.signal(signal.SIGUSR1, ring)
    try:
        with standing_still(one):
            for to in [threading.main_thread()] * 70 + [None]:

                def interrupt(to: threading.Thread | None = to) -> None:
                    until(lambda: table_of(client).entries)
                    # a signal that another thread takes does not end the main thread's waiting, nor does one
                    # just before it
                    signal.pthread_kill((to or threading.current_thread()).ident or 0, signal.SIGUSR1)

                thread = threading.Thread(target=interrupt)
                thread.start()
                with pytest.raises(Interrupt):
                    client.around(*COLD, wait=600)
                thread.join()
                until(lambda: not table_of(client).is_busy)
            more = [client.futures.around(*COLD, wait=600) for _ in range(64)]
            client.stats()
            assert (len(table_of(client)._held), len(table_of(client)._waiting)) == (0, 64)
        assert all(future.result(LONG_S).complete for future in more)
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_callbacks(client: shmmap.Client) -> None:
    """One that raises and one that asks; neither keeps other futures from being completed."""
    done: list[Any] = []
    first = client.futures.around(0, 0, 5)
    first.add_done_callback(lambda _: 1 / 0)
    first.add_done_callback(lambda _: done.append(client.around(0, 0, 5).cells))
    first.add_done_callback(lambda _: done.append(client.futures.around(0, 0, 5)))
    cells = first.result(LONG_S).cells
    more = [client.futures.around(0, 0, 5) for _ in range(100)]
    assert all(future.result().cells == cells for future in as_completed(more, timeout=LONG_S))
    assert done[0] == cells
    assert done[1].result(LONG_S).cells == cells


def test_in_an_event_loop(client: shmmap.Client) -> None:
    async def main() -> list[shmmap.CellSet]:
        return await asyncio.gather(
            *(asyncio.wrap_future(client.futures.around(0, 0, radius)) for radius in range(1, 9))
        )

    for radius, cells in enumerate(asyncio.run(main()), 1):
        assert cells.cells == client.around(0, 0, radius).cells


def test_a_daemon_that_is_killed_while_many_wait(one: DaemonProcess, divided_map: DividedMap) -> None:
    with shmmap.connect(one.endpoint, timeout=LONG_S) as client:
        epoch = client.epoch
        one.send(signal.SIGSTOP)
        futures = [client.futures.around(*COLD, wait=LONG_S) for _ in range(200)]
        one.kill()
        one.start()
        for future in futures:
            assert names(future.result(LONG_S)) == divided_map.in_circle(*COLD)
        assert client.epoch != epoch


def test_a_daemon_that_is_gone(one: DaemonProcess) -> None:
    with shmmap.connect(one.endpoint, timeout=0.2) as client:
        one.kill()
        futures = [client.futures.around(0, 0, 5, wait=0) for _ in range(10)]
        for future in futures:
            assert isinstance(future.exception(LONG_S), NoAnswer)


def test_closed(one: DaemonProcess) -> None:
    client = shmmap.connect(one.endpoint)
    with standing_still(one):
        futures = [client.futures.around(*COLD, wait=LONG_S) for _ in range(3)]
        failed: list[BaseException] = []

        def ask() -> None:
            try:
                client.around(*COLD, wait=LONG_S)
            except BadRequest as error:
                failed.append(error)

        thread = threading.Thread(target=ask)
        thread.start()
        until(lambda: len(table_of(client).entries) == 4)
        client.close()
        thread.join(LONG_S)
        for future in futures:
            with pytest.raises(BadRequest, match="closed"):
                future.result(LONG_S)
        assert len(failed) == 1
    with pytest.raises(BadRequest, match="closed"):
        client.futures.around(0, 0, 1)


def test_a_client_that_is_dropped_answers_its_futures(one: DaemonProcess) -> None:
    future = shmmap.connect(one.endpoint).futures.around(*COLD, wait=LONG_S)
    assert names(future.result(LONG_S)) == ["40_40.pcd"]


@pytest.mark.parametrize("background", [True, False])
def test_a_window_whose_cells_load(
    one: DaemonProcess, client: shmmap.Client, monkeypatch: pytest.MonkeyPatch, background: bool
) -> None:
    """Requests of other threads do not wait for the window's, however long that waits."""
    monkeypatch.setattr(follower, "_PENDING_WAIT_S", LONG_S)
    with standing_still(one), shmmap.MapWindow(client, 5, background=background) as window:
        moving = threading.Thread(target=lambda: window.move_to(50, 50, wait=LONG_S))
        moving.start()
        until(lambda: table_of(client)._waiting)
        for _ in range(5):
            assert client.around(0, 0, 5).complete
        assert table_of(client)._waiting
        standing = one.loaders()
        for pid in standing:
            os.kill(pid, signal.SIGCONT)
        moving.join(LONG_S)
        assert names(window.cells) == ["40_40.pcd"]


FORK = """
import os, sys
import shmmap
client = shmmap.connect(sys.argv[1], name="fork")
done = client.futures.around(0, 0, 5)
cells = done.result(60).cells
waiting = [client.futures.around(50, 50, 5, wait=60) for _ in range(100)]
called = []
for future in waiting:
    future.add_done_callback(called.append)
pid = os.fork()
if pid == 0:
    code = 1
    try:
        assert done.result().cells == cells
        for future in waiting:
            assert future.done() and not future.cancel()
            try:
                future.result()
            except shmmap.BadRequest as error:
                assert "fork" in str(error)
            else:
                raise AssertionError("a future of the parent's")
        assert called == []
        mine = client.futures.around(0, 0, 5)
        assert mine.result(60).cells == cells
        assert not client.session._connection._exchange.table.entries
        client.close()
        code = 0
    finally:
        os._exit(code)
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
print("forked", flush=True)
sys.stdin.readline()
assert all(len(future.result(60)) == 1 for future in waiting)
print("good")
"""


def test_fork(one: DaemonProcess) -> None:
    command = [sys.executable, "-W", "ignore::DeprecationWarning", "-c", FORK, one.endpoint]
    with standing_still(one):
        program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert program.stdout is not None
        assert program.stdout.readline() == "forked\n"
    out, _ = program.communicate("\n", timeout=LONG_S)
    assert (program.returncode, out) == (0, "good\n")
