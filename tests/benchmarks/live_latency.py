# SPDX-License-Identifier: Apache-2.0
"""From a scan to *applied* at 10 Hz, and the daemon's warm requests meanwhile.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.live_latency [--seconds 30] [--rounds 3]

A mapper in a process of its own marks scans of 120 000 points (voxels of 0.2 m, rays of 30 m), sends them to
the daemon, and waits for the answer: by then no death of a process takes the scan away.  The time is from
handing over the points to that; and the same while another process has all of it saved twice a second.
Limit: 99th percentile at most 30 ms.

The request is the packed one of `tests.benchmarks.warm_request`, one each 2 ms, in rounds with mapping and
without it.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import shmmap
from tests.benchmarks.street_data import data_dir
from tests.benchmarks.warm_request import Warm
from tests.support.divided_map import make_map
from tests.support.live_bench import MAP, Beside, live_daemon, mapping, percentiles

PERIOD_S = 0.1
REQUEST_S = 0.002
SAVE_S = 0.5
LIMIT_S = 0.030


def ask(warm: Warm, seconds: float) -> list[float]:
    """Seconds of each of the requests in that time."""
    found = []
    end_s = time.perf_counter() + seconds
    while (began := time.perf_counter()) < end_s:
        warm.client.socket.send(warm.requests["packed"])
        warm.client.socket.recv()
        found.append(time.perf_counter() - began)
        time.sleep(max(0.0, began + REQUEST_S - time.perf_counter()))
    return found


def saving(endpoint: str) -> Callable[[], float]:
    """Have all of the map saved, each time."""
    live = shmmap.connect(endpoint).live(MAP)

    def work() -> float:
        began = time.perf_counter()
        live.save()
        return time.perf_counter() - began

    return work


def main() -> int:
    """Measure and print; 1 if the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="of each round")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    data_dir()  # it says what is missing
    print(f"load {os.getloadavg()[0]:.2f}")
    alone: list[float] = []
    beside: list[float] = []
    scans: list[float] = []
    both: list[float] = []
    beside_saves: list[float] = []
    saves: list[float] = []
    with tempfile.TemporaryDirectory(prefix="live_latency.") as path, ExitStack() as stack:
        made = make_map(Path(path) / "map", columns=20, rows=20, points=30)
        one = live_daemon(stack, Path(path) / "state", made.root, "--budget", "1G", "--live-budget", "512M")
        mapper = Beside(stack, mapping, one.endpoint, PERIOD_S)
        saver = Beside(stack, saving, one.endpoint, SAVE_S)
        warm = Warm(one)
        stack.callback(warm.close)
        for _ in range(args.rounds):
            alone += ask(warm, args.seconds)
            mapper.start()
            time.sleep(args.seconds)
            scans += mapper.stop()
            mapper.start()
            saver.start()
            time.sleep(args.seconds)
            saves += saver.stop()
            beside_saves += mapper.stop()
            mapper.start()
            beside += ask(warm, args.seconds)
            both += mapper.stop()
    met = sorted(scans)[int(0.99 * len(scans))] <= LIMIT_S
    print(f"scan to applied                 {percentiles(scans)}   limit 30: {'met' if met else 'MISSED'}")
    print(f"the same, while all is saved    {percentiles(beside_saves)}")
    print(f"all of it saved                 {percentiles(saves)}")
    print(f"the same, beside requests       {percentiles(both)}")
    print(f"warm request, no mapper         {percentiles(alone)}")
    print(f"warm request, while one maps    {percentiles(beside)}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
