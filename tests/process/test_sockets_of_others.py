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
from tests.support.daemon_process import counters, until
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


@pytest.mark.parametrize("stops", [1, 2])
def test_what_another_program_puts_there_stays_at_the_end(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path, stops: int
) -> None:
    """Also when a second signal ends the daemon at once."""
    one = daemon(divided_map.root)
    with socket.socket(socket.AF_UNIX) as other:
        os.unlink(one.endpoint)
        other.bind(one.endpoint)
        other.listen()
        before = os.stat(one.endpoint).st_ino
        until(lambda: counters(one)["sockets_missing"] == 1, lambda: one.log)
        assert json.loads(Shmmap(one, tmp_path)("health", "--json", code=1))["state"] == "unreachable"
        pid = one.pid
        for _ in range(stops):
            one.send(signal.SIGTERM)
        assert wait_ended(pid, 30.0)
        assert os.stat(one.endpoint).st_ino == before
        os.unlink(one.endpoint)
    assert one.stop() == 0


@pytest.mark.parametrize("what", ["the requests' socket", "all files", "the directory"])
def test_removed_sockets_come_back(daemon: DaemonFactory, divided_map: DividedMap, what: str) -> None:
    """Connections stay, new clients come in, and a second daemon is still refused."""
    one = daemon(divided_map.root)
    names = [name for name in os.listdir(one.runtime_dir) if name.endswith((".sock", ".lock"))]
    assert len(names) == 3
    with connect(one.endpoint) as client:
        held = client.selected(["0_0.pcd"], wait=30.0)
        log = one.log_path.read_text()
        if what == "the directory":
            shutil.rmtree(one.runtime_dir)
        else:
            for name in names if what == "all files" else [os.path.basename(one.endpoint)]:
                os.unlink(f"{one.runtime_dir}/{name}")
        until(lambda: os.path.exists(one.endpoint), lambda: log)
        assert client.stats().counters["sessions"] == 1, "the connection has stayed"
        assert client.disconnected_since is None
        with connect(one.endpoint) as another:
            assert len(another.selected(["0_0.pcd"], wait=30.0)) == 1
        assert len(held) == 1
    events = one.endpoint.removesuffix(".sock") + ".events.sock"
    until(lambda: os.path.exists(events), lambda: one.log)
    until(lambda: Path(one.runtime_dir, f"{one.instance}.lock").exists(), lambda: one.log)
    if what != "the directory":
        assert "and made again" in one.log
    second = one.spawn()
    assert second.wait(60) == 75


def test_a_socket_whose_directory_cannot_be_made(
    daemon: DaemonFactory, divided_map: DividedMap, tmp_path: Path
) -> None:
    """Told by `health`; it comes back as soon as that is possible."""
    one = daemon(divided_map.root)
    moved_away = one.runtime_dir + "-moved-away"
    os.rename(one.runtime_dir, moved_away)
    try:
        Path(one.runtime_dir).write_text("in the way")
        until(lambda: counters(one)["sockets_missing"] == 2, lambda: Path(moved_away, "log.txt").read_text())
        assert Shmmap(one, tmp_path)("health", code=1).startswith("unreachable")
        os.unlink(one.runtime_dir)
        until(lambda: os.path.exists(one.endpoint), lambda: Path(moved_away, "log.txt").read_text())
        until(lambda: counters(one)["sockets_missing"] == 0, lambda: Path(moved_away, "log.txt").read_text())
    finally:
        shutil.rmtree(moved_away)
