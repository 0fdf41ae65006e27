# SPDX-License-Identifier: Apache-2.0
"""What a client saves, and what it leaves behind when it is not closed."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest

import shmmap
from shmmap.client import attaching
from shmmap.client.connection import Connection
from shmmap.client.connection_watch import running
from shmmap.protocol.messages import Differential
from shmmap.segment.attach import attach
from tests.support.daemon_process import DaemonProcess, open_files
from tests.support.divided_map import DividedMap

Factory = Callable[..., DaemonProcess]
LONG_S = 60.0


def mapped(one: DaemonProcess) -> list[str]:
    """Segments of the daemon that this process maps, from the kernel."""
    prefix = f"{one.shm_dir}/shmmap.{one.instance}."
    maps = Path("/proc/self/maps").read_text().splitlines()
    return [line for line in maps if prefix in line and not line.endswith(".statistics")]


# --- the short paths are taken ----------------------------------------------------------------------


def test_what_is_attached_is_not_opened_again(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opens(*_: object, **__: object) -> NoReturn:
        raise AssertionError("a segment was opened that is attached already")

    with shmmap.connect(daemon(divided_map.root).endpoint) as client:
        first = client.around(0, 0, 30)
        with monkeypatch.context() as patch:
            patch.setattr(attaching, "attach", opens)
            assert client.around(0, 0, 30).cells == first.cells
            assert client.selected([first[0].name]).cells == first.cells[:1]
            with pytest.raises(AssertionError, match="opened"):
                client.around(0, 0, 60)


@pytest.mark.parametrize("background", [True, False])
def test_a_window_names_what_it_holds_by_versions_alone(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch, background: bool
) -> None:
    """Eight bytes a cell: the daemon answers those requests on its short path."""
    asked: list[Differential] = []
    ask = Connection.ask

    def ask_and_record(connection: Connection, message: Any, kind: Any, **options: Any) -> Any:
        if isinstance(message, Differential):
            asked.append(message)
        return ask(connection, message, kind, **options)

    monkeypatch.setattr(Connection, "ask", ask_and_record)
    one = daemon(divided_map.root)
    with shmmap.MapWindow(one.endpoint, 30, update_distance=0, background=background) as window:
        window.move_to(0, 0, wait=LONG_S)
        held = len(window.cells)
        asked.clear()
        assert window.move_to(
            6, 0, wait=LONG_S
        ).complete  # so far that it asks, whether anything is new or not
        assert (asked[0].held, len(asked[0].packed)) == ((), 8 * held)


# --- dropped without close --------------------------------------------------------------------------


def test_a_client_that_is_dropped_leaves_nothing_here_and_frees_what_it_held(
    daemon: Factory, divided_map: DividedMap
) -> None:
    """No descriptor, no mapping, no thread; and the daemon can take the memory back at once."""
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as operator:
        files, threads = set(open_files()), len(running)
        for _ in range(3):
            cells = shmmap.connect(one.endpoint).around(0, 0, 30, wait=LONG_S)
            assert cells.complete
        gc.collect()
        assert (set(open_files()), len(running)) == (files, threads)
        assert len(mapped(one)) == len(cells), "cells live as long as they are used"
        refused = operator.evict()
        assert (refused.freed, refused.pinned) == (0, len(cells))
        del cells
        assert mapped(one) == []
        again = operator.around(0, 0, 30, wait=LONG_S)
        count = len(again)
        del again
        operator.release()
        assert operator.evict().freed == count, "nothing is held for clients that are gone"


def test_a_window_that_is_dropped_lets_everything_go(daemon: Factory, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as operator:
        files, threads = set(open_files()), len(running)
        window = shmmap.MapWindow(one.endpoint, 30)
        window.move_to(0, 0, wait=LONG_S)
        count = len(window.cells)
        assert len(mapped(one)) == count > 0
        del window
        gc.collect()
        assert (set(open_files()), len(running), mapped(one)) == (files, threads, [])
        assert operator.evict().freed == count


def test_a_process_that_ends_without_close_frees_what_it_held(
    daemon: Factory, divided_map: DividedMap
) -> None:
    one = daemon(divided_map.root)
    program = (
        "import os, sys, shmmap\n"
        "client = shmmap.connect(sys.argv[1])\n"
        "cells = client.around(0, 0, 30, wait=60)\n"
        "print(len(cells), flush=True)\n"
        "os._exit(0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, one.endpoint], capture_output=True, text=True, check=True
    )
    with shmmap.connect(one.endpoint) as operator:
        assert operator.evict().freed == int(done.stdout) > 0


# --- what the user's code raises --------------------------------------------------------------------


def test_a_policy_that_raises_costs_the_call_and_nothing_else(
    daemon: Factory, divided_map: DividedMap
) -> None:
    """Without a thread the exception comes out of `move_to`, and the window goes on."""
    failing = [True]

    class Policy:
        def keep(self, departed: Any) -> list[bool]:
            if failing[0]:
                raise ZeroDivisionError
            return [False] * len(departed)

    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        window = shmmap.MapWindow(client, 30, update_distance=0, retention=Policy(), background=False)
        window.move_to(0, 0, wait=LONG_S)
        with pytest.raises(ZeroDivisionError):
            window.move_to(60, 60, wait=LONG_S)
        failing[0] = False
        assert client.stats().epoch == client.epoch, "no lock is left taken"
        assert window.move_to(60, 60, wait=LONG_S).complete
        window.close()
        gc.collect()
        assert mapped(one) == []


def test_an_exception_while_attaching_costs_the_request_alone(
    daemon: Factory, divided_map: DividedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupted(Exception):
        """As a signal handler may raise it anywhere."""

    left = [2]

    def interrupted(*arguments: Any, **options: Any) -> Any:
        left[0] -= 1
        if not left[0]:
            raise Interrupted
        return attach(*arguments, **options)

    one = daemon(divided_map.root)
    with shmmap.connect(one.endpoint) as client:
        client.around(0, 0, 30, wait=LONG_S)
        client.release()
        files = set(open_files())
        monkeypatch.setattr(attaching, "attach", interrupted)
        with pytest.raises(Interrupted) as raised:
            client.around(0, 0, 30, wait=LONG_S)
        del raised
        gc.collect()
        assert (set(open_files()), mapped(one)) == (files, [])
        assert client.around(0, 0, 30, wait=LONG_S).complete
