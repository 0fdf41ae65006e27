# SPDX-License-Identifier: Apache-2.0
"""Clients that take all descriptors or memory: they lose their connections, others notice nothing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.divided_map import DividedMap
from tests.support.patience import Patience
from tests.support.process_costs import descriptors, resident_bytes
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]
LIMIT = 160

_PRELUDE = """
import socket, struct, sys, zmq
from tests.support.raw_client import RawClient, circle
from tests.support.message_pack import pack
path = sys.argv[1]

def connection():
    one = socket.socket(socket.AF_UNIX)
    one.connect(path)
    return one

def zmtp():
    # what a DEALER says first, by hand: greeting (ZMTP 3.0, NULL), READY
    one = connection()
    one.sendall(b"\\xff" + bytes(8) + b"\\x7f\\x03\\x00NULL" + bytes(16 + 32))
    body = b"\\x05READY\\x0bSocket-Type\\0\\0\\0\\6DEALER\\x08Identity\\0\\0\\0\\0"
    one.sendall(b"\\x04" + bytes([len(body)]) + body)
    answer = 64 + 2 + len(body)
    while answer:  # nothing may be sent before the other side's READY
        answer -= len(one.recv(answer))
    return one

def done(word="done"):
    print(word, flush=True)
    sys.stdin.read()
"""


@contextmanager
def hostile(one: DaemonProcess, program: str) -> Iterator[subprocess.Popen[str]]:
    """Run a hostile program until it says that it is done; it then stays as it is."""
    process = subprocess.Popen(
        [sys.executable, "-c", _PRELUDE + program, one.endpoint],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def said(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def serves(client: RawClient) -> None:
    for _ in range(20):
        assert len(client.area(circle(0, 0, 5)).cells) == 4


CROWDS = {
    "that say nothing": """
held = []
try:
    for number in range(2000):
        one = socket.socket(socket.AF_UNIX)
        one.settimeout(1.0)
        one.connect(path)
        held.append(one)
except OSError:
    pass
done()
""",
    "with sessions": """
held = []
try:
    for number in range(150):
        held.append(RawClient(path, timeout=1.0))
except TimeoutError:
    pass
done()
""",
}


@pytest.mark.parametrize("crowd", CROWDS)
def test_more_connections_than_descriptors(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap, crowd: str
) -> None:
    """libzmq would abort on the first ``accept`` without a descriptor; newcomers still get in."""
    one = daemon(divided_map.root, command=["prlimit", f"--nofile={LIMIT}:{LIMIT}"])
    client = connect(one)
    serves(client)
    with hostile(one, CROWDS[crowd]) as process:
        assert said(process) == "done"
        serves(client)
        assert descriptors(one.pid) < LIMIT
        serves(connect(one))
        assert f"connections ended pid={process.pid} count=" in one.log
        serves(client)
    waiting = Patience()
    while waiting(descriptors(one.pid) > LIMIT // 2):
        client.ask("stats")


def test_more_sessions_than_there_may_be(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """One process opens session after session on new connections: it displaces its own."""
    one = daemon(divided_map.root)
    client = connect(one)
    serves(client)
    program = """
context = zmq.Context()
for number in range(4200):
    one = context.socket(zmq.DEALER)
    one.linger = 0
    one.connect("ipc://" + path)
    one.send(pack(["hello", 1, 2, 0, "crowd"]))
    assert one.poll(60000)
    one.close()
done()
"""
    with hostile(one, program) as process:
        assert said(process) == "done"
        serves(client)
        serves(connect(one))
        assert "sessions already" not in one.log
    waiting = Patience()
    while waiting(len(client.ask("stats")[5]) > 2):
        pass


def test_replies_that_nobody_reads(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 500))
    before = resident_bytes(one.pid)
    program = """
one = zmtp()
one.settimeout(20.0)
def send(message):
    body = pack(message)
    one.sendall(b"\\x02" + struct.pack(">Q", len(body)) + body)
send(["hello", 1, 2, 0, "deaf"])
names = ["0_0.pcd"] * 3000
try:
    while True:
        send(["selected", 1, names, ["points"], None])
except OSError:
    done("ended")
"""
    with hostile(one, program) as process:
        assert said(process) == "ended"
        serves(client)
        assert f'connections ended pid={process.pid} count=1 reason="it left' in one.log
    assert resident_bytes(one.pid) - before < 96 << 20


def test_a_message_that_never_ends(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Frame after frame, each small enough: libzmq keeps them all until the last one comes."""
    one = daemon(divided_map.root)
    client = connect(one)
    serves(client)
    program = """
one = zmtp()
one.settimeout(60.0)
frame = b"\\x03" + struct.pack(">Q", 1 << 20) + bytes(1 << 20)  # long frame, more to come
try:
    while True:
        one.sendall(frame)
except OSError:
    done("ended")
"""
    with hostile(one, program) as process:
        assert said(process) == "ended"
        serves(client)
        assert f"connections ended pid={process.pid} count=" in one.log
        assert "it made the daemon take too much memory" in one.log
    waiting = Patience()
    while waiting(resident_bytes(one.pid) > 400 << 20):
        client.ask("stats")


def test_a_process_that_asks_too_much_at_once(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """What waits beyond the limit is refused; the refusal says so, and later requests are served.

    All replies together are fewer, and less, than what the daemon keeps for a client that does not read.
    """
    one = daemon(divided_map.root)
    client = connect(one)
    serves(client)
    body = [client.send("selected", ["0_0.pcd"] * 500, ["points"], None) for _ in range(200)]
    kinds = [client.receive() for _ in body]
    refused = [reply for reply in kinds if reply[0] == "error"]
    assert all(reply[2] == "busy" for reply in refused)
    assert sorted(reply[1] for reply in kinds) == body
    serves(client)
