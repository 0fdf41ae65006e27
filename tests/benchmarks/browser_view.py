# SPDX-License-Identifier: Apache-2.0
"""What ``shmmap view --browser`` sends, and what it costs a client that drives beside it.

    python -m tests.benchmarks.browser_view MAP --cache-dir DIR [--places 20] [--drive 30]

MAP is best one of `tests.benchmarks.tile_map`, its layers ``voxel`` of all leaves prepared into DIR
(`shmmap prepare`).  No browser runs: `tests.support.viewer` takes what one would.

The drive is made twice, alone and with a viewer that follows it.  A cell of the driver's window is *stale*
when the page does not show it although it has been in the window for a second.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import shmmap
from shmmap.geometry import distance_to_boxes
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.viewer import Viewer

SPEED = 10.0  # m/s
RADIUS_M = 60.0
LATE_S = 1.0


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


class Follower:
    """A page that follows the driver, in a thread; counts the cells that it should have and lacks.

    Attributes
    ----------
    boxes
        (N, 4): the map's cells, metres.
    pose
        Where the driver is, x and y; None before the drive.
    looks, cells, stale
        How often the page was looked at, and the sums of cells that it should have shown and did not show.
    """

    def __init__(self, url: str, boxes: NDArray[np.float64]) -> None:
        self.boxes = boxes
        self.pose: tuple[float, float] | None = None
        self.looks = self.cells = self.stale = 0
        self.page = Viewer(url)
        self.page.look((0.0, 0.0, 30.0), (5.0, 5.0, 25.0))
        self._since: dict[int, float] = {}
        self._ends = threading.Event()
        self._taker = threading.Thread(target=self._take)

    def __enter__(self) -> Follower:
        self.page.quiet(2.0)
        self._taker.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._taker.join()
        self.page.close()

    def _take(self) -> None:
        while not self._ends.is_set():
            self.page.receive(0.1)
            if self.pose is not None:
                self._judge(*self.pose, time.monotonic())

    def _judge(self, x: float, y: float, now_s: float) -> None:
        near = np.flatnonzero(distance_to_boxes(x, y, self.boxes) <= RADIUS_M).tolist()
        self._since = {cell: self._since.get(cell, now_s) for cell in near}
        shown = {int(name.split("/")[3].partition(".")[0]) for name in self.page.clouds}
        due = {cell for cell, since_s in self._since.items() if now_s - since_s >= LATE_S}
        self.looks += 1
        self.cells += len(due)
        self.stale += len(due - shown)


def drive(one: DaemonProcess, seconds: float, row: int, *, seen: bool) -> None:
    """Drive along a street of the map, followed by a viewer or alone, and print what the driver lacked."""
    with shmmap.connect(one.endpoint, shm_dir=one.shm_dir, name="driver") as client:
        min_x, min_y, _, _ = client.bounds or (0.0, 0.0, 0.0, 0.0)
        y = min_y + 90.0 + 220.0 * row
        with shmmap.MapWindow(client, radius=RADIUS_M) as window:
            window.move_to(min_x + RADIUS_M, y, wait=60.0)
            boxes = client.metadata().boxes
            with (
                viewing(one, "--follow", "driver") if seen else nullcontext("") as url,
                Follower(url, boxes) if seen else nullcontext() as follower,
            ):
                moves = lacking = 0
                before = client.stats().counters
                began = time.monotonic()
                while (now := time.monotonic() - began) < seconds:
                    x = min_x + RADIUS_M + SPEED * now
                    window.move_to(x, y, vx=SPEED, heading=0.0)
                    moves, lacking = moves + 1, lacking + (not window.complete)
                    if follower is not None:
                        follower.pose = x, y
                    time.sleep(0.05)
                after = client.stats().counters
    names = ("prefetch_misses", "misses", "hits", "evictions")
    counted = ", ".join(f"{name} {after[name] - before[name]:,}" for name in names)
    print(f"{'with a viewer' if seen else 'alone'}: {moves} moves, {lacking} without all cells; {counted}")
    if follower is not None:
        page = follower.page
        print(f"  on the page {follower.stale} of {follower.cells:,} cells stale, in {follower.looks} looks;")
        print(f"  it has {page.points:,} points, and was sent {page.nbytes / 1e6:.1f} MB")


def main() -> None:
    """Measure as the arguments say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("--cache-dir", required=True)
    parser.add_argument("--places", type=int, default=20, help="0: the drives alone")
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
        if firsts:
            print(f"first cell: median {statistics.median(firsts):.2f} s, most {max(firsts):.2f} s")
            print(f"a place: median {statistics.median(amounts):.1f} MB, most {max(amounts):.1f} MB")
            print(f"a move of 5 m: median {statistics.median(moves):.2f} MB, most {max(moves):.2f} MB")
    for seen in (False, True):
        one = DaemonProcess(arguments.map, "--cache-dir", arguments.cache_dir, forked=False)
        with one:
            drive(one, arguments.drive, 2, seen=seen)


if __name__ == "__main__":
    main()
