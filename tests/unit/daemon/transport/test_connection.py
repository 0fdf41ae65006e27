# SPDX-License-Identifier: Apache-2.0
"""Connections of libzmq and of raw sockets: whose they are, what is kept for them, and which are ended."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from typing import Any, cast

import pytest
import zmq

from shmmap.daemon.events.log import REMEMBERED, EventLog
from shmmap.daemon.transport.connection import (
    FRAMES_PER_TURN,
    MAX_UNREAD_BYTES,
    MAX_WAITING,
    MEMORY_ALLOWANCE_BYTES,
    MIN_SHARE,
    READ_BYTES,
    Connection,
    Connections,
    Listener,
    Peer,
)
from shmmap.daemon.transport.inbox import Inbox
from shmmap.daemon.transport.socket_file import SocketFile
from shmmap.daemon.transport.zmtp import GREETING, framed
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import Busy
from shmmap.protocol.codec import decode_reply
from shmmap.protocol.events import Changed, decode_event
from shmmap.statistics.writer import StatisticsWriter
from tests.support.daemon_process import Deadline

LONGEST = 1 << 20
_READER = """
import socket
one, total = socket.socket(fileno=0), 0
while data := one.recv(1 << 16):
    total += len(data)
print(total)
"""
READY = framed(b"\x05READY\x0bSocket-Type\0\0\0\x06DEALER\x08Identity\0\0\0\0", 4)
_OTHER = """
import socket, sys
held = [socket.socket(socket.AF_UNIX) for _ in range(int(sys.argv[2]))]
for one in held:
    one.connect(sys.argv[1])
