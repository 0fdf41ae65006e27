# SPDX-License-Identifier: Apache-2.0
"""The client library in signal handlers, beside lease probes, with several windows, and at a robot's boot."""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from typing import Any, Final

import shmmap
from tests.benchmarks.hostile.actors import Actor, Orders
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.report import Report
from tests.benchmarks.hostile.stage import Stage, scene
from tests.support.daemon_process import ROOT
from tests.support.process_costs import mappings_under
from tests.support.raw_client import RawClient, circle

MIB: Final = 1 << 20


@scene("A18", "What one window of a client holds does not make the daemon forget what another one holds")
def several_windows(told: Report, stage: Stage) -> None:
    """Ten windows of one client, each with its own differential; a quota of 256 cells for all together."""
    cells, quota = stage.many_cells(141), 2 * MIB
    with (
        stage.served(cells, "--budget", "1G", "--session-quota", str(quota)) as one,
        shmmap.connect(one.endpoint, timeout=60.0) as client,
    ):
        windows = []
        for number in range(10):
            area = shmmap.Circle(210.0 + 260.0 * number, 210.0, 80.0)
            windows.append(client.differential(area, (), wait=60.0))
        held = sum(cell.nbytes for window in windows for cell in window)
        refused = sum(len(window.failed) for window in windows)
        told.tell(f"10 windows: {sum(map(len, windows))} cells held, {refused} refused")
        told.limit("held at once", held / MIB, quota / MIB, "MiB")
        with RawClient(one.endpoint) as operator:
            (counted,) = [row[7] for row in operator.ask("stats")[5] if row[1] == os.getpid() and row[6]]
        told.must("the daemon knows all that is held", counted >= held, f"{counted} of {held} bytes")


def leases(orders: Orders, paths: list[str]) -> int:
    """Take and give back a lease of each file again and again, as the daemon does to see who uses it."""
    signal.signal(signal.SIGIO, signal.SIG_IGN)  # somebody opens what is leased
    count = 0
    while orders.go_on():
        for path in paths:
            fd = os.open(path, os.O_RDONLY)
            with contextlib.suppress(OSError):  # somebody has it open
                fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_WRLCK)
                fcntl.fcntl(fd, fcntl.F_SETLEASE, fcntl.F_UNLCK)
                count += 1
            os.close(fd)
    return count


def opens(orders: Orders, endpoint: str, shm_dir: str, seconds: float) -> tuple[int, Counter[str]]:
    """Ask for cells, map them and let go, for some seconds; how often, and what failed."""
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
def lease_probes(told: Report, stage: Stage) -> None:
    """Another process takes leases of the segments all the time; then one of them is a named pipe."""
    with stage.served(stage.new_map().root) as one, RawClient(one.endpoint) as client:
        paths = [client.path(cell) for cell in client.area(circle(0, 0, 50)).cells]
        other_way = f"/proc/self/root{one.shm_dir}"
        for what, shm_dir in (("the usual directory", ""), ("another path to it", other_way)):
            with Actor(leases, paths) as prober, Actor(opens, one.endpoint, shm_dir, 10.0) as opener:
                count, failures = opener.said()
                told.tell(f"{what}: {count} requests beside {prober.end()} leases; failed {dict(failures)}")
            told.limit("of them failed", failures.total(), 0)
        os.unlink(paths[0])
        os.mkfifo(paths[0])
        with Actor(opens, one.endpoint, "", 1.0) as opener:
            begin_s = time.monotonic()
            try:
                count, failures = opener.said(60.0)
                told.tell(f"beside a pipe: {count} requests, {dict(failures)}")
            finally:
                told.limit(
                    "with a pipe in the place of a segment it took", time.monotonic() - begin_s, 10.0, "s"
                )
        os.unlink(paths[0])


class Interrupt(Exception):
    """What a signal handler raises."""


INTERRUPTS: Final = 400


def makes_another_request(client: shmmap.Client) -> str:
    """Ask, and say what was unmapped; returns what went wrong."""
    try:
        client.around(0.0, 0.0, 1.0)
        client.release()
    except shmmap.ShmmapError as error:
        return str(error)
    return ""


def is_interrupted_once(client: shmmap.Client, after_s: float) -> bool:
    """Ask, and have a signal come that much later; whether it came in time."""
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, after_s)
            client.around(0.0, 0.0, 70.0)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except Interrupt:
        return True
    return False


