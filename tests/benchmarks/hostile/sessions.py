# SPDX-License-Identifier: Apache-2.0
"""Connections and sessions: subscriptions, crowds, clients that leave without a goodbye or start together."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import math
import os
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import zmq

import shmmap
from tests.benchmarks.hostile.actors import Actor, Orders, walks_cold
from tests.benchmarks.hostile.beside import Beside, private_bytes
from tests.benchmarks.hostile.segments import budget_for
from tests.benchmarks.hostile.stage import Report, Stage, scene
from tests.support.daemon_process import ROOT
from tests.support.message_pack import pack
from tests.support.plain_client import PlainClient
from tests.support.process_costs import descriptors
from tests.support.raw_client import RawClient, circle

DESCRIPTORS: Final = 1024
STILL_MAPPED: Final = 100
REST_S: Final = 3.0
MAX_FAILURES: Final = 50


def subscribes(orders: Orders, path: str) -> dict[str, int]:
    """Subscribe to one prefix after the other as fast as the daemon takes them; connect again when ended."""
    found = {"prefixes": 0, "ended": 0}
    while orders.go_on():
        try:
            with contextlib.closing(PlainClient(path, ready="ready of a SUB", timeout_s=10.0)) as one:
                while orders.go_on():
                    first = found["prefixes"]
                    one.connection.sendall(
                        b"".join(b"\x00\x09\x01" + struct.pack(">Q", n) for n in range(first, first + 1000))
                    )
                    found["prefixes"] += 1000
                    if found["prefixes"] % 600_000 == 0:
                        break  # a subscriber with 600 000 leaves
        except OSError:
            found["ended"] += 1
    return found


@scene("A1", "Subscriptions to many prefixes take no memory, and their end delays no one")
def subscriptions(report: Report, stage: Stage) -> None:
    """One subscriber that asks for another prefix without end, for 30 s; then it is killed."""
    with stage.served(stage.new_map().root) as one, Beside(report, one):
        with RawClient(one.endpoint, hello=False) as client:
            events_path = client.hello()[19]
        with Actor(subscribes, events_path) as attacker:
            time.sleep(30.0)
            found = attacker.end()
            report.note(
                f"sent in 30 s: {found['prefixes']} subscriptions; connections ended: {found['ended']}"
            )
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
        while count < stop and len(failures) < MAX_FAILURES and orders.go_on():
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
        one.send(pack(["hello", 1, 3, 0, "crowd"]))
        held.append(one)
        count += bool(one.poll(1000))
        if len(held) > CROWD:
            held.pop(0).close()
    context.destroy(linger=0)
    return count


@scene(
    "A22", "More connections than descriptors keep no client out, with nothing but what the kernel promises"
)
def crowds(report: Report, stage: Stage) -> None:
    """2000 silent connections, then 2000 sessions, under a limit of 1024 descriptors."""
    with stage.served(stage.new_map().root, descriptors=DESCRIPTORS) as one, Beside(report, one):
        for crowd in (says_nothing, opens_sessions):
            with Actor(crowd, one.endpoint) as attacker:
                time.sleep(15.0)
                report.limit("descriptors of the daemon", descriptors(one.pid), DESCRIPTORS - 1)
                report.note(f"{attacker.name}: {attacker.end()} came, of one process")
        log = one.log
    report.note(f"'connections ended' lines in the log: {log.count('connections ended')}")
    report.must("the daemon reads no private state of the kernel's", not reads_fdinfo())


def reads_fdinfo() -> bool:
    """Whether the daemon's transport scrapes `/proc/self/fdinfo`, where libzmq's pointers were found."""
    return any(
        "fdinfo" in path.read_text() for path in (ROOT / "shmmap" / "daemon" / "transport").glob("*.py")
    )


@scene(
    "A3", "Clients that are dropped without a goodbye keep no descriptor, no place and no other client out"
)
def dropped_clients(report: Report, stage: Stage) -> None:
    """932, then 1500 clients of one process under a limit of 1024 descriptors; 100 cells stay mapped."""
    side = 60
    span_m = (-side * 10.0, side * 10.0)
    made = stage.new_map(columns=side, rows=side, points=400)
    with (
        stage.served(made.root, "--budget", "12M", descriptors=DESCRIPTORS) as one,
        Beside(report, one),
        RawClient(one.endpoint) as operator,
    ):
        with Actor(walks_cold, one.endpoint, 6.0, span_m, span_m) as walker:
            walker.said()  # the budget is full from now on
        with Actor(walks_cold, one.endpoint, 8.0, span_m, span_m) as walker:
            before, took_s = walker.said()
        report.note(f"cold cells in 8 s before: {before / took_s * 8:.0f}")
        stops = [932, 1500]
        with Actor(leaves_without_a_word, one.endpoint, span_m, stops) as attacker:
            for stop in stops:
                count, failures = attacker.said()
                report.limit(f"of {stop} clients that were dropped were refused", stop - count, 0)
                if failures:
                    report.note(f"one got: {failures[0]}")
                report.limit("descriptors of the daemon", descriptors(one.pid), DESCRIPTORS - 1)
                time.sleep(1.0)
                rows = operator.ask("stats")[5]
                placed = sum(row[10] is not None for row in rows if row[4].startswith("silent"))
                report.limit("of them the daemon still heeds the places of", placed, 0)
            time.sleep(REST_S)
            with Actor(walks_cold, one.endpoint, 8.0, span_m, span_m) as walker:
                after, took_s = walker.said()
            report.note(f"cold cells in 8 s beside them: {after / took_s * 8:.0f}")
            report.limit("those before over these", before / max(1, after), 1.5)


def leases(orders: Orders, paths: list[str]) -> int:
    """Keep taking and giving back a lease of each file, as the daemon does to see which are in use."""
    signal.signal(signal.SIGIO, signal.SIG_IGN)  # another process opens what is leased
    count = 0
    while orders.go_on():
        for path in paths:
            fd = os.open(path, os.O_RDONLY)
            with contextlib.suppress(OSError):  # another process has it open
                fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_WRLCK)
                fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_UNLCK)
                count += 1
            os.close(fd)
    return count


def opens(orders: Orders, endpoint: str, shm_dir: str, seconds: float) -> tuple[int, Counter[str]]:
    """Ask for cells, map and release them, for some seconds; how often, and what failed."""
    count, failures = 0, Counter[str]()
    with shmmap.connect(endpoint, name="opens", shm_dir=shm_dir) as client:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            count += 1
            try:
                cells = client.around(0.0, 0.0, 50.0)
                failures.update(str(failure)[:100] for failure in cells.failed)
                del cells
            except (shmmap.ShmmapError, OSError) as error:
                failures[f"{type(error).__name__}: {error}"[:100]] += 1
    return count, failures


@scene("A21", "Opening a segment that is just being looked at, or was swapped for a pipe, harms no request")
def lease_probes(report: Report, stage: Stage) -> None:
    """Another process takes leases of the segments all the time; then one of them is a named pipe."""
    with stage.served(stage.new_map().root) as one, RawClient(one.endpoint) as client:
        paths = [client.path(cell) for cell in client.area(circle(0, 0, 50)).cells]
        other_path = f"/proc/self/root{one.shm_dir}"
        for what, shm_dir in (("the usual directory", ""), ("another path to it", other_path)):
            with Actor(leases, paths) as prober, Actor(opens, one.endpoint, shm_dir, 10.0) as opener:
                count, failures = opener.said()
                report.note(f"{what}: {count} requests beside {prober.end()} leases; failed {dict(failures)}")
            report.limit("of them failed", failures.total(), 0)
        os.unlink(paths[0])
        os.mkfifo(paths[0])
        with Actor(opens, one.endpoint, "", 1.0) as opener:
            begin_s = time.monotonic()
            try:
                count, failures = opener.said(60.0)
                report.note(f"beside a pipe: {count} requests, {dict(failures)}")
            finally:
                report.limit(
                    "with a pipe in the place of a segment it took", time.monotonic() - begin_s, 10.0, "s"
                )
        Path(paths[0]).unlink(missing_ok=True)  # the daemon may have removed the pipe


PROGRAMS: Final = 60
_PROGRAM: Final = """
import sys
import shmmap
with shmmap.connect(sys.argv[1]) as client:
    assert client.around(0.0, 0.0, 30.0)
