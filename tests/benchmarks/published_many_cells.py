# SPDX-License-Identifier: Apache-2.0
"""A published map of ten million cells over 20 Mbit/s and 50 ms: ready, the cells nearby known, memory.

    python -m tests.benchmarks.published_many_cells [--cells 10000000] [--repeats 7] [--lift]
    python -m tests.benchmarks.published_many_cells --window [--cells 1000000] [--repeats 7] [--lift]

The map is that of `tests.support.made_map`: its list of cells has the size of a recorded map's, and each part
of it is made when it is asked for (a root of ten million cells takes a minute or two before the first round).
In turns, all from the start of the process:

local       a daemon of a local map of 10 000 cells, whose list is in the cache, until it is ready
published   a daemon that never saw the published map, with an empty disk, until it is ready

Then, of the latter: from when it is ready until all cells are known to a client that connects, within 200 m
of a place where four parts of the list meet; and the daemon's memory then, without its loaders.  While it
runs on without a client, it fetches no more of the list: what it has after a minute is printed, too.

Limits: ready at most 0.6 s after the local one, cells known in 0.6 s, 100 MB; the least of the rounds.

With ``--window``, in turns: from when a daemon that never saw the map is ready until a client has all cells
within 60 m of that place; and nothing but gets of the same parts of the list, then of the same objects, over
the same link, in as many threads.  Printed are what was sent for either, too.  Limit: 1.03, least over least.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import Final

import obstore
from obstore.store import HTTPStore

import shmmap
from shmmap.daemon.loading.published_reader import CONCURRENT_FETCHES
from shmmap.origin.remote.published_index import pack_shard
from shmmap.origin.remote.published_object import POINTS as POINTS_LAYER
from shmmap.origin.remote.published_object import blob_path
from shmmap.origin.remote.zstd_frame import pack_frame
from tests.benchmarks.hostile.stage import lift
from tests.benchmarks.make_many_cells import make_many_cells
from tests.benchmarks.many_cells import seconds_to_start
from tests.support.daemon_process import DaemonProcess
from tests.support.made_map import CELL_M, SHARD_M, MadeMap, ServedMadeMap, serve_made_map
from tests.support.process_costs import processor_s, resident_bytes
from tests.support.slow_link import Plan, SlowLink, slow_link

MBIT_S: Final = 20.0
DELAY_S: Final = 0.025
RADIUS_M: Final = 200.0
LOCAL_SIDE: Final = 100
POINTS: Final = 40_000
ASK_S: Final = 0.005
LATER_S: Final = 60.0
WINDOW_M: Final = 60.0
WINDOW_LIMIT: Final = 1.03
LIMITS: Final = {"ready": 0.6, "known": 0.6, "memory": 100.0}
"""Seconds after the local one, seconds, megabytes."""


def start_local(one: DaemonProcess, *, lifted: bool) -> float:
    """Seconds until a daemon with its map's list in the cache is ready."""
    took_s = seconds_to_start(one, lifted=lifted)
    one.stop()
    return took_s


def start_published(served: ServedMadeMap, link: SlowLink, *, later: bool, lifted: bool) -> dict[str, float]:
    """Start a daemon and a client without any cache; returns what each took."""
    corner_m = served.side * CELL_M // SHARD_M // 4 * SHARD_M
    area = shmmap.Circle(corner_m, corner_m, RADIUS_M)
    before = link.received_bytes()
    one = DaemonProcess(link.endpoint)
    try:
        found = {"ready": seconds_to_start(one, lifted=lifted)}
        begin_s = time.perf_counter()
        with shmmap.connect(one.endpoint) as client:
            while not client.area(area, wait=0, strict=None).covered:
                time.sleep(ASK_S)
            found["known"] = time.perf_counter() - begin_s
        found["memory"] = resident_bytes(one.pid) / 1e6
        found["processor"] = processor_s(one.pid)
        found["received"] = (link.received_bytes() - before) / 1e6
        if later:
            time.sleep(LATER_S)
            found["later"] = resident_bytes(one.pid) / 1e6
        one.stop()
        assert not one.leftovers()
    finally:
        one.dispose()
    return found


def get_all(endpoint: str, paths: list[str]) -> None:
    """Get objects, nothing else."""
    store = HTTPStore.from_url(endpoint, client_options={"allow_http": True})
    with ThreadPoolExecutor(CONCURRENT_FETCHES) as pool:
        list(pool.map(lambda path: obstore.get(store, path).bytes(), paths))


