# SPDX-License-Identifier: Apache-2.0
"""Connections and sessions: subscriptions without end, clients that leave without a goodbye, crowds."""

from __future__ import annotations

import gc
import math
import random
import socket
import struct
import time
from typing import Final

import zmq

from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.report import Report
from tests.benchmarks.hostile.stage import Stage, scene
from tests.benchmarks.hostile.walkers import walks_cold
from tests.support.daemon_process import ROOT
from tests.support.message_pack import pack
from tests.support.process_costs import descriptors
from tests.support.raw_client import RawClient

DESCRIPTORS: Final = 1024
STILL_MAPPED: Final = 100
REST_S: Final = 3.0
MOST_FAILURES: Final = 50
GREETING: Final = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16 + 32)


def zmtp(path: str, kind: bytes) -> socket.socket:
    """Open a connection that says it is a ZeroMQ socket of a kind."""
    one = socket.socket(socket.AF_UNIX)
    one.settimeout(10.0)
    one.connect(path)
    body = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    one.sendall(GREETING + b"\x04" + bytes([len(body)]) + body)
    one.recv(64)
    return one


def subscribes(orders: Orders, path: str) -> dict[str, int]:
    """Subscribe to one prefix after the other as fast as the daemon takes them; connect again when ended."""
    found = {"prefixes": 0, "ended": 0}
    while orders.go_on():
        try:
            with zmtp(path, b"SUB") as one:
                while orders.go_on():
                    first = found["prefixes"]
                    one.sendall(
                        b"".join(b"\x00\x09\x01" + struct.pack(">Q", n) for n in range(first, first + 1000))
                    )
                    found["prefixes"] += 1000
                    if found["prefixes"] % 600_000 == 0:
                        break  # a subscriber with 600 000 leaves
        except OSError:
            found["ended"] += 1
    return found


@scene("A1", "Subscriptions to many prefixes take no memory, and their end stops nobody")
def subscriptions(told: Report, stage: Stage) -> None:
    """One subscriber that asks for another prefix without end, for 30 s; then it is killed."""
    with stage.served(stage.new_map().root) as one, Beside(told, one):
        with RawClient(one.endpoint, hello=False) as client:
            events_path = client.hello()[19]
        with Actor(subscribes, events_path) as attacker:
            time.sleep(30.0)
            found = attacker.end()
            told.tell(f"sent in 30 s: {found['prefixes']} subscriptions; connections ended: {found['ended']}")
        time.sleep(2.0)


def leaves_without_a_word(
    orders: Orders, endpoint: str, span_m: tuple[float, float], stops: list[int]
) -> tuple[int, int]:
    """Client after client asks with a place and a route, and is dropped unclosed; some cells stay mapped.

    It says how many it was, and what refusals said, at each of ``stops``, and rests then; returns how many
    it was, and how many were refused.
    """
    import shmmap

    rng = random.Random(1)
    kept = []
    failures: list[str] = []
    count = 0
    for stop in stops:
        while count < stop and len(failures) < MOST_FAILURES and orders.go_on():
            x, y = (rng.uniform(*span_m) for _ in range(2))
            route = tuple((x + 20.0 * math.cos(n), y + 20.0 * math.sin(n)) for n in range(64))
            try:
                client = shmmap.connect(endpoint, name=f"silent {count}", connect_timeout=5.0)
                cells = client.area(shmmap.Circle(x, y, 5.0), wait=10.0, pose=(x, y), route=route)
                if count < STILL_MAPPED:
                    kept.append(cells)
                count += 1
            except shmmap.ShmmapError as error:
                failures.append(str(error))
            client = cells = None  # type: ignore[assignment]
        gc.collect()
        orders.say((count, failures))
        orders.go_on(REST_S)
    while orders.go_on(60.0):
        pass
    return count, len(failures)


CROWD: Final = 2000


