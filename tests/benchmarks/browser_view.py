# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap view --browser`` sends, and what it costs a client that drives beside it.

    python -m tests.benchmarks.browser_view MAP --cache-dir DIR [--places 20] [--drive 30]

MAP is best one of `tests.benchmarks.tile_map`, its layers ``voxel`` of all leaves prepared into DIR
(`shmmap prepare`).  No browser runs: `tests.support.viewer` takes what one would.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import shmmap
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.viewer import Viewer

SPEED = 10.0  # m/s


@contextmanager
def viewing(one: DaemonProcess, *words: str) -> Iterator[str]:
    """Run the verb; yields the page's address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "shmmap.cli", "view", "--browser", "--listen", "0", *words],
        env={**os.environ, "PYTHONPATH": str(ROOT), "SHMMAP_ENDPOINT": one.endpoint},
        stdout=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield process.stdout.readline().split()[-1]
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(10)


def drive(one: DaemonProcess, seconds: float, row: int) -> dict[str, int]:
    """Drive along a street of the map, points and an ``ndt`` layer in the window; returns counters."""
    with shmmap.connect(one.endpoint, shm_dir=one.shm_dir, name="driver") as client:
        before = client.stats().counters
        min_x, min_y, _, _ = client.bounds or (0.0, 0.0, 0.0, 0.0)
        y = min_y + 90.0 + 220.0 * row
        with shmmap.MapWindow(client, radius=60.0) as window:
            window.move_to(min_x + 60.0, y, wait=60.0)
            began = time.monotonic()
            while (now := time.monotonic() - began) < seconds:
                window.move_to(min_x + 60.0 + SPEED * now, y, vx=SPEED, heading=0.0)
                time.sleep(0.05)
        after = client.stats().counters
    return {name: after[name] - before[name] for name in ("hits", "misses", "prefetch_misses", "evictions")}


def main() -> None:
    """Measure as the arguments say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("--cache-dir", required=True)
    parser.add_argument("--places", type=int, default=20)
    parser.add_argument("--most", type=float, default=60.0, help="seconds that a place may take")
    parser.add_argument("--drive", type=float, default=30.0)
    arguments = parser.parse_args()
    random = np.random.default_rng(7)
    one = DaemonProcess(arguments.map, "--cache-dir", arguments.cache_dir, forked=False)
    with one, shmmap.connect(one.endpoint, shm_dir=one.shm_dir) as client:
        cells = client.metadata()
        boxes = cells.boxes
        print(f"{len(boxes):,} cells, {sum(cell.source_bytes for cell in cells) / 1e9:.1f} GB")
        with viewing(one) as url:
            firsts, amounts, moves = [], [], []
            for number in range(arguments.places):
                with Viewer(url) as page:
                    page.look((0.0, 0.0, 30.0))
                    while "/map" not in page.positions:
                        page.receive(5.0)
                    origin = -np.array(page.positions["/map"])
                    box = boxes[random.integers(len(boxes))]
                    place = np.array([*(box[:2] + 10.0), origin[2] + random.choice([3.0, 15.0, 60.0, 300.0])])
                    x, y, z = (place - origin).tolist()
                    before = page.nbytes
                    page.look((x, y, z), (x + 5.0, y + 5.0, z - 5.0))
                    page.quiet(4.0, arguments.most)
                    amounts.append((page.nbytes - before) / 1e6)
                    firsts.append(page.first_s)
                    points, before = page.points, page.nbytes
                    page.look((x + 5.0, y, z), (x + 10.0, y + 5.0, z - 5.0))
                    page.quiet(4.0, arguments.most)
                    moves.append((page.nbytes - before) / 1e6)
                    print(
                        f"place {number}: eye {z:.0f} m up, first {firsts[-1]:.2f} s, {points:,} points,"
                        f" {amounts[-1]:.1f} MB, a move of 5 m {moves[-1]:.2f} MB",
                        flush=True,
                    )
        print(f"first cell: median {statistics.median(firsts):.2f} s, most {max(firsts):.2f} s")
        print(f"a place: median {statistics.median(amounts):.1f} MB, most {max(amounts):.1f} MB")
        print(f"a move of 5 m: median {statistics.median(moves):.2f} MB, most {max(moves):.2f} MB")
    for beside in (False, True):
        one = DaemonProcess(arguments.map, "--cache-dir", arguments.cache_dir, forked=False)
        with one:
            if not beside:
                print("alone:", drive(one, arguments.drive, 2))
                continue
            with viewing(one) as url, Viewer(url) as page:
                import threading

                page.look((0.0, 0.0, 200.0))
                ends = threading.Event()

                def take(page: Viewer = page, ends: threading.Event = ends) -> None:
                    while not ends.is_set():
                        page.receive(0.1)

                taker = threading.Thread(target=take)
                taker.start()
                try:
                    print("with a viewer:", drive(one, arguments.drive, 2))
                finally:
                    ends.set()
                    taker.join()
                print(f"  it got {page.points:,} points, {page.nbytes / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