def is_interrupted(orders: Orders, endpoint: str, shm_dir: str) -> dict[str, Any]:
    """A signal handler's exception interrupts a request at any moment; then the next one is made."""

    def interrupt(*_: object) -> None:
        raise Interrupt

    rng = random.Random(3)
    found: dict[str, Any] = {"interrupts": 0, "descriptors": 0, "mappings": 0, "not answered": 0, "said": ""}
    signal.signal(signal.SIGALRM, interrupt)
    sys.unraisablehook = lambda _: None  # one in a finalizer is printed, and leaks what is looked at below
    client = shmmap.connect(endpoint, name="interrupted", timeout=2.0)
    client.around(0.0, 0.0, 70.0)
    client.release()
    began = time.perf_counter()
    client.around(0.0, 0.0, 70.0)
    took_s = time.perf_counter() - began
    open_before, mapped_before = len(os.listdir("/proc/self/fd")), mappings_under(shm_dir)
    while found["interrupts"] < INTERRUPTS:
        if not is_interrupted_once(client, rng.uniform(1e-5, 1.2 * took_s)):
            continue
        found["interrupts"] += 1
        failure = makes_another_request(client)
        if failure:
            found["not answered"] += 1
            found["said"] = failure
            client = shmmap.connect(endpoint, name="interrupted", timeout=2.0)
        settled = time.monotonic() + 0.2  # another thread unmaps
        opened = mapped = sys.maxsize
        while (opened > open_before or mapped > mapped_before) and time.monotonic() < settled:
            opened, mapped = len(os.listdir("/proc/self/fd")), mappings_under(shm_dir)
        found["descriptors"] += opened > open_before
        found["mappings"] += mapped > mapped_before
        open_before, mapped_before = opened, mapped
    closing = threading.Thread(target=client.close, daemon=True)
    closing.start()
    closing.join(10.0)
    found["close hangs"] = closing.is_alive()
    return found


@scene("B1", "A signal handler's exception in mid-request leaks nothing, and the next request is answered")
def interrupts(told: Report, stage: Stage) -> None:
    """400 requests interrupted at any moment."""
    with stage.served(stage.new_map().root) as one:
        with Actor(is_interrupted, one.endpoint, one.shm_dir) as actor:
            found = actor.said()
        share = 100.0 / found["interrupts"]
        told.tell(f"{found}")
        told.limit("interrupts that leak a descriptor", found["descriptors"] * share, 0, "%")
        told.limit("interrupts that leak a mapping", found["mappings"] * share, 0, "%")
        told.limit("interrupts after which a request fails", found["not answered"] * share, 0, "%")
        told.must("closing ends", not found["close hangs"])


HANDLERS: Final = 5


def asks_in_a_handler(orders: Orders, endpoint: str) -> dict[str, Any]:
    """A signal handler makes a request while one of the same client is under way."""
    found: dict[str, Any] = {"handled": 0, "longest_s": 0.0, "said": Counter[str]()}
    client = shmmap.connect(endpoint, name="handler", timeout=3.0)
    inside = threading.Event()

    def handle(*_: object) -> None:
        begin_s = time.monotonic()
        inside.set()
        try:
            client.around(0.0, 0.0, 5.0)
            found["said"]["answered"] += 1
        except shmmap.ShmmapError as error:
            found["said"][f"{type(error).__name__}: {error}"] += 1
        found["handled"] += 1
        found["longest_s"] = max(found["longest_s"], time.monotonic() - begin_s)

    signal.signal(signal.SIGALRM, handle)
    for _ in range(HANDLERS):
        inside.clear()
        signal.setitimer(signal.ITIMER_REAL, 0.0005)
        while not inside.is_set():
            client.around(0.0, 0.0, 70.0)
    return found


@scene("B2", "A request from within a signal handler is told at once what is wrong")
def requests_in_handlers(told: Report, stage: Stage) -> None:
    """Five signal handlers that make a request in the middle of another one."""
    with stage.served(stage.new_map().root) as one, Actor(asks_in_a_handler, one.endpoint) as actor:
        found = actor.said()
        told.tell(f"{found['handled']} handlers: {dict(found['said'])}")
        told.limit("the longest wait in one", found["longest_s"], 0.5, "s")
        blamed = sum(number for words, number in found["said"].items() if "another thread" in words)
        told.limit("of them were told of another thread", blamed, 0)


PROGRAMS: Final = 60
_PROGRAM: Final = """
import sys
import shmmap
with shmmap.connect(sys.argv[1]) as client:
    assert client.around(0.0, 0.0, 30.0)
"""


@scene("B3", "60 programs that are started together all connect, as at a robot's boot")
def boot(told: Report, stage: Stage) -> None:
    """60 processes are started at once, on this machine's processors; three times."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with stage.served(stage.new_map().root) as one, Beside(told, one, newcomers_too=False):
        for number in range(3):
            begin_s = time.monotonic()
            started = [
                subprocess.Popen(
                    [sys.executable, "-c", _PROGRAM, one.endpoint],
                    env=environment, stderr=subprocess.PIPE, text=True, cwd=ROOT,
                )
                for _ in range(PROGRAMS)
            ]  # fmt: skip
            said = [process.communicate()[1] for process in started]
            failed = [words for process, words in zip(started, said, strict=True) if process.returncode]
            took_s = time.monotonic() - begin_s
            processors = len(os.sched_getaffinity(0))
            told.limit(
                f"start {number + 1}: of {PROGRAMS} programs on {processors} processors, {took_s:.1f} s,"
                " could not connect", len(failed), 0,
            )  # fmt: skip
            if failed:
                told.tell(f"one was told: {failed[0].strip().splitlines()[-1][:160]}")
