# SPDX-License-Identifier: Apache-2.0
"""A warm request of a client whose other requests wait, and what cancelled ones leave behind.

    python -m tests.benchmarks.many_requests [--pairs 20] [--cancelled 10000]

A warm differential that brings some 30 cells is timed as it is (nothing else is under way), as a future, and
as it is beside 64 futures that wait for loads, while the loader stands still.  Rounds take turns, each beside
one of the first kind; printed are the medians of their 10th percentiles and of the paired ratios.  Then
many futures that wait are cancelled; printed is after how long neither client nor daemon has any left.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import shmmap
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map

ROUND = 200
WAITING = 64
WAIT_S = 3600.0


def p10_us(work: Callable[[], object]) -> float:
    """Return the 10th percentile of a round, microseconds."""
    times = []
    for _ in range(ROUND):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.percentile(times, 10)) * 1e6


def seconds_to_forget(client: shmmap.Client, count: int) -> float:
    """Cancel ``count`` futures that wait; return after how many seconds nothing is left of them."""
    futures = [client.futures.around(180, 180, 5, wait=WAIT_S) for _ in range(count)]
    start = time.perf_counter()
    for future in futures:
        future.cancel()
    connection = client.session._connection
    assert connection is not None
    while connection._exchange.table.is_busy or connection._exchange.withdrawn:
        time.sleep(0.001)
    client.stats()  # the daemon has read what was sent before
    return time.perf_counter() - start


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--cancelled", type=int, default=10_000)
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        made = make_map(Path(folder, "map"), columns=20, rows=20, points=30)
        with (
            DaemonProcess(made.root, "--workers", "1") as one,
            shmmap.connect(one.endpoint) as alone,
            shmmap.connect(one.endpoint) as client,
        ):
            area = shmmap.Circle(0.0, 0.0, 60.0)
            held = {which: which.area(area, wait=60).cells for which in (alone, client)}  # stay attached

            def ask(which: shmmap.Client) -> shmmap.CellSet:
                return which.differential(area, held[which][:10])

            def as_future() -> shmmap.CellSet:
                return client.futures.differential(area, held[client][:10]).result()

            for name, work in (("as a future", as_future), (f"beside {WAITING}", lambda: ask(client))):
                if work is not as_future:
                    standing = one.stop_loaders()
                    waiting = [client.futures.around(180, 180, 5, wait=WAIT_S) for _ in range(WAITING)]
                pairs = []
                for number in range(options.pairs):
                    both = [lambda: ask(alone), work]
                    times = [p10_us(one) for one in (both if number % 2 else both[::-1])]
                    pairs.append(times if number % 2 else times[::-1])
                ratio = statistics.median(theirs / mine for mine, theirs in pairs)
                mine, theirs = (statistics.median(column) for column in zip(*pairs, strict=True))
                print(f"{name:12} {theirs:7.0f} us, alone {mine:7.0f} us, ratio {ratio:.3f}", flush=True)
            for future in waiting:
                future.cancel()
            print(f"{options.cancelled} cancelled: {seconds_to_forget(client, options.cancelled):.2f} s")
            for pid in standing:
                os.kill(pid, signal.SIGCONT)


if __name__ == "__main__":
    main()
