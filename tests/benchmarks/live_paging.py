# SPDX-License-Identifier: Apache-2.0
"""A live map ten times as large as its memory: scans a second, and what readers wait.

    SHMMAP_TEST_DATA=DIR python -m tests.benchmarks.live_paging [--scans 200] [--state DIR]

Ten copies of the drive lie a kilometre apart; the budget is the memory of one.  Scans of 120 000 points
(voxels of 0.2 m, rays of 30 m) come from another copy each, or five from one place before the next: what one
needs is loaded, what was changed is written to the disk (flushed, in the directory ``--state``) and given up.
Printed are scans a second from the first to *applied* of the last, when all copies have been visited before;
how long 300 saved chunks take to be durable, and the same as files; and how long a reader takes to look up
1000 points, against the same map with memory for all of it.  Limits: 0.25 of the files' time; 20 scans a
second, 40 with five a stop; readers' 99th percentile twice that of the unbounded map.

Measured beside those of BENCHMARKS.md: looking up 1000 points meanwhile, 99th percentile, 8.0 to 10.8 ms
(with all of the map in memory 8.6 to 13.2 ms).
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np

import shmmap
from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import ChunkView, new_header
from shmmap.chunks.voxels import ChunkKey
from shmmap.formats.durable_file import flush_directory
from shmmap.live_worker.chunk_memory import memory_bytes
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.disk.map_record import MapSettings
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


def durable_s(folder: Path) -> tuple[float, float]:
    """Median seconds until 300 saved chunks are durable: as files, each with a name, and in the database."""
    with closing(Folder(folder / "saved")) as opened, closing(MapDatabase(opened, MapSettings())) as saved:
        key = ChunkKey(0, 0, 0)
        view = ChunkView(new_header(saved.settings.identity(saved.map_id, key, 1)))
        data = encode_chunk(view, "raw") + bytes(4 << 10)
        (files := folder / "files").mkdir()
        keys = [ChunkKey(number % 64, number // 64, 0) for number in range(1200)]
        took: tuple[list[float], list[float]] = ([], [])
        for first in (*range(0, 1200, 300), *range(0, 1200, 300)):
            some = keys[first : first + 300]
            began_s = time.perf_counter()
            for one in some:
                (files / f".{one.text}").write_bytes(data)
            for one in some:
                with open(files / f".{one.text}", "rb") as file:
                    os.fdatasync(file.fileno())
                os.rename(files / f".{one.text}", files / one.text)
            flush_directory(files)
            between_s = time.perf_counter()
            for one in some:
                saved.save(one, data)
            saved.flush()
            took[0].append(between_s - began_s)
            took[1].append(time.perf_counter() - between_s)
        return float(np.median(took[0])), float(np.median(took[1]))


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
    with closing(sqlite3.connect(folder / "map" / "map.db")) as database:
        return sum(memory_bytes(bricks) for (bricks,) in database.execute("select bricks from chunks"))


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
        as_files_s, saved_s = durable_s(Path(path))
        good &= saved_s <= 0.25 * as_files_s
        verdict = "met" if saved_s <= 0.25 * as_files_s else "MISSED"
        print(f"300 chunks durable: {1000 * saved_s:.0f} ms, as files {1000 * as_files_s:.0f} ms", end="")
        print(f"   limit 0.25: {saved_s / as_files_s:.2f} {verdict}")
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
