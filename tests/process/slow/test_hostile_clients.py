# SPDX-License-Identifier: Apache-2.0
"""Clients that flood, lie, take all descriptors, memory or locks, or die: others notice nothing."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import sys
from collections.abc import Callable
from typing import Any

import pytest
import zmq

from tests.process.conftest import DaemonFactory
from tests.support.accounts import GROUP, MEMBER, python_for_others
from tests.support.daemon_process import DaemonProcess, LineProcess, until
from tests.support.divided_map import DividedMap
from tests.support.message_pack import pack
from tests.support.process_costs import descriptors, peak_bytes, resident_bytes
from tests.support.raw_client import RawClient, circle

Connect = Callable[..., RawClient]


def test_a_frame_larger_than_any_request(served: DaemonProcess, client: RawClient, connect: Connect) -> None:
    """The socket itself ends the connection: the daemon never holds those bytes."""
    before = peak_bytes(served.pid)
    big = connect(served)
    big.send_bytes(bytes(100_000_000))
    assert len(client.area(circle(0, 0, 5)).cells) == 4
    assert peak_bytes(served.pid) - before < 16 << 20


def test_a_flood_that_never_listens(served: DaemonProcess, connect: Connect) -> None:
    client, deaf = connect(served), connect(served)
    client.area(circle(0, 0, 60))
    before = resident_bytes(served.pid)
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
    assert resident_bytes(served.pid) - before < 64 << 20


def test_many_frames_and_no_frames(served: DaemonProcess, client: RawClient) -> None:
    client.socket.send_multipart([b"", pack(["stats", 1])])
    assert client.receive()[0] == "error"
    client.socket.send_multipart([pack(["stats", 1])] * 50)
    assert client.receive()[0] == "error"
    assert len(client.area(circle(0, 0, 5)).cells) == 4


def test_bytes_that_are_no_zeromq(served: DaemonProcess, client: RawClient) -> None:
    client.area(circle(0, 0, 5))
    rng = random.Random(4)
    before = descriptors(served.pid)
    for _ in range(20):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
            other.connect(served.endpoint)
            other.send(rng.randbytes(rng.randrange(1, 500)))
    for _ in range(50):
        assert len(client.area(circle(0, 0, 5)).cells) == 4
    until(lambda: descriptors(served.pid) <= before)


def test_random_messages(served: DaemonProcess, client: RawClient, connect: Connect) -> None:
    """Well-formed MessagePack of the wrong shapes; every one is answered, none does harm."""
    rng = random.Random(6)
    tags = ["area", "differential", "selected", "metadata", "release", "show", "hello", "stats", "x"]
    values: list[Any] = [
        None,
        True,
        -1,
        0,
        2**63,
        2**64 - 1,
        0.5,
        float("nan"),
        float("inf"),
        "",
        "points",
        "0_0.pcd",
        b"",
        bytes(8),
        bytes(9),
        [],
        ["points"],
        [["0_0.pcd", 5]],
        [["0_0.pcd", None, ["x"]]],
        circle(0, 0, 5),
        ["circle", 1],
        ["box", 0, 0, 1e308, 1e308],
        {},
        {"a": 1},
        [[[[]]]],
    ]
    for number in range(1, 1500):
        tag = rng.choice(tags)
        client.send_bytes(pack([tag, number, *(rng.choice(values) for _ in range(rng.randrange(7)))]))
        reply = client.receive()
        assert reply[1] == number
        assert reply[0] != "error" or reply[2] != "internal", (reply, served.log[-2000:])
    assert "defect" not in served.log
    fresh = connect(served)
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


def ask_and_wait(one: DaemonProcess) -> LineProcess:
    process = LineProcess(sys.executable, "-c", _CLIENT, one.endpoint)
    assert process.read() == "asked"
    return process


def test_clients_that_die_are_forgotten(served: DaemonProcess, client: RawClient) -> None:
    """Sessions end with their process, not with a timer; a stopped one is still there."""
    client.area(circle(0, 0, 500))
    before = descriptors(served.pid)
    dying = [ask_and_wait(served) for _ in range(4)]
    os.kill(dying[0].pid, signal.SIGSTOP)
    assert len(client.ask("stats")[5]) == 5
    for process in dying[1:]:
        process.kill()
    until(lambda: len(client.ask("stats")[5]) <= 2)
    for _ in range(20):
        assert len(client.ask("stats")[5]) == 2  # the stopped one is not reaped
    dying[0].kill()
    until(lambda: len(client.ask("stats")[5]) <= 1)
    until(lambda: descriptors(served.pid) <= before)


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
        until(lambda: not one.segments() and len(client.ask("stats")[5]) <= 1)

    busy()
    before, loaders = descriptors(one.pid), one.children()
    busy()
    until(lambda: descriptors(one.pid) <= before)
    assert one.children() == loaders


# --- clients that take all descriptors or memory: they lose their connections, others notice nothing -

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


def hostile(one: DaemonProcess, program: str) -> LineProcess:
    """Run a hostile program until it says that it is done; it then stays as it is."""
    return LineProcess(sys.executable, "-c", _PRELUDE + program, one.endpoint)


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
        assert process.read() == "done"
        serves(client)
        assert descriptors(one.pid) < LIMIT
        serves(connect(one))
        assert f"connections ended pid={process.pid} count=" in one.log
        serves(client)
    until(lambda: descriptors(one.pid) <= LIMIT // 2)


def test_more_sessions_than_there_may_be(served: DaemonProcess, client: RawClient, connect: Connect) -> None:
    """One process opens session after session on new connections: it displaces its own."""
    serves(client)
    program = """