print("in", flush=True)
sys.stdin.read()
"""


class Counts(Counter[str]):
    """What connections add to the statistics."""

    def add(self, name: str, value: int = 1) -> None:
        self[name] += value


class Loop:
    """A listener and the turns of a loop; keeps what is received."""

    def __init__(self, directory: str) -> None:
        self.path = f"{directory}/s.sock"
        self.watched = WatchedDescriptors()
        self.connections = Connections()
        self.counts = Counts()
        self.received: list[tuple[Connection, bytes, bool]] = []
        self.ended: list[Connection] = []
        self.socket = SocketFile(self.path, -1).socket
        self.context: zmq.Context[Any] = zmq.Context()
        self.held: list[socket.socket] = []
        self.listener = Listener(
            self.socket, self.watched, self.connections, cast("StatisticsWriter", self.counts), b"ROUTER",
            b"DEALER", LONGEST, lambda *message: self.received.append(message), self.ended.append,
        )  # fmt: skip
        self.listener.begin()

    def turn(self, timeout_s: float = 0.02) -> int:
        """One turn; returns how many descriptors were looked at."""
        ready = self.watched.poll(timeout_s)
        for fd in ready:
            callback = self.watched.callbacks.get(fd)
            if callback is not None:
                callback()
        return len(ready)

    def settle(self) -> None:
        """Turn until there is nothing to do."""
        waiting = Deadline()
        while waiting(self.turn(0) > 0):
            pass

    def raw(self, data: bytes = b"") -> socket.socket:
        """Connect a bare socket that has sent this."""
        one = socket.socket(socket.AF_UNIX)
        one.settimeout(30.0)
        one.connect(self.path)
        self.held.append(one)
        one.sendall(data)
        self.settle()
        return one

    def send(self, one: socket.socket, data: bytes) -> None:
        """Have a bare socket send more than the kernel keeps."""
        one.setblocking(False)
        waiting = Deadline()
        while waiting(len(data) > 0):
            with contextlib.suppress(BlockingIOError):
                data = data[one.send(data) :]
            self.turn(0)
        self.settle()

    def dealer(self) -> Any:
        one = self.context.socket(zmq.DEALER)
        one.linger = 0
        one.connect(f"ipc://{self.path}")
        return one

    @property
    def count(self) -> int:
        return len(list(self.connections))

    def of(self, pid: int) -> list[Connection]:
        return [one for one in self.connections if one.peer.pid == pid]

    def close(self) -> None:
        self.connections.deliver(0)
        for one in self.held:
            one.close()
        self.context.destroy(linger=0)
        self.socket.close()
        self.watched.close()


@pytest.fixture
def loop() -> Iterator[Loop]:
    with tempfile.TemporaryDirectory(dir="/tmp") as directory:
        one = Loop(directory)
        yield one
        one.close()


@pytest.fixture
def other(loop: Loop) -> Iterator[int]:
    """Return a process with three connections that say nothing."""
    process = subprocess.Popen(
        [sys.executable, "-c", _OTHER, loop.path, "3"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"in\n"
    loop.settle()
    assert len(loop.of(process.pid)) == 3
    yield process.pid
    process.kill()
    process.communicate()


def test_libzmq_s_client(loop: Loop) -> None:
    """Requests and replies of all lengths, and the credentials that the kernel gives."""
    one = loop.dealer()
    sizes = (0, 1, 255, 256, 300_000)
    for size in sizes:
        one.send(bytes(size))
    one.send_multipart([b"first", b"second"])
    waiting = Deadline()
    while waiting(len(loop.received) < len(sizes) + 1):
        loop.turn()
    assert [(len(body), is_multipart) for _, body, is_multipart in loop.received] == [
        *((size, False) for size in sizes), (5, True)
    ]  # fmt: skip
    connection = loop.received[0][0]
    assert connection.peer == Peer(os.getuid(), os.getgid(), os.getpid())
    for size in sizes:
        connection.reply(bytes(size))
    connection.refuse(7, Busy("later"))
    received: list[bytes] = []
    while waiting(len(received) < len(sizes) + 1):
        loop.turn()
        while one.poll(0):
            received.append(one.recv())
    assert [len(data) for data in received[:-1]] == list(sizes)
    assert getattr(decode_reply(received[-1]), "code", "") == "busy"
    assert (loop.counts["replies"], loop.counts["errors_returned"]) == (len(sizes) + 1, 1)
    one.close()
    while waiting(not loop.ended):
        loop.turn()
    assert loop.ended == [connection]
    connection.reply(b"too late")
    assert loop.count == 0


def test_a_turn_does_little(loop: Loop) -> None:
    """Whatever one connection sends, a turn looks at some of it; the rest is not forgotten."""
    one = loop.raw(GREETING + READY)
    one.sendall(framed(b"x") * 1000)
    most = 0
    waiting = Deadline()
    while waiting(len(loop.received) < 1000):
        before = len(loop.received)
        loop.turn()
        most = max(most, len(loop.received) - before)
    assert most == FRAMES_PER_TURN


def test_what_waits_too_long_stays_in_the_kernel(loop: Loop) -> None:
    """A loud client is not read any more until some of its requests were served."""
    one = loop.raw(GREETING + READY)
    inbox = Inbox(cast("StatisticsWriter", loop.counts))
    loop.listener.on_message = inbox.receive
    one.sendall(framed(b"x") * 500)
    loop.settle()
    waiting = len(inbox)
    assert MAX_WAITING <= waiting < MAX_WAITING + FRAMES_PER_TURN
    served = 0
    while (item := inbox.take()) is not None:
        item.run_step()
        inbox.served(item, 0.001)
        served += 1
        loop.settle()
        assert len(inbox) < MAX_WAITING + FRAMES_PER_TURN
    assert served == 500
    assert loop.counts["errors_returned"] == 0
    one.sendall(framed(b"x") * 500)
    loop.settle()
    one.close()
    waits = Deadline()
    while waits(not loop.ended):
        loop.turn()


def test_replies_that_are_not_read(loop: Loop) -> None:
    """They are kept up to a limit, whole; beyond it they and the connection are lost."""
    one = loop.raw(GREETING + READY)
    (connection,) = loop.connections
    sent = [bytes([n]) * 300_000 for n in range(20)] + [bytes(1 << 16), bytes((1 << 16) + 1), b"short"]
    for body in sent:
        connection.reply(body)
    assert loop.connections.nbytes == connection.unsent_bytes > 5_000_000
    expected = GREETING + framed(b"\x05READY\x0bSocket-Type\0\0\0\x06ROUTER\x08Identity\0\0\0\0", 4)
    expected += b"".join(map(framed, sent))
    received = bytearray()
    waiting = Deadline()
    while waiting(len(received) < len(expected)):
        received += one.recv(1 << 20)
        loop.settle()
    assert received == expected
    assert (connection.unsent_bytes, loop.connections.nbytes) == (0, 0)
    for _ in range(MAX_UNREAD_BYTES // 300_000 + 2):
        connection.reply(sent[0])
    assert connection.unsent_bytes == 0
    loop.settle()
    assert loop.ended == [connection]
    assert (loop.count, loop.connections.nbytes) == (0, 0)


def test_subscribers_that_do_not_read(loop: Loop) -> None:
    """Whatever is published, a few messages are kept for each; who reads again misses nothing."""
    log = EventLog(7)
    loop.listener.on_read = log.resume
    unread = [loop.raw(GREETING + READY) for _ in range(20)]
    for connection in loop.connections:
        log.subscribe(connection)
    for number in range(REMEMBERED):
        log.publish(Changed, f"{number}.pcd", number, "changed")
    assert all(0 < one.unsent_bytes < 1 << 14 for one in loop.connections)
    assert loop.connections.nbytes < 20 << 14
    received, at = bytearray(), len(GREETING)
    numbers: list[int] = []
    waiting = Deadline()
    while waiting(REMEMBERED not in numbers[-1:]):
        received += unread[0].recv(1 << 20)
        loop.settle()
        while at + 1 < len(received) and (end := at + 2 + received[at + 1]) <= len(received):
            if not received[at]:  # a message; a command has flags
                event = decode_event(bytes(received[at + 2 : end]))
                assert event is not None
                numbers.append(event.seq)
            at = end
    assert numbers == [*range(REMEMBERED + 1)], "the first is the beat of its subscription"


def test_subscribers_that_end_with_much_unread(loop: Loop) -> None:
    """Their end costs no more than another connection's: nothing is offered to them."""
    log = EventLog(7)
    offered: list[bool] = []

    def on_read(connection: Connection) -> bool:
        offered.append(True)
        return log.resume(connection)

    loop.listener.on_read = on_read
    unread = [loop.raw(GREETING + READY) for _ in range(20)]
    for connection in loop.connections:
        log.subscribe(connection)
    for number in range(REMEMBERED):
        log.publish(Changed, f"{number}.pcd", number, "changed")
    for one in unread:
        one.close()
    waiting = Deadline()
    while waiting(len(loop.ended) < len(unread)):
        loop.turn()
    assert offered == []