"""


@scene("B3", "60 programs that are started together all connect, as at a robot's boot")
def boot(report: Report, stage: Stage) -> None:
    """60 processes are started at once, on this machine's processors; three times."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with stage.served(stage.new_map().root) as one, Beside(report, one, newcomers_too=False):
        for number in range(3):
            begin_s = time.monotonic()
            started = [
                subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, one.endpoint],
                    env=environment,
                    stderr=subprocess.PIPE,
                    text=True,
                    cwd=ROOT,
                )
                for _ in range(PROGRAMS)
            ]
            said = [process.communicate()[1] for process in started]
            failed = [words for process, words in zip(started, said, strict=True) if process.returncode]
            took_s = time.monotonic() - begin_s
            processors = len(os.sched_getaffinity(0))
            report.limit(
                f"start {number + 1}: of {PROGRAMS} programs on {processors} processors, {took_s:.1f} s,"
                " could not connect",
                len(failed),
                0,
            )
            if failed:
                report.note(f"one got: {failed[0].strip().splitlines()[-1][:160]}")


UNREAD: Final = 200
MEMORY_BACK_S: Final = 10.0
"""Within this time the daemon's memory is what it was, after the subscribers have ended."""


def subscribes_without_reading(orders: Orders, path: str, count: int) -> int:
    """Subscribe ``count`` times and never read; connect again when ended."""
    waiting: list[PlainClient] = []
    made = 0
    while orders.go_on(0.2):
        ends = select.poll()
        for one in waiting:
            ends.register(one.connection, 0)
        ended = {fd for fd, _hung_up in ends.poll(0)}
        waiting = [one for one in waiting if one.connection.fileno() not in ended]
        while len(waiting) < count:
            one = PlainClient(path, ready="ready of a SUB", timeout_s=10.0)
            one.connection.sendall(b"\x00\x01\x01")
            waiting.append(one)
            made += 1
        if made == count:
            orders.say(made)
    return made


