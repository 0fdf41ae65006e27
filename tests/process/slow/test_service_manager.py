# SPDX-License-Identifier: Apache-2.0
"""The daemon under a service manager: what it says, and a socket that was made for it."""

from __future__ import annotations

import os
import signal
import socket
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, until, wait_ended
from tests.support.divided_map import DividedMap
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]

PASS_SOCKET = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.environ.update(LISTEN_PID=str(os.getpid()), LISTEN_FDS="1", LISTEN_FDNAMES="shmmapd.socket")
os.execvp(sys.argv[2], sys.argv[2:])
"""


class Manager:
    """The socket that sd_notify(3) speaks to, and what was received on it."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self._socket.settimeout(60)
        self.received: list[list[str]] = []

    def until(self, line: str) -> list[str]:
        """The next message that has a line which starts so."""
        while True:
            message = self._socket.recv(4096).decode().split("\n")
            self.received.append(message)
            if any(one.startswith(line) for one in message):
                return message

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    one = Manager(tmp_path / "notify")
    yield one
    one.close()


def test_from_start_to_stop(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, manager: Manager
) -> None:
    """Ready, fed watchdog, status, reload, failed reload, stop: in words that systemd understands."""
    one: DaemonProcess = daemon(divided_map.root, start=False, environment={"WATCHDOG_USEC": "600000"})
    one.process = one.spawn(notify=manager.path)
    assert manager.until("READY=1")[1:] == ["STATUS=serving 36 cells", f"MAINPID={one.pid}"]
    assert manager.received[0][0] == "READY=1"  # nothing before
    for _ in range(3):
        assert manager.until("WATCHDOG=1") == ["WATCHDOG=1"]
    connect(one).area(circle(0, 0, 5))
    until(lambda: "4 of 36 cells" in manager.until("STATUS=")[0])
    assert "1 client" in manager.received[-1][0]

    one.send(signal.SIGHUP)
    reloading = manager.until("RELOADING=1")
    assert reloading[1].removeprefix("MONOTONIC_USEC=").isdigit()
    assert manager.until("READY=1") == ["READY=1", "STATUS=map read again: 36 cells"]

    metadata = divided_map.root / "pointcloud_map_metadata.yaml"
    text = metadata.read_text()
    metadata.write_text("x_resolution: [\n")
    one.send(signal.SIGHUP)
    manager.until("RELOADING=1")
    ready = manager.until("READY=1")
    assert ready[1].startswith("STATUS=reload failed, the old map stays: ")
    metadata.write_text(text)

    one.send(signal.SIGTERM)
    assert manager.until("STOPPING=1")[0] == "STOPPING=1"


def test_a_failed_start_says_why(daemon: DaemonFactory, manager: Manager, tmp_path: Path) -> None:
    one: DaemonProcess = daemon(tmp_path / "no-map", start=False)
    process = one.spawn(notify=manager.path)
    assert "no-map" in manager.until("STATUS=")[0]
    assert process.wait(30) == 66
    assert len(manager.received) == 1


@pytest.fixture
def activated(daemon: DaemonFactory, divided_map: DividedMap) -> Iterator[DaemonProcess]:
    """Return a daemon whose socket another program made; it is not started yet."""
    one: DaemonProcess = daemon(divided_map.root, start=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(one.endpoint)
        os.chmod(one.endpoint, 0o640)
        listener.listen(128)
        one.pass_fds = (listener.fileno(),)
        one.command = [sys.executable, "-c", PASS_SOCKET, str(listener.fileno())]
        yield one
        if one.process is not None:
            assert one.stop() == 0
        os.unlink(one.endpoint)


def test_clients_wait_at_a_socket_that_was_made_for_it(activated: DaemonProcess, connect: Connect) -> None:
    """Who connects before the daemon runs, or while it restarts, is served by the one that comes."""
    made = os.stat(activated.endpoint)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as early:
        early.connect(activated.endpoint)
        activated.start()
        early.settimeout(60)
        assert early.recv(1) == b"\xff"  # ZeroMQ's greeting
    client = connect(activated)
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    before = activated.pid
    assert activated.stop() == 0
    assert os.stat(activated.endpoint).st_ino == made.st_ino
    activated.start()
    assert activated.pid != before
    client.hello()  # libzmq connected again by itself
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    now = os.stat(activated.endpoint)
    assert (now.st_ino, stat.S_IMODE(now.st_mode)) == (made.st_ino, 0o640)


def test_loaders_do_not_get_the_socket(activated: DaemonProcess, connect: Connect) -> None:
    activated.start()
    connect(activated).area(circle(0, 0, 5))
    assert activated.children()
    listening = [
        line.split()[6]
        for line in Path("/proc/net/unix").read_text().splitlines()
        if activated.endpoint in line
    ]
    assert listening
    for pid in activated.children():
        opened = [os.readlink(f"/proc/{pid}/fd/{name}") for name in os.listdir(f"/proc/{pid}/fd")]
        assert not {f"socket:[{inode}]" for inode in listening} & set(opened)
    assert activated.stop() == 0


def test_two_signals_leave_the_socket_of_another(activated: DaemonProcess) -> None:
    activated.start()
    process = activated.process
    assert process is not None
    activated.process = None
    for _ in range(2):
        process.send_signal(signal.SIGTERM)
    assert wait_ended(process.pid)
    assert process.wait(30) == 0
    assert stat.S_ISSOCK(os.stat(activated.endpoint).st_mode)


def test_an_endpoint_that_contradicts_the_socket(activated: DaemonProcess) -> None:
    activated.arguments = ["--endpoint", activated.runtime_dir + "/other.sock"]
    assert activated.run_to_end() == 78
    assert "the service manager listens at" in activated.log