def says_nothing(orders: Orders, path: str) -> int:
    """Open connection after connection and say nothing; opens more wherever one was ended."""
    held: list[socket.socket] = []
    count = 0
    while orders.go_on(0.001):
        one = socket.socket(socket.AF_UNIX)
        one.settimeout(1.0)
        try:
            one.connect(path)
        except OSError:
            one.close()
            continue
        held.append(one)
        count += 1
        if len(held) > CROWD:
            held.pop(0).close()
    return count


def opens_sessions(orders: Orders, endpoint: str) -> int:
    """Open session after session and keep them."""
    context = zmq.Context()
    context.set(zmq.MAX_SOCKETS, 8192)
    held: list[zmq.Socket[bytes]] = []
    count = 0
    while orders.go_on(0.001):
        one = context.socket(zmq.DEALER)
        one.linger = 0
        one.connect(f"ipc://{endpoint}")
        one.send(pack(["hello", 1, 1, 0, "crowd"]))
        held.append(one)
        count += bool(one.poll(1000))
        if len(held) > CROWD:
            held.pop(0).close()
    context.destroy(linger=0)
    return count


@scene("A22", "More connections than descriptors keep nobody out, with nothing but what the kernel promises")
def crowds(told: Report, stage: Stage) -> None:
    """2000 silent connections, then 2000 sessions, under a limit of 1024 descriptors."""
    with stage.served(stage.new_map().root, descriptors=DESCRIPTORS) as one, Beside(told, one):
        for crowd in (says_nothing, opens_sessions):
            with Actor(crowd, one.endpoint) as attacker:
                time.sleep(15.0)
                told.limit("descriptors of the daemon", descriptors(one.pid), DESCRIPTORS - 1)
                told.tell(f"{attacker.name}: {attacker.end()} came, of one process")
        log = one.log
    told.tell(f"'connections ended' lines in the log: {log.count('connections ended')}")
    told.must("the daemon reads no private state of the kernel's", not reads_fdinfo())


def reads_fdinfo() -> bool:
    """Whether the daemon's transport scrapes `/proc/self/fdinfo`, where libzmq's pointers were found."""
    return any(
        "fdinfo" in path.read_text() for path in (ROOT / "shmmap" / "daemon" / "transport").glob("*.py")
    )


@scene("A3", "Clients that are dropped without a goodbye keep no descriptor, no place and nobody out")
def dropped_clients(told: Report, stage: Stage) -> None:
    """932, then 1500 clients of one process under a limit of 1024 descriptors; 100 cells stay mapped."""
    side = 60
    span_m = (-side * 10.0, side * 10.0)
    made = stage.new_map(columns=side, rows=side, points=400)
    with (
        stage.served(made.root, "--budget", "12M", descriptors=DESCRIPTORS) as one,
        Beside(told, one),
        RawClient(one.endpoint) as operator,
    ):
        with Actor(walks_cold, one.endpoint, 6.0, span_m, span_m) as walker:
            walker.said()  # the budget is full from now on
        with Actor(walks_cold, one.endpoint, 8.0, span_m, span_m) as walker:
            before, took_s = walker.said()
        told.tell(f"cold cells in 8 s before: {before / took_s * 8:.0f}")
        stops = [932, 1500]
        with Actor(leaves_without_a_word, one.endpoint, span_m, stops) as attacker:
            for stop in stops:
                count, failures = attacker.said()
                told.limit(f"of {stop} clients that were dropped were refused", stop - count, 0)
                if failures:
                    told.tell(f"one was told: {failures[0]}")
                told.limit("descriptors of the daemon", descriptors(one.pid), DESCRIPTORS - 1)
                time.sleep(1.0)
                rows = operator.ask("stats")[5]
                placed = sum(row[10] is not None for row in rows if row[4].startswith("silent"))
                told.limit("of them the daemon still heeds the places of", placed, 0)
            time.sleep(REST_S)
            with Actor(walks_cold, one.endpoint, 8.0, span_m, span_m) as walker:
                after, took_s = walker.said()
            told.tell(f"cold cells in 8 s beside them: {after / took_s * 8:.0f}")
            told.limit("those before over these", before / max(1, after), 1.5)
