# SPDX-License-Identifier: Apache-2.0
"""Sockets that a service manager passes, good and bad."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.daemon.service_manager.socket_activation import take_activated_socket
from shmmap.errors import ConfigError

FIRST = 200
"""Where this test passes descriptors: 3 is somebody else's here."""


def environment(count: int = 1, pid: int | None = None) -> dict[str, str]:
    return {"LISTEN_PID": str(pid or os.getpid()), "LISTEN_FDS": str(count), "LISTEN_FDNAMES": "a", "X": "y"}


@pytest.fixture
def passed() -> Iterator[Callable[[socket.socket], int]]:
    """Pass sockets the way a service manager does: descriptors in a row, inheritable."""
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
