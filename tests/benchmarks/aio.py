# SPDX-License-Identifier: Apache-2.0
"""What a request costs in asyncio (`shmmap.aio`), beside the same one of the client that waits.

    python -m tests.benchmarks.aio [--pairs 20]

``around(radius=50)``, whose cells are held, and a differential that brings nothing are timed; rounds of both
clients take turns, in one process and on one daemon.  Printed are the medians of the rounds' medians and of
the paired ratios; and what a request takes while a hundred tasks ask on one session.
"""

from __future__ import annotations

import argparse
import asyncio
import statistics
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import shmmap
import shmmap.aio
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

ROUND = 200
TASKS = 100


def p50_us(times: list[float]) -> float:
    """Return the median, microseconds."""
    return statistics.median(times) * 1e6


def sync_round(work: Callable[[], object]) -> float:
    """Return the median of a round of the client that waits."""
    times = []
    for _ in range(ROUND):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return p50_us(times)


async def aio_round(work: Callable[[], Awaitable[object]]) -> float:
    """Return the median of a round in the loop."""
    times = []
    for _ in range(ROUND):
        start = time.perf_counter()
        await work()
        times.append(time.perf_counter() - start)
    return p50_us(times)


async def measure(endpoint: str, pairs: int) -> None:
    """Take turns, and print."""
    area = shmmap.Circle(0.0, 0.0, 50.0)
    with shmmap.connect(endpoint) as sync:
        async with shmmap.aio.connect(endpoint) as client:
            held = {None: sync.area(area, wait=60).cells, client: (await client.area(area)).cells}
            for name, here, there in (
                ("around", lambda: sync.around(0.0, 0.0, 50.0), lambda: client.around(0.0, 0.0, 50.0)),
                (
                    "differential",
                    lambda: sync.differential(area, held[None]),
                    lambda: client.differential(area, held[client]),
                ),
            ):
                found = []
                for number in range(pairs):
                    if number % 2:
                        found.append((sync_round(here), await aio_round(there)))
                    else:
                        theirs = await aio_round(there)
                        found.append((sync_round(here), theirs))
                ratio = statistics.median(theirs / mine for mine, theirs in found)
                mine, theirs = (statistics.median(column) for column in zip(*found, strict=True))
                print(f"{name:12} {theirs:7.0f} us, waiting {mine:7.0f} us, ratio {ratio:.3f}", flush=True)
            start = time.perf_counter()
            await asyncio.gather(*(aio_round(lambda: client.around(0.0, 0.0, 50.0)) for _ in range(TASKS)))
            took_us = (time.perf_counter() - start) / (TASKS * ROUND) * 1e6
            print(f"{TASKS} tasks {took_us:7.0f} us a request")


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=20)
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        made = make_map(Path(folder, "map"), columns=20, rows=20, points=30)
        with DaemonProcess(made.root, "--workers", "1") as one:
            asyncio.run(measure(str(one.endpoint), options.pairs))


if __name__ == "__main__":
    main()
