# SPDX-License-Identifier: Apache-2.0
"""A live map ten times as large as its memory: scans a second, and what readers wait.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.live_paging [--scans 200] [--state DIR]

Ten copies of the drive lie a kilometre apart; the budget is the memory of one.  Scans of 120 000 points
(voxels of 0.2 m, rays of 30 m) come from another copy each, or five from one place before the next: what one
needs is loaded, what was changed is written to the disk (flushed, in the directory ``--state``) and given up.
Printed are scans a second from the first to *applied* of the last, when all copies have been visited before;
the disk's own rate of small files that are written, flushed and renamed; and how long a reader takes to look
up 1000 points, against the same map with memory for all of it.  Limits: 20 scans a second, 40 with five a
stop; readers' 99th percentile twice that of the unbounded map.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

import shmmap
from shmmap.chunks.chunk_file import read_file_header
from shmmap.daemon.live.chunk_memory import memory_bytes
from tests.support.live_bench import (
    FILTER,
    MAP,
    Beside,
    Scan,
    live_daemon,
    percentiles,
    reading,
    scans_of_the_street,
)

COPIES = 10
APART_M = 1000.0
READER_S = 0.02
FLUSHES = 100
LIMITS = {1: 20.0, 5: 40.0}


def order(scans: list[Scan], count: int, stay: int) -> list[Scan]:
    """Take ``count`` scans, ``stay`` from each place before the next copy's turn."""
    found = []
    for number in range(count):
        stop, at = divmod(number, stay)
        points, pose = scans[(stop // COPIES * stay + at) % len(scans)]
        there = pose.copy()
        there[0, 3] += stop % COPIES * APART_M
        found.append((points, there))
    return found


def disk_rate(folder: Path) -> float:
    """Files of 20 KiB a second, each written, flushed and renamed, one after the other."""
    data = os.urandom(20 << 10)
    began = time.perf_counter()
    for number in range(FLUSHES):
        fd = os.open(folder / "interim", os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        os.write(fd, data)
        os.fsync(fd)
        os.close(fd)
        os.rename(folder / "interim", folder / f"file{number % 10}")
    return FLUSHES / (time.perf_counter() - began)


def drive(
    endpoint: str, stack: ExitStack, scans: list[Scan], count: int, stay: int
) -> tuple[float, list[float]]:
    """Scans a second, and what a reader waited meanwhile."""
    reader = Beside(stack, reading, endpoint, READER_S)
    with shmmap.connect(endpoint) as client, client.live(MAP).mapper("benchmark", FILTER) as mapper:
        for points, pose in order(scans, COPIES * stay, stay):  # each copy once before
            mapper.add(points, pose)
        mapper.wait_applied()
        todo = order(scans, count, stay)
        reader.start()
        began = time.perf_counter()
        for points, pose in todo:
            mapper.add(points, pose)
        mapper.wait_applied()
        took = time.perf_counter() - began
        return count / took, reader.stop()


def memory_of_one(folder: Path, scans: list[Scan]) -> int:
    """Bytes that the chunks of one copy take."""
    with ExitStack() as stack:
        one = live_daemon(stack, folder, "", "--live-budget", "1G")
        with shmmap.connect(one.endpoint) as client, client.live(MAP).mapper("benchmark", FILTER) as mapper:
            for points, pose in scans:
                mapper.add(points, pose)
            mapper.wait_durable()
    files = (folder / "map").glob("*.chunk")
    return sum(memory_bytes(read_file_header(path.read_bytes()).bricks) for path in files)


def main() -> int:
    """Measure and print; 1 if a limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--state", help="directory on the disk that is to be measured")
    args = parser.parse_args()
    scans = scans_of_the_street()
    print(f"load {os.getloadavg()[0]:.2f}; {len(scans)} scans of the street, {COPIES} copies")
    good = True
    with tempfile.TemporaryDirectory(prefix="live_paging.", dir=args.state) as path:
        print(f"the disk: {disk_rate(Path(path)):.0f} files of 20 KiB a second, flushed one after the other")
        budget = max(memory_of_one(Path(path) / "one", scans), 4 << 20)
        for stay, limit in LIMITS.items():
            waited = {}
            for name, most in (("paged", budget), ("unbounded", 2 << 30)):
                with ExitStack() as stack:
                    state = Path(path) / f"{name}{stay}"
                    linger_s = 2.0 if name == "paged" else 3600.0  # all of it stays in memory
                    one = live_daemon(stack, state, "", "--live-budget", str(most), linger_s=linger_s)
                    rate, waited[name] = drive(one.endpoint, stack, scans, args.scans, stay)
                line = f"{stay} a stop, {name:9} {most / 2**20:6.1f} MiB: {rate:6.1f} scans a second"
                if name == "paged":
                    good &= rate >= limit
                    line += f"   limit {limit:g}: {'met' if rate >= limit else 'MISSED'}"
                print(line)
                print(f"    a reader: {percentiles(waited[name])}", flush=True)
            paged, free = (float(np.percentile(waited[name], 99)) for name in ("paged", "unbounded"))
            good &= paged <= 2 * free
            verdict = "met" if paged <= 2 * free else "MISSED"
            print(f"    its p99 is {paged / free:.2f} times as long   limit 2: {verdict}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
