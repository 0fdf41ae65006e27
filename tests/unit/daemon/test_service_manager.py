# SPDX-License-Identifier: Apache-2.0
"""What the daemon reports to the service manager, in which order, how often; and sockets that it passes."""

from __future__ import annotations

import contextlib
import math
import os
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.daemon.service_manager import (
    EXTEND_EVERY_S,
    EXTEND_S,
    STATUS_EVERY_S,
    ServiceManager,
    asking_for_time,
    notify,
    status_line,
    take_activated_socket,
    watchdog_interval_s,
)
from shmmap.errors import ConfigError


class Sent(list[tuple[str, ...]]):
    """All lines that were sent."""

    def send(self, *lines: str) -> bool:
        self.append(lines)
        return True


def manager(environ: dict[str, str] | None = None) -> tuple[ServiceManager, Sent]:
    sent = Sent()
    return ServiceManager(environ or {}, sent.send), sent


@pytest.mark.parametrize(
    ("environ", "seconds"),
    [
        ({}, math.inf),
        ({"WATCHDOG_USEC": ""}, math.inf),
        ({"WATCHDOG_USEC": "0"}, math.inf),
        ({"WATCHDOG_USEC": "-3"}, math.inf),
        ({"WATCHDOG_USEC": "soon"}, math.inf),
        ({"WATCHDOG_USEC": "3000000"}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": ""}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 1.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}, math.inf),
    ],
)
def test_how_often_the_watchdog_is_fed(environ: dict[str, str], seconds: float) -> None:
    assert watchdog_interval_s(environ) == seconds


def test_the_watchdog_is_fed_at_beats_alone() -> None:
    one, sent = manager({"WATCHDOG_USEC": "3000000"})
    for tenths in range(31):
        one.beat(100 + tenths / 10, lambda: "")
    assert sent == [("WATCHDOG=1",)] * 4  # at 0, 1, 2 and 3 s


def test_a_status_is_sent_when_it_changes_and_not_at_each_beat() -> None:
    one, sent = manager()
    lines = iter(["a", "a", "b", "c"])
    for tenths in range(int(4 * STATUS_EVERY_S * 10)):
        one.beat(tenths / 10, lambda: next(lines))
    assert sent == [("STATUS=a",), ("STATUS=b",), ("STATUS=c",)]


def test_a_reload_is_over_when_the_last_one_is() -> None:
    one, sent = manager()
    one.reloading()
    one.beat(0, lambda: "not now")
    one.reloading()
    one.reloaded("first")
    one.reloaded("second")
    assert [lines[0] for lines in sent] == ["RELOADING=1", "RELOADING=1", "READY=1"]
    assert sent[0][1].removeprefix("MONOTONIC_USEC=").isdigit()
    one.beat(10, lambda: "afterwards")
    assert sent[-2:] == [("READY=1", "STATUS=second"), ("STATUS=afterwards",)]


def test_the_line_an_operator_reads() -> None:
    line = status_line(
        resident=212, cells=4096, used_bytes=3 << 30, budget_bytes=6 << 30, clients=5, failed=0
    )
    assert line == "212 of 4096 cells, 3.0 of 6.0 GiB, 5 clients"
    line = status_line(resident=0, cells=1, used_bytes=0, budget_bytes=64 << 20, clients=1, failed=2)
    assert line == "0 of 1 cells, 0.0 of 64.0 MiB, 1 client, 2 failed loads"


@pytest.mark.parametrize("abstract", [False, True])
def test_notify(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool) -> None:
    name = f"{tmp_path}/notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name if abstract else name)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name if abstract else name)
        notify("READY=1", "STATUS=serving 5 cells of a\nMAINPID=1")
        manager.settimeout(10)
        assert manager.recv(100) == b"READY=1\nSTATUS=serving 5 cells of a MAINPID=1"


def test_a_manager_that_reads_nothing_holds_nothing_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its queue takes a few datagrams; what changed the state is sent once it reads again, in order."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as reader:
        reader.bind(f"{tmp_path}/notify")
        reader.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", f"{tmp_path}/notify")
        one = ServiceManager({"WATCHDOG_USEC": "3000000"})
        one.ready("serving")
        for second in range(10_000):
            one.beat(float(second), lambda second=second: f"at {second}")  # type: ignore[misc]
        for number in range(20):
            one.reloading()
            one.reloaded(f"reload {number}")

        def read() -> list[bytes]:
            found = []
            with contextlib.suppress(BlockingIOError):
                while True:
                    found.append(reader.recv(200))
            return found

        before = read()
        assert before[0].startswith(b"READY=1\nSTATUS=serving\n")
        assert len(before) < 2000
        after: list[bytes] = []
        for _ in range(20):
            one.beat(20_000.0, lambda: "now")
            after += read()
        assert len(after) == 10
        assert after[-3:] == [b"READY=1\nSTATUS=reload 19", b"WATCHDOG=1", b"STATUS=now"]


@pytest.mark.parametrize("address", ["", "/nowhere/notify", "@no-such-socket", "relative", "@" + "x" * 300])
def test_no_service_manager_listens(monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("READY=1")


def test_it_asks_while_it_lasts() -> None:
    sent: list[tuple[str, ...]] = []
    twice = threading.Event()

    def send(*lines: str) -> bool:
        sent.append(lines)
        if len(sent) == 2:
            twice.set()
        return True

    with asking_for_time(send, "reading the map", every_s=0.0):
        assert twice.wait(60.0)
    count = len(sent)
    assert set(sent) == {("STATUS=reading the map", "EXTEND_TIMEOUT_USEC=60000000")}
    assert EXTEND_EVERY_S < EXTEND_S / 2
    assert threading.active_count() == 1 or all(t.name != "more time" for t in threading.enumerate())
    assert len(sent) == count


def test_what_hangs_gets_no_more_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmmap.daemon.service_manager.MAX_START_S", -1.0)
    sent = Sent()
    with asking_for_time(sent.send, "reading the map", every_s=0.0):
        for thread in threading.enumerate():
            if thread.name == "more time":
                thread.join(60.0)
                assert not thread.is_alive()
    assert not sent


FIRST = 200
"""Where this test passes descriptors: 3 is taken here."""


def environment(count: int = 1, pid: int | None = None) -> dict[str, str]:
    return {"LISTEN_PID": str(pid or os.getpid()), "LISTEN_FDS": str(count), "LISTEN_FDNAMES": "a", "X": "y"}


@pytest.fixture
def passed() -> Iterator[Callable[[socket.socket], int]]:
    """Pass sockets as a service manager does: descriptors in a row, inheritable."""
    numbers: list[int] = []

    def give(one: socket.socket) -> int:
        with one:
            numbers.append(os.dup2(one.fileno(), FIRST + len(numbers), inheritable=True))
        return numbers[-1]

    yield give
    for number in numbers:
        os.close(number)


def listening(path: Path) -> socket.socket:
    one = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    one.bind(str(path))
    one.listen()
    return one


def test_a_socket_is_taken_once(tmp_path: Path, passed: Callable[[socket.socket], int]) -> None:
    fd = passed(listening(tmp_path / "s"))
    environ = environment()
    taken = take_activated_socket(environ, first_fd=FIRST)
    assert taken == (fd, str(tmp_path / "s"))
    assert not os.get_inheritable(fd)
    assert not os.get_blocking(fd)
    assert environ == {"X": "y"}
    assert take_activated_socket(environ, first_fd=FIRST) is None


@pytest.mark.parametrize("environ", [{}, environment(0), environment(1, pid=1), {"LISTEN_FDS": "1"}])
def test_nothing_was_passed_to_this_process(environ: dict[str, str]) -> None:
    assert take_activated_socket(environ, first_fd=FIRST) is None
    assert not any(name.startswith("LISTEN_") for name in environ)


def test_two_sockets(tmp_path: Path, passed: Callable[[socket.socket], int]) -> None:
    for name in "ab":
        passed(listening(tmp_path / name))
    with pytest.raises(ConfigError, match="2 sockets were passed") as failure:
        take_activated_socket(environment(2), first_fd=FIRST)
    assert "ListenStream=" in failure.value.hint


def bound(kind: int, name: str | bytes) -> socket.socket:
    one = socket.socket(socket.AF_UNIX, kind)
    one.bind(name)
    return one


def test_sockets_of_other_kinds(tmp_path: Path, passed: Callable[[socket.socket], int]) -> None:
    abstract = bound(socket.SOCK_STREAM, b"\0shmmap-test-" + os.urandom(8))
    abstract.listen()
    network = socket.create_server(("127.0.0.1", 0))
    sockets = [
        (bound(socket.SOCK_DGRAM, str(tmp_path / "d")), "no listening unix stream socket"),
        (bound(socket.SOCK_STREAM, str(tmp_path / "n")), "no listening unix stream socket"),
        (network, "no listening unix stream socket"),
        (abstract, "has no path"),
    ]
    for offset, (one, why) in enumerate(sockets):
        passed(one)
        with pytest.raises(ConfigError, match=why):
            take_activated_socket(environment(), first_fd=FIRST + offset)


def test_a_descriptor_that_is_no_socket(tmp_path: Path) -> None:
    with (tmp_path / "file").open("wb") as file:
        os.dup2(file.fileno(), FIRST)
    try:
        with pytest.raises(ConfigError, match="is no socket"):
            take_activated_socket(environment(), first_fd=FIRST)
    finally:
        os.close(FIRST)