@scene("A23", "Subscribers that never read delay no one, and their memory comes back")
def unread_events(report: Report, stage: Stage) -> None:
    """200 subscribers that never read, beside a client whose walk evicts hundreds of cells a second, 30 s.

    The same walk is taken before without them: what the daemon remembers of it (events, evictions, rows) is
    not theirs.
    """
    side, segments = 141, 2000
    with ExitStack() as stack:
        one = stack.enter_context(stage.served(stage.many_cells(side), "--budget", budget_for(segments)))
        with RawClient(one.endpoint, hello=False) as client:
            events_path = client.hello()[19]
        walk = (one.endpoint, 30.0, (0.0, side * 20.0), (60.0, side * 20.0))
        with Actor(walks_cold, *walk) as walker:
            walker.said(900.0)
        before = private_bytes(one.pid)
        with Beside(report, one):
            with (
                Actor(subscribes_without_reading, events_path, UNREAD) as attacker,
                Actor(walks_cold, *walk) as walker,
            ):
                loaded, took_s = walker.said(900.0)
                made = attacker.end()
            report.note(f"{loaded} cells loaded in {took_s:.0f} s; subscriptions made: {made}")
        end_s = time.monotonic() + MEMORY_BACK_S
        while private_bytes(one.pid) > before + (16 << 20) and time.monotonic() < end_s:
            time.sleep(0.2)
        grown = (private_bytes(one.pid) - before) / (1 << 20)
        report.limit(f"memory {MEMORY_BACK_S:g} s after their end, over what it was", grown, 16.0, "MiB")