def objects_of(made: MadeMap, area: shmmap.Circle) -> tuple[list[str], list[str]]:
    """Paths of the parts of the list, and of the cells' objects, of an area around a corner of parts."""
    corner = int(area.x / SHARD_M)
    shards = [made.shard(row, column) for row in (corner - 1, corner) for column in (corner - 1, corner)]
    parts = [blob_path(sha256(pack_frame(pack_shard(shard))).digest()) for shard in shards]
    cells = [
        blob_path(digest.tobytes())
        for shard in shards
        for digest in shard.layers[POINTS_LAYER].hashes[area.overlaps(shard.boxes)]
    ]
    return parts, cells


def first_windows(served: ServedMadeMap, cells: int, repeats: int, *, lifted: bool) -> int:
    """Compare first windows with gets, and print."""
    corner_m = served.side * CELL_M // SHARD_M // 4 * SHARD_M
    area = shmmap.Circle(corner_m, corner_m, WINDOW_M)
    parts, objects = objects_of(MadeMap(cells, POINTS), area)
    least = {"gets": math.inf, "daemon": math.inf}
    with slow_link(Plan(served.port, MBIT_S, DELAY_S)) as link:

        def noted(name: str, before: tuple[int, int, int], begin_s: float) -> None:
            took_s = time.perf_counter() - begin_s
            least[name] = min(least[name], took_s)
            now = *served.sent(), link.received_bytes()
            cells_sent, others_sent, nbytes = (one - other for one, other in zip(now, before, strict=True))
            print(
                f"{name:6} {took_s:.3f} s; sent {cells_sent} objects of cells, {others_sent} others,"
                f" {nbytes / 1e6:.3f} MB; load {os.getloadavg()[0]:.1f}",
                flush=True,
            )

        for _ in range(repeats):
            before, begin_s = (*served.sent(), link.received_bytes()), time.perf_counter()
            get_all(link.endpoint, parts)
            get_all(link.endpoint, objects)
            noted("gets", before, begin_s)
            with DaemonProcess(link.endpoint) as one:
                if lifted:
                    lift(one.pid)
                before, begin_s = (*served.sent(), link.received_bytes()), time.perf_counter()
                with shmmap.connect(one.endpoint) as client:
                    found = client.area(area, wait=300.0)
                    assert len(found.cells) == len(objects)
                    noted("daemon", before, begin_s)
    ratio = least["daemon"] / least["gets"]
    print(f"{len(parts)} parts of the list, {len(objects)} cells: {ratio:.3f} of gets (limit {WINDOW_LIMIT})")
    return int(ratio > WINDOW_LIMIT)


def main() -> int:
    """Measure, print and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, help="default: ten million, one million for the window")
    parser.add_argument("--window", action="store_true", help="first windows beside bare gets")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--lift", action="store_true", help="go before unrelated work (needs root)")
    args = parser.parse_args()
    if args.lift:
        lift(os.getpid())
    cells = args.cells or (1_000_000 if args.window else 10_000_000)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder, serve_made_map(cells, POINTS) as served:
        if args.window:
            return first_windows(served, cells, args.repeats, lifted=args.lift)
        make_many_cells(Path(folder, "map"), LOCAL_SIDE)
        local = DaemonProcess(Path(folder, "map"))
        rounds = []
        try:
            start_local(local, lifted=args.lift)
            print(
                f"{served.side**2} cells, {served.index_bytes_per_cell:.0f} bytes of list for each;"
                f" load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
            with slow_link(Plan(served.port, MBIT_S, DELAY_S)) as link:
                for number in range(args.repeats):
                    local_s = start_local(local, lifted=args.lift)
                    is_last = number == args.repeats - 1
                    found = start_published(served, link, later=is_last, lifted=args.lift)
                    rounds.append({"local": local_s, **found})
                    print(
                        f"local {local_s:.2f} s, published {found['ready']:.2f} s;"
                        f" known {found['known']:.2f} s,"
                        f" {found['memory']:.0f} MB, {found['received']:.2f} MB received;"
                        f" processor {found['processor']:.2f} s; load {os.getloadavg()[0]:.1f}",
                        flush=True,
                    )
        finally:
            local.dispose()
    least = {name: min(each[name] for each in rounds) for name in ("local", "ready", "known", "memory")}
    least["ready"] -= least["local"]
    held = all(least[name] <= limit for name, limit in LIMITS.items())
    print(
        f"ready {least['ready']:.2f} s after the local one ({least['local']:.2f} s; limit {LIMITS['ready']}),"
        f" cells within {RADIUS_M:.0f} m known after {least['known']:.2f} s (limit {LIMITS['known']}),"
        f" {least['memory']:.0f} MB (limit {LIMITS['memory']:.0f}); a minute later"
        f" {rounds[-1]['later']:.0f} MB; limits {'held' if held else 'NOT HELD'}"
    )
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