def test_half_a_message_from_each(loop: Loop, other: int) -> None:
    """All together are too much: the process that sent most loses its connections, the others nothing."""
    half = framed(bytes(LONGEST - 100))[:-1]
    while loop.connections.nbytes + len(half) <= MEMORY_ALLOWANCE_BYTES:
        loop.send(loop.raw(GREETING + READY), half)
    mine = loop.of(os.getpid())
    assert loop.ended == []
    with contextlib.suppress(BrokenPipeError):
        loop.send(loop.raw(GREETING + READY), half)
    loop.settle()
    assert set(loop.ended) > set(mine)
    assert {one.peer.pid for one in loop.connections} == {other}
    assert loop.connections.nbytes == 0
    assert len(loop.ended) == len(mine) + 1


def test_more_connections_than_descriptors(loop: Loop, other: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that has most keeps a share, connections with a session first; others lose nothing."""
    for _ in range(MIN_SHARE + 4):
        loop.raw()
    mine = loop.of(os.getpid())
    with_session = mine[:MIN_SHARE]
    for one in with_session:
        one.slot = 7
    highest = max(one.fd for one in loop.connections)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (highest + 49, highest + 49))
    loop.raw()
    assert set(loop.of(os.getpid())) == set(with_session)
    assert len(loop.of(other)) == 3
    assert len(loop.ended) == 5
    assert not loop.connections.short


def test_newcomers_wait_where_each_process_has_few(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    first = loop.raw()
    highest = max(one.fd for one in loop.connections)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (highest + 49, highest + 49))
    loop.raw()
    assert (loop.count, loop.connections.short) == (2, True)
    loop.raw(GREETING)
    assert (loop.count, loop.ended) == (2, [])
    first.close()
    loop.settle()
    assert (loop.count, len(loop.ended)) == (2, 1)


def test_a_machine_without_descriptors_is_asked_again(loop: Loop) -> None:
    """Without connections none can end and make room."""
    loop.connections.short = True
    loop.raw(GREETING)
    assert loop.count == 0
    loop.connections.try_again()
    loop.settle()
    assert loop.count == 1


def test_the_last_replies_are_delivered(loop: Loop) -> None:
    one = loop.raw(GREETING + READY)
    (connection,) = loop.connections
    connection.reply(bytes(READ_BYTES * 8))
    one.setblocking(True)
    reader = subprocess.Popen(
        [sys.executable, "-c", _READER], stdin=one.fileno(), stdout=subprocess.PIPE,
    )  # fmt: skip
    loop.connections.deliver(30.0)
    total, _ = reader.communicate()
    assert int(total) > READ_BYTES * 8


def test_a_descriptor_that_only_its_callback_keeps_open_can_be_unwatched() -> None:
    class Owner:
        def __init__(self) -> None:
            self.fd = os.eventfd(0, os.EFD_CLOEXEC)

        def __del__(self) -> None:
            os.close(self.fd)

        def look(self) -> None:
            """Do nothing."""

    watched, owner = WatchedDescriptors(), Owner()
    fd = owner.fd
    watched.watch(fd, owner.look)
    del owner
    os.eventfd_write(fd, 1)
    assert watched.poll(0.0) == [fd]
    watched.unwatch(fd)
    assert watched.poll(0.0) == []
    watched.close()
