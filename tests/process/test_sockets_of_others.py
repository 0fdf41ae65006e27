# SPDX-License-Identifier: Apache-2.0
"""Another program's socket is never taken, and the daemon's own come back when they are removed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
from pathlib import Path

import pytest

from shmmap import connect
from shmmap.testing.daemon_process import wait_ended
from tests.process.conftest import DaemonFactory
from tests.support.command_line import Shmmap
from tests.support.daemon_process import DaemonProcess, counters, until
from tests.support.divided_map import DividedMap


@pytest.mark.parametrize("which", ["requests", "events"])
def test_another_program_listens_there(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, which: str
) -> None:
    one = daemon(divided_map.root, start=False)
    path = one.endpoint if which == "requests" else one.endpoint.removesuffix(".sock") + ".events.sock"
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(path)
        other.listen()
        before = os.stat(path).st_ino
        process = one.spawn()
        assert process.wait(60) == 75, one.log
        assert f"in use by pid {os.getpid()} (" in one.log
        assert os.stat(path).st_ino == before
        assert [name for name in os.listdir(one.runtime_dir) if name.endswith(".lock")] == []
    one.start()  # it has ended: its socket is a leftover, which is replaced
    assert Shmmap(one, tmp_path)("health").startswith("healthy")


def test_another_program_is_about_to_listen_there(served: DaemonProcess) -> None:
    """What is bound there is not taken for a leftover; what its program leaves is."""
    with socket.socket(socket.AF_UNIX) as other:
        os.unlink(served.endpoint)
        other.bind(served.endpoint)
        before = os.stat(served.endpoint).st_ino
        until(lambda: counters(served)["sockets_missing"] == 1, lambda: served.log)
        assert f"in use by pid {os.getpid()} (" in served.log
        assert os.stat(served.endpoint).st_ino == before
    until(lambda: counters(served)["sockets_missing"] == 0, lambda: served.log)
    with connect(served.endpoint) as client:
        assert len(client.selected(["0_0.pcd"], wait=30.0)) == 1


@pytest.mark.parametrize("stops", [1, 2])
def test_what_another_program_puts_there_stays_at_the_end(
    served: DaemonProcess, tmp_path: Path, stops: int
) -> None:
    """Also when a second signal ends the daemon at once."""
    with socket.socket(socket.AF_UNIX) as other:
        os.unlink(served.endpoint)
        other.bind(served.endpoint)
        other.listen()
        before = os.stat(served.endpoint).st_ino
        until(lambda: counters(served)["sockets_missing"] == 1, lambda: served.log)
        assert json.loads(Shmmap(served, tmp_path)("health", "--json", code=1))["state"] == "unreachable"
        pid = served.pid
        for _ in range(stops):
            served.send(signal.SIGTERM)
        assert wait_ended(pid, 30.0)
        assert os.stat(served.endpoint).st_ino == before
        os.unlink(served.endpoint)
    assert served.stop() == 0


@pytest.mark.parametrize("what", ["the requests' socket", "all files", "the directory"])
def test_removed_sockets_come_back(served: DaemonProcess, what: str) -> None:
    """Connections stay, new clients come in, and a second daemon is still refused."""
    names = [name for name in os.listdir(served.runtime_dir) if name.endswith((".sock", ".lock"))]
    assert len(names) == 3
    with connect(served.endpoint) as client:
        held = client.selected(["0_0.pcd"], wait=30.0)
        log = served.log_path.read_text()
        if what == "the directory":
            shutil.rmtree(served.runtime_dir)
        else:
            for name in names if what == "all files" else [os.path.basename(served.endpoint)]:
                os.unlink(f"{served.runtime_dir}/{name}")
        until(lambda: os.path.exists(served.endpoint), lambda: log)
        assert client.stats().counters["sessions"] == 1, "the connection has stayed"
        assert client.disconnected_since is None
        with connect(served.endpoint) as another:
            assert len(another.selected(["0_0.pcd"], wait=30.0)) == 1
        assert len(held) == 1
    events = served.endpoint.removesuffix(".sock") + ".events.sock"
    until(lambda: os.path.exists(events), lambda: served.log)
    until(lambda: Path(served.runtime_dir, f"{served.instance}.lock").exists(), lambda: served.log)
    if what != "the directory":
        assert "and made again" in served.log
    second = served.spawn()
    assert second.wait(60) == 75


def test_a_socket_whose_directory_cannot_be_made(served: DaemonProcess, tmp_path: Path) -> None:
    """`health` says so; it comes back as soon as that is possible."""
    moved_away = served.runtime_dir + "-moved-away"
    os.rename(served.runtime_dir, moved_away)
    try:
        Path(served.runtime_dir).write_text("in the way")
        until(
            lambda: counters(served)["sockets_missing"] == 2, lambda: Path(moved_away, "log.txt").read_text()
        )
        assert Shmmap(served, tmp_path)("health", code=1).startswith("unreachable")
        os.unlink(served.runtime_dir)
        until(lambda: os.path.exists(served.endpoint), lambda: Path(moved_away, "log.txt").read_text())
        until(
            lambda: counters(served)["sockets_missing"] == 0, lambda: Path(moved_away, "log.txt").read_text()
        )
    finally:
        shutil.rmtree(moved_away)
