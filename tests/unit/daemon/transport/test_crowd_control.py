# SPDX-License-Identifier: Apache-2.0
"""Who loses connections when descriptors or memory run out, on real connections of two processes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from shmmap.daemon.transport import crowd_control
from shmmap.daemon.transport.crowd_control import LEAST_SHARE, MEMORY_ALLOWANCE_BYTES, CrowdControl
from shmmap.daemon.transport.listen_gate import ListenGate
from shmmap.daemon.transport.own_sockets import open_descriptors
from tests.unit.daemon.router import Router, census

MINE, OTHERS = 12, 3
_OTHER = """
import socket, sys
held = [socket.socket(socket.AF_UNIX) for _ in range(int(sys.argv[2]))]
for one in held:
    one.connect(sys.argv[1])
    one.recv(10)
print("in", flush=True)
sys.stdin.read()
"""


class Crowd:
    """Twelve connections of this process, three of another one, and their control."""

    def __init__(self, router: Router) -> None:
        self.router = router
        for _ in range(MINE):
            router.connect()
            router.hear()
        self.other = subprocess.Popen(
            [sys.executable, "-c", _OTHER, router.path, str(OTHERS)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self.other.stdout is not None
        assert self.other.stdout.readline() == b"in\n"
        self.gate = ListenGate(router.watch, router.unwatch)
        self.gate.close_behind()
        self.unread: dict[int, int] = {}
        self.with_session: list[int] = []
        self.control = CrowdControl(
            self.gate,
            waiting_bytes=dict,
            unread_bytes=lambda: self.unread,
            session_descriptors=lambda: self.with_session,
        )

    def act(self, now_s: float) -> None:
        """One beat and all that follows from it."""
        self.control.beat(now_s)
        while not self.control.idle:
            self.control.step()

    def wait_for(self, mine: int, others: int) -> None:
        """Until libzmq has closed what was ended."""
        expected = {pid: n for pid, n in ((os.getpid(), mine), (self.other.pid, others)) if n}
        while {pid: len(fds) for pid, fds in census(self.router).items()} != expected:
            pass


@pytest.fixture
def crowd(router: Router) -> Iterator[Crowd]:
    one = Crowd(router)
    yield one
    one.gate.release()
    one.other.kill()
    one.other.communicate()


def test_nothing_happens_while_there_is_enough(crowd: Crowd) -> None:
    crowd.control.begin()
    crowd.act(1.0)
    assert crowd.control.ended == 0
    crowd.wait_for(MINE, OTHERS)


def test_short_of_descriptors(crowd: Crowd, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has most keeps a share, those with a session before all others."""
    crowd.control.begin()
    mine = census(crowd.router)[os.getpid()]
    crowd.with_session = mine[:LEAST_SHARE]
    used = len(open_descriptors())
    monkeypatch.setattr("resource.getrlimit", lambda _: (used + 10, used + 10))
    crowd.gate.short = True
    for fd in list(crowd.router.callbacks):
        crowd.router.unwatch(fd)
    crowd.act(1.0)
    assert crowd.control.ended == MINE - LEAST_SHARE
    crowd.wait_for(LEAST_SHARE, OTHERS)
    assert sorted(census(crowd.router)[os.getpid()]) == sorted(crowd.with_session)
    crowd.act(2.0)
    assert crowd.control.ended == MINE - LEAST_SHARE  # an equal share for everybody is nobody's fault


def test_short_of_memory(crowd: Crowd, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who takes most loses all; nobody does where it is no client's doing."""
    used = 100 << 20
    monkeypatch.setattr(crowd_control, "memory_bytes", lambda: used)
    crowd.control.begin()
    used += MEMORY_ALLOWANCE_BYTES + 1
    crowd.unread = {crowd.other.pid: 1 << 16}
    crowd.act(1.0)
    nobody = crowd.control.ended
    used += MEMORY_ALLOWANCE_BYTES + 1
    crowd.unread = {crowd.other.pid: 64 << 20}
    crowd.act(2.0)
    assert (nobody, crowd.control.ended) == (0, OTHERS)
    crowd.wait_for(MINE, 0)
