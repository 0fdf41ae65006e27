# SPDX-License-Identifier: Apache-2.0
"""Looking at libzmq's own connections, on a real ROUTER in this process; and the gate before them."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from shmmap.daemon.transport.connections import end_connection, unread_bytes
from shmmap.daemon.transport.listen_gate import ListenGate
from shmmap.daemon.transport.own_sockets import listens, looked_at, open_descriptors
from tests.unit.daemon.router import WAIT_MS, Router, census


def test_a_look_leaves_no_descriptor_behind() -> None:
    reading, writing = os.pipe()
    before = len(open_descriptors())
    with pytest.raises(OSError, match="socket"), looked_at(reading):
        pass
    with pytest.raises(OSError, match="descriptor"), looked_at(10**6):
        pass
    assert len(open_descriptors()) == before
    os.close(reading)
    os.close(writing)


def test_whose_connection_and_the_end_of_it(router: Router) -> None:
    router.connect()
    fd = router.hear()
    me = os.getpid()
    assert unread_bytes(fd, me, [router.path]) == 0
    assert unread_bytes(fd, me + 1, [router.path]) is None  # another process's
    assert unread_bytes(fd, me, ["/elsewhere"]) is None
    assert not end_connection(fd, me + 1, [router.path])
    listening = [n for n in open_descriptors() if listens(n)]
    assert all(not end_connection(n, me, [router.path]) for n in listening)
    assert not end_connection(10**6, me, [router.path])
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(router.path)
        stranger.settimeout(WAIT_MS / 1000)
        assert stranger.recv(10)  # it is accepted: libzmq greets
        (other,) = {*census(router)[me]} - {fd}
        assert end_connection(other, me, [router.path])
        while stranger.recv(4096):
            pass
    assert unread_bytes(fd, me, [router.path]) == 0  # that one lives


def test_a_census(router: Router) -> None:
    for _ in range(3):
        router.connect()
        router.hear()
    assert {pid: len(fds) for pid, fds in census(router).items()} == {os.getpid(): 3}


def test_the_gate_lets_in_one_by_one(router: Router) -> None:
    """Nobody is accepted unless the loop says so, and then one."""
    gate = ListenGate(router.watch, router.unwatch)
    gate.close_behind()
    assert gate.paths == {router.path}
    knocking = [socket.socket(socket.AF_UNIX) for _ in range(3)]
    for one in knocking:
        one.connect(router.path)
    assert len(router.epoll.poll(WAIT_MS / 1000)) == 1

    def accepted() -> int:
        return sum(map(len, census(router).values()))

    assert accepted() == 0
    for number in (1, 2, 3):
        ((fd, _),) = router.epoll.poll(WAIT_MS / 1000)
        router.callbacks[fd]()
        while accepted() < number:
            pass
        assert accepted() == number
    assert router.epoll.poll(0) == []
    for one in knocking:
        one.close()
    gate.release()
    assert router.callbacks == {}


def test_the_gate_stays_shut_without_descriptors(router: Router, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = ListenGate(router.watch, router.unwatch)
    gate.close_behind()
    used = len(open_descriptors())
    monkeypatch.setattr("resource.getrlimit", lambda _: (used + 20, used + 20))
    with socket.socket(socket.AF_UNIX) as one:
        one.connect(router.path)
        ((fd, _),) = router.epoll.poll(WAIT_MS / 1000)
        router.callbacks[fd]()
        states = [gate.short]
        assert router.callbacks == {}
        gate.look_again(1e12)
        states.append(gate.short)
        monkeypatch.setattr("resource.getrlimit", lambda _: (used + 2000, used + 2000))
        gate.look_again(2e12)
        assert [*states, gate.short] == [True, True, False]
        assert set(router.callbacks) == {fd}
    gate.release()
    assert Path(router.path).exists()
