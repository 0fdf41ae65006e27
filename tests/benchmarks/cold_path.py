# SPDX-License-Identifier: Apache-2.0
"""Cells that are not in memory yet: how long clients wait for them.

    python -m tests.benchmarks.cold_path [cell step window moving] [--against ../other] [--pairs 20]
                                         [--shm-dir DIR]

- ``cell``: one cold cell of 1 MB, from the request to its attached view; the loaders run already.
- ``step``: two such cells at once.
- ``window``: four consumers need the same 120 MB as soon as a daemon is READY, until the last one has read
  all points; against four that read the files into memory of their own.  Shown three times: as it is, with
  the processor time that the loaders' processes had used before READY added, and for four more that find
  everything in memory, which is what of it has nothing to do with loading.

- ``moving``: a vehicle drives off at 20 m/s as soon as a daemon is READY, its window of 100 m cold: until the
  window is complete for the first time; and for which part of the 15 s after that it is not.

``--shm-dir`` is where segments lie: for huge pages a tmpfs mounted with ``huge=within_size``.

With ``--against``, another checkout (see `tests.benchmarks.two_versions`) takes turns.  Printed are medians,
and medians of the paired ratios.  Limits: the window in 0.65 of private copies on 4 KiB pages, 0.5 on huge
ones; a cell in 3.5 ms, and in 0.8 of the time of version 0.2.0; a step in 5 ms on huge pages.

Measured beside those of BENCHMARKS.md: ``moving`` 0.080 s, and 0.20 % of the time after that (0.2.0: 0.169 s,
1.13 %); the window with the processor time before READY in 0.82 to 0.88 of private copies.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
from pathlib import Path

from tests.benchmarks.two_versions import Measuring
from tests.support.daemon_process import ROOT
from tests.support.divided_map import make_map

POINTS = 62_500  # of 16 bytes each

_CELL = """
import sys, time
import shmmap
from tests.support.daemon_process import DaemonProcess
one = DaemonProcess(sys.argv[1], "--budget", "1G", shm_dir=sys.argv[2] or None).start()
count = int(sys.argv[3])
client = shmmap.connect(one.endpoint)
names = [cell.id for cell in client.around(0, 0, radius=500)]
print("up", flush=True)
for line in sys.stdin:
    client.evict()
    while client.stats().counters["zombies"]:
        pass
    took = []
    for first in range(20):
        before = time.perf_counter()
        found = client.selected(names[count * first : count * (first + 1)])
        clouds = [cell.xyz for cell in found]
        took.append(time.perf_counter() - before)
        assert [cloud.shape for cloud in clouds] == [(62500, 3)] * count
        del found, clouds
    print(sorted(took)[len(took) // 2] * 1e3, flush=True)
client.close()
one.stop()
one.dispose()
"""

_CONSUMER = """
import os, sys
from pathlib import Path
import numpy as np
from shmmap import connect  # the client's modules, as those that private copies take, before it begins
from shmmap.layers.contract import BUILT_ANYWHERE
from shmmap.layers.sources import read_source
paths = sorted(str(path) for path in Path(sys.argv[1]).glob("**/*.pcd") if path.is_file())
print("up", flush=True)
for line in sys.stdin:
    what = line.strip()
    if what == "private":
        kept = [read_source(path, BUILT_ANYWHERE, None).points.columns for path in paths]
        clouds = [columns["xyz"] for columns in kept]
    else:
        client = connect(what)
        kept = client.around(0, 0, radius=500, wait=60.0).raise_for_failures()
        clouds = [cell.xyz for cell in kept]
    total = sum(float(cloud.sum(dtype=np.float64)) for cloud in clouds)
    print(len(clouds), sum(map(len, clouds)), flush=True)
"""

_WINDOW = """
import json, os, subprocess, sys, time
from tests.support.daemon_process import DaemonProcess
ticks = os.sysconf("SC_CLK_TCK")
def cpu_s(pid):
    words = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
    return (int(words[11]) + int(words[12])) / ticks
def consumers():
    started = [
        subprocess.Popen([sys.executable, "-c", sys.argv[2], sys.argv[1]],
                         stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(4)
    ]
    for one in started:
        assert one.stdout.readline().strip() == "up"
    return started
def served(started, what):
    before = time.perf_counter()
    for one in started:
        one.stdin.write(what + "\\n")
        one.stdin.flush()
    said = {one.stdout.readline() for one in started}
    took = time.perf_counter() - before
    assert said == {"120 7500000\\n"}, said
    for one in started:
        one.communicate()
    return took
print("up", flush=True)
for line in sys.stdin:
    waiting = consumers()
    if line.strip() == "private":
        print(json.dumps([served(waiting, "private")]), flush=True)
        continue
    one = DaemonProcess(sys.argv[1], "--budget", "1G", shm_dir=sys.argv[3] or None).start()
    before_s = sum(map(cpu_s, one.children()))
    took = served(waiting, one.endpoint)
    again = served(consumers(), one.endpoint)
    one.stop()
    one.dispose()
    print(json.dumps([took, took + before_s, again]), flush=True)
"""

_MOVING = """
import json, sys, time
import shmmap
from tests.support.daemon_process import DaemonProcess
print("up", flush=True)
for line in sys.stdin:
    one = DaemonProcess(sys.argv[1], "--budget", "1G", shm_dir=sys.argv[2] or None).start()
    with shmmap.MapWindow(one.endpoint, radius=100.0) as window:
        begin, first, turns, incomplete = time.perf_counter(), 0.0, 0, 0
        while True:
            now = time.perf_counter() - begin
            if first and now > first + 15.0:
                break
            window.move_to(-300.0 + 20.0 * now, 0.0, vx=20.0)
            if not first and window.complete:
                first = now
            turns, incomplete = turns + bool(first), incomplete + (bool(first) and not window.complete)
            time.sleep(0.002)
    one.stop()
    one.dispose()
    print(json.dumps([first, incomplete / turns]), flush=True)
"""


def ratio(some: list[float], others: list[float]) -> float:
    """Return the median of the paired ratios."""
    return statistics.median(mine / other for mine, other in zip(some, others, strict=True))


def cold_cells(folder: Path, checkouts: list[Path], pairs: int, shm_dir: str, count: int) -> None:
    """Measure and print how long one cold cell takes, or two at once."""
    made = make_map(folder / "cells", columns=8, rows=8, points=POINTS)
    programs = [Measuring(checkout, _CELL, str(made.root), shm_dir, str(count)) for checkout in checkouts]
    times: list[list[float]] = [[] for _ in checkouts]
    for number in range(pairs + 1):
        for at in range(len(programs))[:: -1 if number % 2 else 1]:
            found = float(programs[at].measure())
            if number:  # the first one warms up
                times[at].append(found)
    for program in programs:
        program.close()
    limit = "3.5 ms, 0.8 of 0.2.0" if count == 1 else "5 ms on huge pages"
    print(f"cold cells of 1 MB, {count} at once, medians of {pairs} times 20 (limit {limit})")
    for checkout, values in zip(checkouts, times, strict=True):
        line = f"  {statistics.median(values):6.2f} ms  least {min(values):5.2f}"
        line += f"  {ratio(times[0], values):5.2f} of it here" if checkout != ROOT else "  here"
        print(f"{line}  {checkout}")


def first_window(folder: Path, checkouts: list[Path], pairs: int, shm_dir: str) -> None:
    """Measure and print how long the first window of four consumers takes."""
    made = make_map(folder / "window", columns=12, rows=10, points=POINTS)
    programs = [Measuring(checkout, _WINDOW, str(made.root), _CONSUMER, shm_dir) for checkout in checkouts]
    shared: list[list[list[float]]] = [[] for _ in checkouts]
    private: list[float] = []
    for number in range(pairs + 1):
        found = [json.loads(program.measure("shared")) for program in programs]
        alone = json.loads(programs[0].measure("private"))[0]
        if number:
            private.append(alone)
            for values, times in zip(shared, found, strict=True):
                values.append(times)
    for program in programs:
        program.close()
    print(f"first window of 120 MB, four consumers, medians of {pairs} (limit 0.65, on huge pages 0.5)")
    print(f"  {statistics.median(private):6.3f} s  private copies")
    for checkout, found in zip(checkouts, shared, strict=True):
        took, whole, again = [list(values) for values in zip(*found, strict=True)]
        print(
            f"  {statistics.median(took):6.3f} s  {ratio(took, private):5.2f} of that;"
            f" with processor time before READY {ratio(whole, private):5.2f};"
            f" all in memory {ratio(again, private):5.2f}  {checkout}"
        )


def moving(folder: Path, checkouts: list[Path], pairs: int, shm_dir: str) -> None:
    """Measure and print how soon a vehicle that drives off at once has its window, and how often not."""
    made = make_map(folder / "street", columns=40, rows=14, points=POINTS // 4)
    programs = [Measuring(checkout, _MOVING, str(made.root), shm_dir) for checkout in checkouts]
    found: list[list[list[float]]] = [[] for _ in checkouts]
    for number in range(pairs + 1):
        for at in range(len(programs))[:: -1 if number % 2 else 1]:
            times = json.loads(programs[at].measure())
            if number:
                found[at].append(times)
    for program in programs:
        program.close()
    print(f"a vehicle that drives off at once, medians of {pairs}")
    here = [times[0] for times in found[0]]
    for checkout, rows in zip(checkouts, found, strict=True):
        first, incomplete = [list(values) for values in zip(*rows, strict=True)]
        print(
            f"  {statistics.median(first):6.3f} s until its window is complete;"
            f" here {ratio(here, first):5.2f} of that;"
            f" then incomplete {100 * statistics.median(incomplete):5.2f} % of the time  {checkout}"
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "what", nargs="*", default=["cell", "step", "window"], metavar="cell step window moving"
    )
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--shm-dir", default="", help="where segments lie (default: a directory in /dev/shm)")
    parser.add_argument("--pairs", type=int, default=20)
    args = parser.parse_args()
    checkouts = [ROOT, *([args.against.resolve()] if args.against else [])]
    print(f"load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for count, what in enumerate(("cell", "step"), 1):
            if what in args.what:
                cold_cells(folder / what, checkouts, args.pairs, args.shm_dir, count)
        if "window" in args.what:
            first_window(folder, checkouts, max(3, args.pairs // 3), args.shm_dir)
        if "moving" in args.what:
            moving(folder, checkouts, max(3, args.pairs // 3), args.shm_dir)


if __name__ == "__main__":
    main()