context = zmq.Context()
for number in range(4200):
    one = context.socket(zmq.DEALER)
    one.linger = 0
    one.connect("ipc://" + path)
    one.send(pack(["hello", 1, 3, 0, "crowd"]))
    assert one.poll(60000)
    one.close()
done()
"""
    with hostile(served, program) as process:
        assert process.read() == "done"
        serves(client)
        serves(connect(served))
        assert "sessions already" not in served.log
    until(lambda: len(client.ask("stats")[5]) <= 2)


def test_replies_that_are_never_read(served: DaemonProcess, client: RawClient) -> None:
    client.area(circle(0, 0, 500))
    before = resident_bytes(served.pid)
    program = """
one = zmtp()
one.settimeout(20.0)
def send(message):
    body = pack(message)
    one.sendall(b"\\x02" + struct.pack(">Q", len(body)) + body)
send(["hello", 1, 3, 0, "deaf"])
names = ["0_0.pcd"] * 128
try:
    while True:
        send(["selected", 1, names, ["points"], None])
except OSError:
    done("ended")
"""
    with hostile(served, program) as process:
        assert process.read() == "ended"
        serves(client)
        assert f'connections ended pid={process.pid} count=1 reason="it left' in served.log
    assert resident_bytes(served.pid) - before < 96 << 20


def test_a_message_that_never_ends(served: DaemonProcess, client: RawClient) -> None:
    """Frame after frame, each small enough: libzmq keeps them all until the last one comes."""
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
    with hostile(served, program) as process:
        assert process.read() == "ended"
        serves(client)
        assert f"connections ended pid={process.pid} count=" in served.log
        assert "it made the daemon take too much memory" in served.log
    until(lambda: resident_bytes(served.pid) <= 400 << 20)


def test_a_process_that_asks_too_much_at_once(served: DaemonProcess, client: RawClient) -> None:
    """What waits beyond the limit is refused; the refusal says so, and later requests are served.

    All replies together are fewer, and less, than what the daemon keeps for a client that does not read.
    """
    serves(client)
    body = [client.send("selected", ["0_0.pcd"] * 128, ["points"], None) for _ in range(200)]
    kinds = [client.receive() for _ in body]
    refused = [reply for reply in kinds if reply[0] == "error"]
    assert all(reply[2] == "busy" for reply in refused)
    assert sorted(reply[1] for reply in kinds) == body
    serves(client)


# --- a member of the group takes every lock there is on everything it can open: others do not notice --


_LOCKS = """
import fcntl, json, os, struct, sys
found = {"locked": 0, "refused": []}
held = []

def attempt(what, action):
    try:
        return action()
    except OSError:
        found["refused"].append(what)

for directory in sys.argv[1:]:
    for name in sorted(os.listdir(directory)):
        path = directory + "/" + name
        if name.endswith((".sock", ".txt")) or os.path.isdir(path):
            continue
        fd = attempt("open " + name.rpartition(".")[2], lambda: os.open(path, os.O_RDONLY))
        if fd is None:
            continue
        held.append(fd)
        fcntl.flock(fd, fcntl.LOCK_EX)
        attempt("lease", lambda: fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_RDLCK))
        attempt("write lock", lambda: fcntl.fcntl(fd, 37, struct.pack("@hhqqi4x", fcntl.F_WRLCK, 0, 0, 0, 0)))
        for at in range(0, 3000, 3):  # two bytes each and a gap, or the kernel joins them
            lock = struct.pack("@hhqqi4x", fcntl.F_RDLCK, 0, at, 2, 0)
            attempt("read lock of " + name.rpartition(".")[2], lambda: fcntl.fcntl(fd, 37, lock))
        found["locked"] += 1
found["refused"] = sorted(set(found["refused"]))
print(json.dumps(found), flush=True)
sys.stdin.read()
"""


def member_with_locks(one: DaemonProcess) -> LineProcess:
    """Run the member; it prints what it got."""
    account = ["setpriv", f"--reuid={MEMBER}", f"--regid={GROUP}", "--clear-groups", "--inh-caps=-all"]
    return LineProcess(*account, python_for_others(), "-I", "-c", _LOCKS, one.shm_dir, one.runtime_dir)


@pytest.mark.root
def test_locks_hold_up_no_client(daemon: DaemonFactory, connect: Connect, divided_map: DividedMap) -> None:
    one: DaemonProcess = daemon(divided_map.root, "--group", str(GROUP), start=False)
    os.chmod(one.runtime_dir, 0o755)
    os.chmod(one.shm_dir, 0o1777)
    one.start()
    client = connect(one)
    assert len(client.area(circle(0, 0, 500)).cells) == 36
    with member_with_locks(one) as member:
        found = json.loads(member.read())
        assert found["locked"] == 36 + 1  # the segments and the statistics; no lock file of the daemon's
        # of the statistics the daemon has a lock itself
        assert found["refused"] == ["lease", "open lock", "read lock of statistics", "write lock"]
        stats = client.ask("stats")
        assert stats[6] == 36  # mapped by unknown processes
        assert client.ask("show", "0_0.pcd")[9][0][12][0][:2] == [0, 0]
        evicted = client.ask("evict")
        assert (evicted[2], evicted[3]) == (0, 36)
        assert len(client.area(circle(0, 0, 500)).cells) == 36  # revived: it is all there still
        one.kill()
        one.start()
        again = connect(one)
        assert len(again.area(circle(0, 0, 500)).cells) == 36
        assert again.ask("evict")[2:4] == [0, 36]
    one.until_segments(0, lambda: again.ask("stats"))
