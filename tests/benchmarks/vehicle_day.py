# SPDX-License-Identifier: Apache-2.0
"""An hour of driving over a published map of a million cells, over a mobile link that fails now and then.

    python -m tests.benchmarks.vehicle_day [--minutes 20] [--at-once]

The map is 20 km wide, of cells of 20 m with about 40 000 points; its objects are generated on request
(`tests.support.made_map`).  A vehicle drives through a city (`city_drive`: 40 km, red lights, at most 15 m/s)
and asks for a circle of 200 m every 20 m.  Two daemons: one gets only the vehicle's positions, one also its
route (the next kilometres of it).  Each has 2 GiB of memory for cells and 8 GiB of disk, empty at the start,
and bridges outages of 20 s (`--outage-tolerance`).  The link: an answer takes a log-normal time (mean 0.2 s,
sigma 0.8), all share 100 Mbit/s, and by chance, every four minutes on average, nothing passes for 2 to 20 s.

The hour is driven in ``--minutes``: the vehicle is 60 / minutes times as fast, the link as much wider, and
outages as much more frequent.  How long answers and outages take is not shortened, nor is anything in the
daemon: an outage covers more of the path than in a real hour.  ``--minutes 60`` is a real hour.

misses          queries that lacked a cell, or did not know all cells; the first 30 s do not count
longest wait    from when a cell was first needed until it was there
MB/km           bytes over the link, index and retries included, for each kilometre
over-fetch      bytes loaded for each one that was asked for
disk hits       loads whose object was on the disk, of all loads
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import shmmap
from shmmap.statistics.reader import read_statistics
from tests.benchmarks.hostile.stage import lift
from tests.benchmarks.slow_origin_drives import Drive, city_drive, travelled_m
from tests.support.daemon_process import DaemonProcess
from tests.support.made_map import serve_made_map
from tests.support.slow_link import Plan, slow_link

CELLS: Final = 1_000_000
POINTS: Final = 40_000
RADIUS_M: Final = 200.0
STEP_M: Final = 20.0
LEAVE_OUT_S: Final = 30.0
OUTAGE_TOLERANCE_S: Final = 20.0
HOUR_S: Final = 3600.0
BLOCKS: Final = 120
STRETCH_M: Final = 1000.0
AHEAD_M: Final = 5000.0
"""At least this much of the route ahead is sent; a new stretch of it every kilometre."""
VERTEX_M: Final = 15.0
KINDS: Final = ("places", "route")


class Sample(NamedTuple):
    """The state at one query: seconds since the start, bytes over the link, bytes of memory."""

    asked_s: float
    received_bytes: int
    resident_bytes: int


@dataclass
class Query:
    """One query of the vehicle: where, how much was missing, and how long until it was there."""

    asked_s: float
    x: float
    y: float
    late: int
    wait_s: float = 0.0


@dataclass
class Day:
    """Results of one drive.

    Attributes
    ----------
    outages
        From when to when, seconds since the start.
    counters
        The daemon's, at the end.
    cells_sent
        Objects of cells that the server has sent whole.
    """

    kind: str
    outages: Sequence[tuple[float, float]]
    way_km: float = 0.0
    queries: list[Query] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)
    cells_sent: int = 0
    disk_bytes: int = 0
    peak_bytes: int = 0

    @cached_property
    def counted(self) -> list[Query]:
        """Queries that count."""
        return [query for query in self.queries if query.asked_s >= LEAVE_OUT_S]

    @property
    def misses(self) -> int:
        """Number of queries with something missing."""
        return sum(query.late > 0 for query in self.counted)

    @property
    def longest_wait_s(self) -> float:
        """Longest wait for a cell, seconds."""
        return max((query.wait_s for query in self.counted), default=0.0)

    @property
    def mb_per_km(self) -> float:
        """Megabytes over the link for each kilometre."""
        first, last = self.samples[0], self.samples[-1]
        return (last.received_bytes - first.received_bytes) / 1e6 / self.way_km

    @property
    def over_fetch(self) -> float:
        """Bytes loaded for each requested byte."""
        return self.counters["bytes_loaded"] / max(1, self.counters["bytes_used"])

    @property
    def disk_hits(self) -> float:
        """Share of loads whose object was on the disk."""
        loads = self.counters["loads_finished"]
        return max(0.0, 1.0 - self.cells_sent / loads) if loads else 0.0


def outages(seed: int, factor: float, length_s: float) -> list[tuple[float, float]]:
    """When the link is out in a drive of this length: every four minutes of the real hour on average."""
    rng = np.random.default_rng([seed, 7])
    found: list[tuple[float, float]] = []
    at_s = LEAVE_OUT_S
    while (at_s := at_s + float(rng.exponential(240.0 / factor))) < length_s:
        out_s = float(np.exp(rng.uniform(np.log(2.0), np.log(OUTAGE_TOLERANCE_S))))
        found.append((at_s, at_s + out_s))
        at_s += out_s
    return found


class SentRoute:
    """The part of its route that the vehicle sends: a stretch of it, a new one every kilometre."""

    def __init__(self, drive: Drive) -> None:
        self._route, self._along = drive.route, travelled_m(drive.route)

    def at(self, along_m: float) -> tuple[tuple[float, float], ...]:
        """Return the stretch that is sent after ``along_m`` metres of the path."""
        begin_m = max(0.0, along_m // STRETCH_M * STRETCH_M - STEP_M)
        marks = np.arange(begin_m, min(begin_m + STRETCH_M + AHEAD_M, self._along[-1]), VERTEX_M)
        x, y = (np.interp(marks, self._along, column).tolist() for column in self._route.T)
        return tuple(zip(x, y, strict=True))


class Vehicle:
    """Drives, asks, and waits for missing cells until it asks again."""

    def __init__(self, client: shmmap.Client, day: Day, sent: SentRoute | None) -> None:
        self._client, self._day, self._sent = client, day, sent
        self._lacking: dict[str, tuple[float, Query]] = {}

    def ask(self, x: float, y: float, along_m: float, begin_s: float, until_s: float) -> None:
        """Ask for the cells around; if some are missing, wait for them until ``until_s``."""
        route = self._sent.at(along_m) if self._sent is not None else ()
        area = shmmap.Circle(x, y, RADIUS_M)
        asked_s = time.monotonic()
        answer = self._client.area(area, wait=0, pose=(x, y), route=route, strict=None)
        query = Query(asked_s - begin_s, x, y, self._missing(answer))
        self._day.queries.append(query)
        self._note(answer, query, asked_s)
        while self._lacking and (left_s := until_s - time.monotonic()) > 0:
            again_s = time.monotonic()
            answer = self._client.area(area, wait=left_s, strict=None)
            self._note(answer, query, asked_s)
            if answer.failed or not answer.covered:  # out of reach: the answer comes at once
                time.sleep(max(0.0, min(until_s, again_s + 0.1) - time.monotonic()))
        self._client.release()

    @staticmethod
    def _missing(answer: shmmap.CellSet) -> int:
        return len(answer.pending) + len(answer.failed) + (not answer.covered)

    def _note(self, answer: shmmap.CellSet, query: Query, asked_s: float) -> None:
        """Note since when cells are missing, and the wait for those that came or are no longer needed."""
        now_s = time.monotonic()
        missing = {each.id for each in answer.pending} | {each.cell_id for each in answer.failed}
        if not answer.covered:
            missing.add("cells that are not known")
        for cell in list(self._lacking):
            since_s, first = self._lacking[cell]
            first.wait_s = max(first.wait_s, now_s - since_s)
            if cell not in missing:
                del self._lacking[cell]
        for cell in missing:
            self._lacking.setdefault(cell, (asked_s, query))


def drive_day(drive: Drive, kind: str, args: argparse.Namespace, folder: Path) -> Day:
    """Run one daemon, its link and its vehicle."""
    factor, end_s = 60.0 / args.minutes, HOUR_S * args.hours
    day = Day(kind, outages(args.seed, factor, end_s / factor))
    with ExitStack() as stack:
        served = stack.enter_context(serve_made_map(CELLS, POINTS))
        plan = Plan(served.port, args.mbit * factor, 0.0, args.mean, args.seed)
        link = stack.enter_context(slow_link(plan))
        options = ["--budget", "2G", "--cache-size", "8G", "--outage-tolerance", str(OUTAGE_TOLERANCE_S)]
        cache = folder / kind
        one = DaemonProcess(link.endpoint, *options, "--workers", "2", "--cache-dir", str(cache))
        stack.enter_context(one)
        client = stack.enter_context(shmmap.connect(one.endpoint))
        vehicle = Vehicle(client, day, SentRoute(drive) if kind == "route" else None)
        times = drive.times_each(STEP_M)
        times = times[times < end_s]
        day.way_km = len(times) * STEP_M / 1e3
        client.area(shmmap.Circle(*drive.at(0.0), RADIUS_M), wait=300.0)
        client.release()
        if args.lift:
            for pid in (one.pid, *one.loaders()):
                lift(pid)
        begin_s = time.monotonic()
        link.go_out([(begin_s + from_s, begin_s + to_s) for from_s, to_s in day.outages])
        due = (begin_s + np.append(times, end_s) / factor).tolist()
        for number, real_s in enumerate(times.tolist()):
            time.sleep(max(0.0, due[number] - time.monotonic()))
            vehicle.ask(*drive.at(real_s), number * STEP_M, begin_s, due[number + 1])
            counters = read_statistics(one.instance, one.shm_dir).counters
            now_s = time.monotonic() - begin_s
            day.samples.append(Sample(now_s, link.received_bytes(), counters["bytes_resident"]))
            day.peak_bytes = max(day.peak_bytes, counters["bytes_resident"] + counters["bytes_zombie"])
        day.counters = dict(read_statistics(one.instance, one.shm_dir).counters)
        day.cells_sent = served.cells_sent()
        day.disk_bytes = sum(path.stat().st_blocks * 512 for path in cache.rglob("*") if path.is_file())
    assert not one.leftovers()
    return day


def row(day: Day) -> str:
    """Return a row of the table."""
    out_s = sum(end - begin for begin, end in day.outages)
    return (
        f"{day.kind:7} {len(day.counted):5} queries, {day.misses} misses"
        f" ({100 - 100 * day.misses / max(1, len(day.counted)):.2f} % warm),"
        f" {day.counters['prefetch_misses']} cells late, longest wait {day.longest_wait_s:.1f} s;"
        f" {day.mb_per_km:.0f} MB/km, over-fetch {day.over_fetch:.2f}, disk hits {100 * day.disk_hits:.1f} %;"
        f" memory {day.peak_bytes / 2**30:.2f} GiB, disk {day.disk_bytes / 2**30:.2f} GiB;"
        f" {len(day.outages)} outages, {out_s:.0f} s"
    )


def main() -> None:
    """Drive with and without a route, and print the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=20.0, help="that an hour takes (default: 20)")
    parser.add_argument("--hours", type=float, default=1.0, help="of driving, 1 at most (default: 1)")
    parser.add_argument("--mean", type=float, default=0.2, help="seconds that an answer takes (default: 0.2)")
    parser.add_argument(
        "--mbit", type=float, default=100.0, help="of the link, Mbit/s; 0: any (default: 100)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the drive, the link and its outages")
    parser.add_argument("--only", choices=KINDS, help="one of the two")
    parser.add_argument("--at-once", action="store_true", help="both drives at the same time")
    parser.add_argument(
        "--scratch", type=Path, help="directory for the disk tiers (default: a temporary one)"
    )
    parser.add_argument(
        "--lift",
        action="store_true",
        help="run all of this at a higher priority than other work (needs root)",
    )
    args = parser.parse_args()
    if args.lift:
        lift(os.getpid())
    if not 10.0 <= args.minutes <= 60.0:
        parser.error(
            "--minutes: 10 to 60; in less, the vehicle would be faster than the daemon takes one to be"
        )
    if not 0.0 < args.hours <= 1.0:
        parser.error("--hours: the drive takes one hour")
    drive = city_drive(args.seed, 45_000.0, BLOCKS)
    kinds = [args.only] if args.only else list(KINDS)
    print(f"load {os.getloadavg()[0]:.1f}; an hour takes {args.minutes:g} minutes", flush=True)
    at_once = len(kinds) if args.at_once else 1
    with tempfile.TemporaryDirectory(dir=args.scratch) as folder, ThreadPoolExecutor(at_once) as pool:
        days = list(pool.map(lambda kind: drive_day(drive, kind, args, Path(folder)), kinds))
    for day in days:
        print(row(day))
    print(f"load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
