# SPDX-License-Identifier: Apache-2.0
"""Does a control loop notice when its window swaps hundreds of cells?

A loop calls ``move_to`` and ``points_around`` at a fixed rate; every so often the pose jumps, so that a
whole window of cells is replaced.  Compared are the loop's own times while nothing is asked
("still") and while cells are attached and unmapped ("swap"), in the same run; and, to see what part the
interpreter and the machine have in it, while another thread merely computes ("busy").

    python -m tests.benchmarks.window_swap [--seconds 8] [--cells 256] [--points 2000] [--rate 1000]
"""

from __future__ import annotations

import argparse
import math
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import shmmap
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import make_map


def loop(window: shmmap.MapWindow, poses: list[float], seconds: float, rate: float) -> list[int]:
    """Run the control loop, the pose jumping to the next one every 0.25 s; nanoseconds of each turn."""
    took = []
    began = time.perf_counter()
    turn = 0
    while (now := time.perf_counter()) - began < seconds:
        x = poses[int((now - began) / 0.25) % len(poses)]
        start = time.perf_counter_ns()
        window.move_to(x, 0.0, vx=10.0)
        around = window.points_around(x, 0.0, 50.0)
        sum(len(view) for view in around)
        took.append(time.perf_counter_ns() - start)
        turn += 1
        time.sleep(max(0.0, began + turn / rate - time.perf_counter()))  # the loop's rate, as in a vehicle
    return took


def busy_loop(window: shmmap.MapWindow, pose: float, seconds: float, rate: float) -> list[int]:
    """Run the loop while another Python thread computes all the time."""
    stop = threading.Event()

    def compute() -> None:
        while not stop.is_set():
            sum(range(1000))

    thread = threading.Thread(target=compute)
    thread.start()
    try:
        return loop(window, [pose], seconds, rate)
    finally:
        stop.set()
        thread.join()


def summary(took: list[int]) -> dict[str, float]:
    """Microseconds."""
    p50, p99, p999 = (float(value) / 1e3 for value in np.percentile(took, [50, 99, 99.9]))
    return {"turns": len(took), "p50": p50, "p99": p99, "p99.9": p999, "max": max(took) / 1e3}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--cells", type=int, default=256, help="cells replaced by one jump, at least")
    parser.add_argument("--points", type=int, default=2000, help="points of a cell")
    parser.add_argument("--rate", type=float, default=1000.0, help="turns of the loop, 1/s")
    args = parser.parse_args()
    rows = 2 * math.ceil(math.sqrt(args.cells) / 2)
    radius = rows * 10.0 - 0.01
    # two windows side by side; the square's corners lie inside, so that each holds rows x rows cells
    with tempfile.TemporaryDirectory() as directory:
        made = make_map(Path(directory) / "map", columns=2 * rows, rows=rows, points=args.points)
        daemon = DaemonProcess(made.root)
        try:
            daemon.start()
            with shmmap.connect(daemon.endpoint, timeout=60) as client:
                everything = client.area(shmmap.Box(-1e5, -1e5, 1e5, 1e5), wait=120.0)
                assert everything.complete
                del everything
                left, right = -rows * 10.0, rows * 10.0
                with shmmap.MapWindow(client, radius, shape="square", refresh_interval=1e6) as window:
                    window.move_to(left, 0.0, wait=60.0)
                    first = {cell.id for cell in window.cells}
                    window.move_to(right, 0.0, wait=60.0)
                    swapped = len(first - {cell.id for cell in window.cells})
                    still, swap = [], []
                    for _ in range(4):  # alternating, so that what else the machine does meets both
                        still += loop(window, [right], args.seconds / 8, args.rate)
                        swap += loop(window, [left, right], args.seconds / 8, args.rate)
                    busy = busy_loop(window, right, args.seconds / 4, args.rate)
        finally:
            daemon.stop()
            daemon.dispose()
    print(f"{swapped} cells replaced by a jump; times of one turn of the loop")
    p99_still = summary(still)["p99"]
    for name, times in (("still", still), ("swap", swap), ("busy", busy)):
        figures = summary(times)
        numbers = "".join(f"  {key} {value:8.1f} us" for key, value in figures.items() if key != "turns")
        print(f"{name:5}{len(times):7} turns{numbers}   p99 is {figures['p99'] / p99_still:.2f} x still")


if __name__ == "__main__":
    main()
