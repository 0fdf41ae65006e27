# SPDX-License-Identifier: Apache-2.0
"""Which cells are still in memory when a vehicle comes back, by what is evicted when memory is short.

    python -m tests.benchmarks.eviction_traces [--quick]

A vehicle asks for a circle of 200 m every 20 m (12 m/s, cells of 20 m).  Of the cells that come into the
circle, those still in memory are hits; those inside are never evicted.  What is evicted is chosen by an exact
sort by the daemon's own scores (its order of segments differs from that by scores that are a little out of
date).  "no route" knows where the vehicle is, "route" its whole route, too.  For comparison, "lru" evicts the
least recently used cell, and "belady" knows when each cell will be asked for: nothing has more hits where all
cells are equally large.

Traces: ten rounds of a loop of 2.9 km, five of one of 9.9 km, three times 5.5 km there and back, 60 km
of a taxi by chance, two taxis with one memory, and cells of different sizes (log-normal, sigma 1).

Checked: "route" has at least the hits of "lru", and on loops 0.9 of "belady"'s; "no route" at most 0.5
percentage points fewer than "lru".
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections import deque
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.evictor import eviction_scores
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import NOWHERE, merged_places, places_of
from shmmap.geometry import Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import Intent
from tests.benchmarks.slow_origin_drives import Drive, city_path, dense_catalogue, rounded, travelled_m

RADIUS_M, STEP_M, SPEED_MPS = 200.0, 20.0, 12.0
STREET_M = 160.0
MEAN_BYTES = 1 << 20
COLUMNS = ("lru", "no route", "route", "belady")

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


class Trace(NamedTuple):
    """Where vehicles go: one way each, (N, 2) places a step apart; all are as long."""

    name: str
    ways: tuple[Floats, ...]
    sizes: bool = False


@dataclass(frozen=True)
class Prepared:
    """A trace on its map.

    Attributes
    ----------
    windows
        For each step, of each vehicle, the cells in its circle.
    uses
        For each cell, the steps at which it comes into a circle.
    """

    trace: Trace
    catalogue: Catalogue
    nbytes: NDArray[np.int64]
    windows: tuple[tuple[Indices, ...], ...]
    uses: dict[int, list[int]]


def _spaced(path: Floats) -> Floats:
    """Places a step apart along a path."""
    along = travelled_m(path)
    marks = np.arange(0.0, along[-1], STEP_M)
    return np.column_stack([np.interp(marks, along, column) for column in path.T])


def _streets(corners: list[tuple[float, float]]) -> Floats:
    return rounded(np.array(corners) * STREET_M, 12.0)


def _loop(width: float, height: float, rounds: int) -> Floats:
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    return _streets(corners * rounds + [corners[0]])


def _taxi(seed: int, length_m: float) -> Floats:
    path = city_path(seed, length_m)
    return path[travelled_m(path) <= length_m]


def _there_and_back(times: int) -> Floats:
    out = _streets([(0.0, 0.0), (10.0, 0.0), (10.0, 8.0), (20.0, 8.0), (20.0, 14.375)])
    return np.concatenate([out, out[-2::-1]] + [out[1:], out[-2::-1]] * (times - 1))


TRACES = {
    "loop 2.9 km x 10": lambda part: Trace("loop 2.9 km x 10", (_spaced(_loop(5, 4, max(2, 10 // part))),)),
    "loop 9.9 km x 5": lambda part: Trace("loop 9.9 km x 5", (_spaced(_loop(15, 16, max(2, 5 // part))),)),
    "there and back x 3": lambda part: Trace(
        "there and back x 3", (_spaced(_there_and_back(max(1, 3 // part))),)
    ),
    "taxi 60 km": lambda part: Trace("taxi 60 km", (_spaced(_taxi(0, 60_000.0 / part)),)),
    "two taxis": lambda part: Trace(
        "two taxis", tuple(_spaced(_taxi(seed, 30_000.0 / part)) for seed in (1, 2))
    ),
    "taxi, sizes differ": lambda part: Trace(
        "taxi, sizes differ", (_spaced(_taxi(0, 60_000.0 / part)),), sizes=True
    ),
    "loop, sizes differ": lambda part: Trace(
        "loop, sizes differ", (_spaced(_loop(5, 4, max(2, 10 // part))),), sizes=True
    ),
}
MEMORY_CELLS = {"loop 2.9 km x 10": (512, 1024, 1536), "loop, sizes differ": (512, 1024)}


@cache
def prepared(name: str, part: int) -> Prepared:
    """Find out which cells a trace asks for when."""
    trace = TRACES[name](part)
    places = np.concatenate(trace.ways)
    catalogue = dense_catalogue(Drive(name, np.arange(float(len(places))), places, places), 220.0)
    steps = min(map(len, trace.ways))
    windows, uses = [], dict[int, list[int]]()
    inside: list[Indices] = [np.empty(0, np.intp)] * len(trace.ways)
    for step in range(steps):
        before = inside
        inside = [catalogue.query(Circle(way[step, 0], way[step, 1], RADIUS_M))[0] for way in trace.ways]
        windows.append(tuple(inside))
        for old, now in zip(before, inside, strict=True):
            for cell in np.setdiff1d(now, old, assume_unique=True).tolist():
                uses.setdefault(cell, []).append(step)
    random = np.random.Generator(np.random.PCG64(6))
    nbytes = np.full(len(catalogue), MEAN_BYTES)
    if trace.sizes:
        nbytes = np.exp(random.normal(np.log(MEAN_BYTES) - 0.5, 1.0, len(catalogue))).astype(np.int64)
    return Prepared(trace, catalogue, nbytes, tuple(windows), uses)


class _Memory:
    """Cells in memory, and what is evicted."""

    def __init__(self, work: Prepared, memory_bytes: int, column: str) -> None:
        self.work, self.free_bytes, self.column = work, memory_bytes, column
        self.there: dict[int, Resident] = {}
        boxes = work.catalogue.boxes.tolist()
        self.made = [
            Resident(f"/{n}", Key(f"/{n}", "points"), n, size, 1, tuple(box), 0.0, 0.0)
            for n, (box, size) in enumerate(zip(boxes, work.nbytes.tolist(), strict=True))
        ]
        self.uses = {cell: deque(steps) for cell, steps in work.uses.items()}

    def load(
        self, cells: list[int], needed: set[int], motions: list[Motion], now_s: float, step: int
    ) -> None:
        """Have cells in memory; those ``needed`` stay."""
        short = sum(self.made[cell].nbytes for cell in cells) - self.free_bytes
        if short > 0:
            candidates = [one for cell, one in self.there.items() if cell not in needed]
            for at in np.argsort(-self._scores(candidates, motions, now_s, step), kind="stable"):
                victim = candidates[at]
                del self.there[victim.version]
                self.free_bytes += victim.nbytes
                short -= victim.nbytes
                if short <= 0:
                    break
        for cell in cells:
            self.there[cell] = self.made[cell]
            self.free_bytes -= self.made[cell].nbytes

    def _scores(self, candidates: list[Resident], motions: list[Motion], now_s: float, step: int) -> Floats:
        if self.column != "belady":
            # the daemon, too, sorts equals by when they were used
            places = merged_places(places_of(motion, RADIUS_M) for motion in motions)
            scores = eviction_scores(candidates, NOWHERE if self.column == "lru" else places, now_s)
            used = np.array([one.last_use_s for one in candidates])
            return -np.argsort(np.lexsort((used, -scores))).astype(np.float64)
        found = np.empty(len(candidates))
        for number, one in enumerate(candidates):
            uses = self.uses[one.version]
            while uses and uses[0] <= step:
                uses.popleft()
            found[number] = uses[0] if uses else np.inf
        return found


def hits(name: str, part: int, memory_cells: int, column: str) -> float:
    """Share of what comes into a circle and is in memory, percent."""
    work = prepared(name, part)
    memory = _Memory(work, memory_cells * MEAN_BYTES, column)
    motions = [Motion() for _ in work.trace.ways]
    routes = [
        tuple(map(tuple, _thinned(way).tolist())) if column == "route" else () for way in work.trace.ways
    ]
    found, asked = 0, 0
    inside: list[Indices] = [np.empty(0, np.intp)] * len(motions)
    for step, windows in enumerate(work.windows):
        now_s = step * STEP_M / SPEED_MPS
        for motion, way, route in zip(motions, work.trace.ways, routes, strict=True):
            motion.update(Intent(float(way[step, 0]), float(way[step, 1]), route=route), now_s)
        needed = set(np.concatenate(windows).tolist())
        absent = []
        for old, window in zip(inside, windows, strict=True):
            for cell in np.setdiff1d(window, old, assume_unique=True).tolist():
                there = cell in memory.there or cell in absent
                asked += 1
                found += there
                if not there:
                    absent.append(cell)
        inside = list(windows)
        memory.load(absent, needed, motions, now_s, step)
        for cell in needed:
            memory.made[cell].last_use_s = now_s
    return 100.0 * found / asked


def _thinned(way: Floats) -> Floats:
    """As many vertices as a request may have."""
    return way[:: -(-len(way) // 4000)]


class Job(NamedTuple):
    """One figure of the table."""

    name: str
    part: int
    memory_cells: int
    column: str


def _hits(job: Job) -> float:
    return hits(*job)


def verdict(name: str, found: dict[str, float]) -> str:
    """Which limits do not hold, if any."""
    wrong = []
    if found["route"] < found["lru"]:
        wrong.append(f"route {found['lru'] - found['route']:.1f} points below")
    if "loop" in name and found["route"] < 0.9 * found["belady"]:
        wrong.append(f"route {found['route'] / found['belady']:.2f} of Belady's")
    if found["no route"] < found["lru"] - 0.5:
        wrong.append(f"no route {found['lru'] - found['no route']:.1f} points below")
    return "MISSED: " + ", ".join(wrong) if wrong else "ok"


def main() -> int:
    """Count, print and judge."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a third of each trace")
    parser.add_argument("--only", default="", metavar="NAME", help="traces whose names have this in them")
    arguments = parser.parse_args()
    part = 3 if arguments.quick else 1
    rows = [
        (name, memory_cells)
        for name in TRACES
        if arguments.only in name
        for memory_cells in MEMORY_CELLS.get(name, (1024, 2048, 4096))
    ]
    jobs = [Job(name, part, memory_cells, column) for name, memory_cells in rows for column in COLUMNS]
    print(f"{'hits, %':20} {'memory':>6}" + "".join(f"{column:>9}" for column in COLUMNS))
    missed = 0
    with multiprocessing.get_context("fork").Pool(os.cpu_count()) as pool:
        figures = pool.imap(_hits, jobs)
        for name, memory_cells in rows:
            found = {column: next(figures) for column in COLUMNS}
            told = verdict(name, found)
            missed += told != "ok"
            print(
                f"{name:20} {memory_cells:6}"
                + "".join(f"{value:9.1f}" for value in found.values())
                + f"  {told}",
                flush=True,
            )
    print(f"limits missed: {missed}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
