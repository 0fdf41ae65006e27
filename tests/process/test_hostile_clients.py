# SPDX-License-Identifier: Apache-2.0
"""Clients that flood, never listen, lie about sizes or die in the middle: others notice nothing."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import zmq

from tests.process.conftest import DaemonFactory
from tests.support.daemon_process import DaemonProcess, Deadline, wait_ended
from tests.support.divided_map import DividedMap
from tests.support.message_pack import pack
from tests.support.process_costs import descriptors, peak_bytes, resident_bytes
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


def test_a_frame_larger_than_any_request(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """The socket itself ends the connection: the daemon never holds those bytes."""
    one = daemon(divided_map.root)
    client = connect(one)
    before = peak_bytes(one.pid)
    big = connect(one)
    big.send_bytes(bytes(100_000_000))
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert peak_bytes(one.pid) - before < 16 << 20


def test_a_flood_that_never_listens(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client, deaf = connect(one), connect(one)
    client.area(circle(0, 0, 60))
    before = resident_bytes(one.pid)
    request = pack(["area", 1, circle(0, 0, 60), ["points"], 10.0])
    deaf.socket.setsockopt(zmq.SNDTIMEO, 0)
    sent = 0
    for number in range(20_000):
        try:
            deaf.send_bytes(request)
            sent += 1
        except zmq.Again:
            pass
        if number % 1000 == 0:
            assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert sent > 1000
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert resident_bytes(one.pid) - before < 64 << 20


def test_many_frames_and_no_frames(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.socket.send_multipart([b"", pack(["stats", 1])])
    assert client.receive()[0] == "error"
    client.socket.send_multipart([pack(["stats", 1])] * 50)
    assert client.receive()[0] == "error"
    assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_bytes_that_are_no_zeromq(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 5))
    rng = random.Random(4)
    before = descriptors(one.pid)
    for _ in range(20):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
            stranger.connect(one.endpoint)
            stranger.send(rng.randbytes(rng.randrange(1, 500)))
    for _ in range(50):
        assert len(client.area(circle(0, 0, 5)).cells) == 4
    waiting = Deadline()
    while waiting(descriptors(one.pid) > before):
        client.ask("stats")


def test_random_messages(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    """Well-formed MessagePack of the wrong shapes; every one is answered, none does harm."""
    one = daemon(divided_map.root)
    client = connect(one)
    rng = random.Random(6)
    tags = ["area", "differential", "selected", "metadata", "release", "show", "hello", "stats", "x"]
    values: list[Any] = [
        None, True, -1, 0, 2**63, 2**64 - 1, 0.5, float("nan"), float("inf"), "", "points", "0_0.pcd",
        b"", bytes(8), bytes(9), [], ["points"], [["0_0.pcd", 5]], [["0_0.pcd", None, ["x"]]],
        circle(0, 0, 5), ["circle", 1], ["box", 0, 0, 1e308, 1e308], {}, {"a": 1}, [[[[]]]],
    ]  # fmt: skip
    for number in range(1, 1500):
        tag = rng.choice(tags)
        client.send_bytes(pack([tag, number, *(rng.choice(values) for _ in range(rng.randrange(7)))]))
        reply = client.receive()
        assert reply[1] == number
        assert reply[0] != "error" or reply[2] != "internal", (reply, one.log[-2000:])
    assert "defect" not in one.log
    fresh = connect(one)
    assert len(fresh.area(circle(0, 0, 5)).cells) == 4


_CLIENT = """
import sys
from tests.support.raw_client import RawClient, circle
client = RawClient(sys.argv[1])
client.send("area", circle(0, 0, 500), ["points"], 600.0)
client.ask("stats")
print("asked", flush=True)
sys.stdin.read()
"""


def ask_and_wait(one: DaemonProcess) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-c", _CLIENT, one.endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"asked\n"
    return process


def test_clients_that_die_are_forgotten(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Sessions end with their process, not with a timer; a stopped one is still there."""
    one = daemon(divided_map.root)
    client = connect(one)
    client.area(circle(0, 0, 500))
    before = descriptors(one.pid)
    dying = [ask_and_wait(one) for _ in range(4)]
    os.kill(dying[0].pid, signal.SIGSTOP)
    assert len(client.ask("stats")[5]) == 5
    for process in dying[1:]:
        process.kill()
        process.communicate()
    waiting = Deadline()
    while waiting(len(client.ask("stats")[5]) > 2):
        pass
    for _ in range(20):
        assert len(client.ask("stats")[5]) == 2  # the stopped one is not reaped
    dying[0].kill()
    dying[0].communicate()
    waiting = Deadline()
    while waiting(len(client.ask("stats")[5]) > 1):
        pass
    waiting = Deadline()
    while waiting(descriptors(one.pid) > before):
        client.ask("stats")


def test_sessions_come_and_go_without_a_trace(
    daemon: DaemonFactory, connect: Connect, divided_map: DividedMap
) -> None:
    """Loads, evictions, reloads, sessions: the daemon's descriptors and loaders are the same after."""
    one = daemon(divided_map.root, "--workers", "2")
    client = connect(one)

    def busy() -> None:
        for number in range(12):
            with RawClient(one.endpoint) as visitor:
                assert len(visitor.area(circle(0, 0, 500)).cells) == 36
                visitor.send("bye")
            client.ask("evict")
            if number % 4 == 0:
                client.ask("reload")
        waiting = Deadline()
        while waiting(bool(one.segments()) or len(client.ask("stats")[5]) > 1):
            client.ask("stats")

    busy()
    before, loaders = descriptors(one.pid), one.children()
    busy()
    waiting = Deadline()
    while waiting(descriptors(one.pid) > before):
        client.ask("stats")
    assert one.children() == loaders


def test_two_signals_end_it_at_once(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one = daemon(divided_map.root)
    connect(one).area(circle(0, 0, 60))
    pid = one.pid
    one.send(signal.SIGTERM)
    one.send(signal.SIGTERM)
    assert wait_ended(pid)
    assert one.process is not None
    process, one.process = one.process, None
    assert process.wait() == 0
    assert one.leftovers() == []
