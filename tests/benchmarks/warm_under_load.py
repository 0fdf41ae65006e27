# SPDX-License-Identifier: Apache-2.0
"""Warm requests while cells load and while others are evicted, in a full cache, and with very many segments.

    python -m tests.benchmarks.warm_under_load [--passes 6] [--rounds 40] [--many 100000]

The request is the packed one of `tests.benchmarks.warm_request`.  This client has one processor and all
servers have another, as with ``--pin`` there; loaders go where there is room.

- While 60 cells of 1 MB load for another process, and while cells load for which others have to be evicted:
  round trips to the daemon and to a bare ZeroMQ echo in turn, so that both meet the same loads.  Printed are
  the 99th percentiles and how many took longer than 1 ms, a pass.  Limit: twice the echo's, no more stalls.
- Cache: in a daemon whose budget is full, against one that has room, in alternating rounds.  Limit: 1.1.
- Segments: in a daemon with ``--many`` of them, against one with 1000.  Limit: 1.2.

Measured beside those of BENCHMARKS.md: 1.00 with a full cache, 1.00 with 100 000 segments.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.make_many_cells import make_many_cells
from tests.benchmarks.warm_request import Echo, Warm, pin, time_block
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map, random_points
from tests.support.raw_client import RawClient

LOADED = 60
EVICTED = 400
STALL_US = 1000.0


def heavy_cells(made: DividedMap, count: int, points: int, y: int) -> list[str]:
    """Add cells far away whose loading is work."""
    rng = np.random.default_rng(9)
    names = []
    for number in range(count):
        corner = (10_000 + 20 * number, y)
        name = f"heavy_{y}_{number}.pcd"
        made.write_cell(name, corner, random_points(rng, corner, points))
        names.append(name)
    made.write_metadata()
    return names


class Other:
    """A client in a process of its own, for which cells are loaded."""

    def __init__(self, endpoint: str, stack: ExitStack) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        process = context.Process(target=_serve_other, args=(endpoint, theirs))
        process.start()
        stack.callback(process.join)
        stack.callback(self._pipe.send, None)
        self.answer()  # it is connected

    def send(self, tag: str, *elements: Any) -> None:
        """Have it send a request."""
        self._pipe.send((tag, *elements))

    def answered(self) -> bool:
        """Whether it has its reply."""
        return self._pipe.poll()

    def answer(self) -> Any:
        """The reply; of cells, which it releases, their number."""
        return self._pipe.recv()

    def ask(self, tag: str, *elements: Any) -> Any:
        """Have it send a request, and give the reply."""
        self.send(tag, *elements)
        return self.answer()


def _serve_other(endpoint: str, pipe: Connection) -> None:
    with RawClient(endpoint, timeout=120.0, name="other") as client:
        pipe.send(None)
        while (request := pipe.recv()) is not None:
            reply = client.ask(*request)
            if reply[0] == "cells":
                pipe.send(len(client.cells_reply(reply).cells))
                client.release()
            else:
                pipe.send(reply)


class Meanwhile:
    """Round trips of requests and of echoes in turn, microseconds."""

    def __init__(self, warm: Warm, echo: Echo) -> None:
        self.times: tuple[list[float], list[float]] = ([], [])
        self._in_turn = itertools.cycle(
            [
                (warm.client.socket, warm.requests["packed"], self.times[0]),
                (echo.socket, echo.request, self.times[1]),
            ]
        )

    def until(self, other: Other, *, noted: bool = True) -> None:
        """Until a client has an answer; the loads that it waits for are running."""
        while not other.answered():
            socket, request, times = next(self._in_turn)
            start = time.perf_counter()
            socket.send(request)
            socket.recv()
            if noted:
                times.append((time.perf_counter() - start) * 1e6)

    def print_times(self, what: str, passes: int) -> None:
        """Print it."""
        ours, echo = (float(np.percentile(times, 99)) for times in self.times)
        stalls, echoed = (sum(one > STALL_US for one in times) / passes for times in self.times)
        print(
            f"{what}: p99 {ours:.0f} us, echo {echo:.0f}: {ours / echo:.2f} x;"
            f" over 1 ms a pass {stalls:.1f}, echo {echoed:.1f}; n={len(self.times[0])}",
            flush=True,
        )


def while_loading(
    one: DaemonProcess, other: Other, meanwhile: Meanwhile, heavy: list[str], passes: int
) -> None:
    """Time requests while cold cells are being loaded for another client."""
    for number in range(passes + 1):
        other.send("selected", heavy, ["points"], 60.0)
        meanwhile.until(other, noted=number > 0)  # the first pass also starts the loaders
        assert other.answer() == len(heavy)
        other.ask("evict", heavy)
        while any(name.endswith(".zombie") for name in one.segments()):
            other.ask("stats")  # a cell asked for again before it is freed is only put back in service


def while_others_are_evicted(other: Other, meanwhile: Meanwhile, cells: Iterator[str], passes: int) -> int:
    """Time requests while cells are loaded for which others have to be evicted; returns their number."""
    before = other.ask("stats")[4]["evictions"]
    for _ in range(passes):
        for _ in range(LOADED // 10):
            other.send("selected", list(itertools.islice(cells, 10)), ["points"], 60.0)
            meanwhile.until(other)
            assert other.answer() == 10
    evicted: int = other.ask("stats")[4]["evictions"] - before
    return evicted


def compared(what: str, first: Warm, second: Warm, rounds: int) -> None:
    """Print how much longer the second one's requests take."""
    blocks: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for warm, medians in zip((first, second), blocks, strict=True):
            medians.append(float(np.median(time_block(warm.client.socket, warm.requests["packed"]))))
    ratio = np.median(np.divide(blocks[1], blocks[0]))
    p50 = [np.median(medians) for medians in blocks]
    print(
        f"{what}: p50 {p50[1]:.1f} us against {p50[0]:.1f}: {ratio:.3f} x (median of paired blocks)",
        flush=True,
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--passes", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--many", type=int, default=100_000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, ExitStack() as stack:

        def served(path: Path, *flags: str) -> DaemonProcess:
            one = DaemonProcess(path, *flags)
            stack.callback(one.dispose)
            one.start()
            stack.callback(one.stop)
            pin(one.pid, servers)
            return one

        mine, *rest = sorted(os.sched_getaffinity(0))
        servers = set(rest[:1]) or {mine}

        made = make_map(Path(directory) / "map", columns=20, rows=20, points=30)
        heavy = heavy_cells(made, LOADED, 60_000, 0)
        others = heavy_cells(made, EVICTED, 10_000, 1000)
        roomy, full = served(made.root, "--budget", "2G"), served(made.root, "--budget", "24M")
        of_roomy, of_full = Warm(roomy), Warm(full)
        echo = of_roomy.echo(roomy, "packed")
        stack.callback(echo.close)
        pin(echo.process.pid, servers)
        others_of_roomy, others_of_full = (Other(one.endpoint, stack) for one in (roomy, full))
        pin(os.getpid(), {mine})
        meanwhile = Meanwhile(of_roomy, echo)
        while_loading(roomy, others_of_roomy, meanwhile, heavy, arguments.passes)
        meanwhile.print_times(f"while {LOADED} cells of 1 MB load", arguments.passes)
        meanwhile = Meanwhile(of_full, echo)
        cells = itertools.cycle(others)
        evicted = while_others_are_evicted(others_of_full, meanwhile, cells, 2 * arguments.passes)
        meanwhile.print_times(f"while {evicted} cells are evicted for others", 2 * arguments.passes)
        compared("a full cache against one with room", of_roomy, of_full, arguments.rounds)

        side = int(arguments.many**0.5) + 1
        make_many_cells(Path(directory) / "many", side)
        few, many = (served(Path(directory) / "many", "--budget", "4G") for _ in range(2))
        middle = 20.0 * (side // 2)
        for one, count in ((few, 1000), (many, arguments.many)):
            with RawClient(one.endpoint, timeout=600.0) as client:
                for row in range(-(-count // side)):
                    client.area(
                        ["box", 1.0, 20.0 * row + 1.0, 20.0 * side, 20.0 * row + 2.0, None, None], wait=600.0
                    )
                    client.release()
        of_few, of_many = Warm(few, middle, middle), Warm(many, middle, middle)
        counts = [len(one.segments()) for one in (many, few)]
        compared(f"{counts[0]} segments against {counts[1]}", of_few, of_many, arguments.rounds)
        for warm in (of_roomy, of_full, of_few, of_many):
            warm.close()


if __name__ == "__main__":
    main()
