# SPDX-License-Identifier: Apache-2.0
"""A vehicle drives, and the map's files are far away: are its cells in memory before it asks for them?

    python -m tests.benchmarks.slow_origin [--seconds 600] [--mean 0.4] [--outage 10] [--every 120] [--bucket]

A daemon with eight loaders serves a map of cells of 20 m.  Each file takes a log-normal time to read (sigma
0.8; the same each time), and at regular times, counted from the start of the drive, none can be read for
some seconds.  A vehicle drives at 12 m/s round a square of 2.4 km and asks for a circle of 200 m every 20 m;
it starts when its first circle is in memory.  Beside it a client asks for single cells far away from it,
which are cold, and for warm ones.  Three daemons, one after the other: one that fetches nothing ahead, one
that has the vehicle's poses, one that has its route, too.

With ``--bucket`` the map is published to an S3 server (moto), which the daemon reaches over a link on which
each answer takes such a time (another one each time), and nothing passes while it is out
(`tests.support.slow_link`).  One loader, which fetches 32 objects at once.  Measured so: with its route all
queries lack nothing, with its poses 98.2 %, with 12 late cells, none of them in an outage.

Single cold cells asked for beside wait 2.3 s (99th percentile) with a route, 2.1 s with poses, 7.1 s where
nothing is fetched ahead, because there the vehicle's own cells are what they wait behind.

Late is a cell that is not in the first answer to the request that needs it; the first 30 s do not count.
Limits: with the route none is late, without it 97 % of requests (98 % with ``--bucket``) find all in memory;
what is asked for beside takes at most 1.2 times as long (p99) as where nothing is fetched ahead.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

import shmmap
from shmmap.statistics.reader import read_statistics
from tests.benchmarks.make_many_cells import make_many_cells
from tests.support.command_line import publish
from tests.support.daemon_process import ROOT, DaemonProcess
from tests.support.map_stores import BucketServer, bucket_server
from tests.support.slow_link import Plan, SlowLink, slow_link

SIDE: Final = 150
RADIUS_M: Final = 200.0
STEP_M: Final = 20.0
LEAVE_OUT_S: Final = 30.0
LOADERS: Final = 8
SHIM: Final = Path(__file__).with_name("slow_origin_shim")
CORNERS: Final = ((300.0, 300.0), (2700.0, 300.0), (2700.0, 2700.0), (300.0, 2700.0), (300.0, 300.0))
BUCKET_MAP: Final = "city"
KINDS: Final = ("nothing ahead", "poses", "route")


@dataclass
class Run:
    """What one daemon's clients met."""

    queries: int = 0
    warm: int = 0
    late: int = 0
    late_at_s: list[float] = field(default_factory=list)
    cold_ms: list[float] = field(default_factory=list)
    warm_ms: list[float] = field(default_factory=list)
    counters: dict[str, int] = field(default_factory=dict)


def at(along_m: float) -> tuple[float, float, float, float]:
    """Position and heading (a unit vector) so far along the square."""
    for (x, y), (to_x, to_y) in pairwise(CORNERS):
        length = math.hypot(to_x - x, to_y - y)
        hx, hy = (to_x - x) / length, (to_y - y) / length
        if along_m <= length:
            break
        along_m -= length
    return x + along_m * hx, y + along_m * hy, hx, hy


class Origin(NamedTuple):
    """Where a daemon has its cells from, slowly; ``set_off`` counts the outages from a time on."""

    map_path: Path | str
    options: tuple[str, ...]
    environment: dict[str, str]
    set_off: Callable[[float], object]


def files(root: Path, kind: str, args: argparse.Namespace) -> Origin:
    """Files, which loaders read slowly."""
    begin = root.parent / f"{kind} begins"
    plan = {
        "mean_s": args.mean,
        "throttle_bytes_s": args.throttle,
        "outage_s": args.outage,
        "every_s": args.every,
        "begin": str(begin),
    }
    environment = {"SLOW_ORIGIN": json.dumps(plan), "PYTHONPATH": f"{SHIM}:{ROOT}"}
    return Origin(root, ("--workers", str(LOADERS)), environment, lambda now_s: begin.write_text(str(now_s)))


def bucket(server: BucketServer, link: SlowLink, args: argparse.Namespace) -> Origin:
    """A map in a bucket behind a slow link."""

    def set_off(now_s: float) -> None:
        begins = [now_s + args.every * number for number in range(1, 1 + int(args.seconds // args.every))]
        link.go_out([(begin_s, begin_s + args.outage) for begin_s in begins])

    environment = {**server.environment, "AWS_ENDPOINT_URL": link.endpoint}
    return Origin(server.url(BUCKET_MAP), ("--workers", "1"), environment, set_off)


@contextmanager
def origins(root: Path, args: argparse.Namespace) -> Iterator[Callable[[str], Origin]]:
    """Make the map; returns a function that makes the origin of each drive."""
    make_many_cells(root, SIDE, distinct=args.bucket)
    if not args.bucket:
        yield lambda kind: files(root, kind, args)
        return
    with bucket_server(root.parent) as server:
        publish(root, server.url(BUCKET_MAP), environment=server.environment)
        port = int(server.endpoint.rpartition(":")[2])
        with slow_link(Plan(port, 8e-6 * args.throttle, 0.0, args.mean)) as link:
            yield lambda _kind: bucket(server, link, args)


def vehicle(client: shmmap.Client, kind: str, origin: Origin, args: argparse.Namespace, run: Run) -> None:
    """Drive, and ask for the cells around every 20 m."""
    client.area(shmmap.Circle(*CORNERS[0], RADIUS_M), wait=300.0)
    client.release()
    begin_s = time.monotonic()
    origin.set_off(begin_s)
    for step in range(int(args.seconds * args.speed / STEP_M)):
        time.sleep(max(0.0, begin_s + step * STEP_M / args.speed - time.monotonic()))
        x, y, _, _ = at(step * STEP_M)
        route = CORNERS if kind == "route" else ()
        answer = client.area(shmmap.Circle(x, y, RADIUS_M), wait=0, pose=(x, y), route=route)
        client.release()
        if time.monotonic() - begin_s > LEAVE_OUT_S:
            missing = len(answer.pending) + len(answer.failed) + (not answer.covered)
            run.queries, run.warm, run.late = run.queries + 1, run.warm + (not missing), run.late + missing
            if missing:
                run.late_at_s.append(time.monotonic() - begin_s)


def beside(client: shmmap.Client, over: threading.Event, run: Run) -> None:
    """Ask for one cold cell a second, in the middle of the square, and for one that is warm in between."""
    rng, numbers = random.Random(1), [(x, y) for x in range(60, 90) for y in range(30, 120)]
    rng.shuffle(numbers)
    warm = client.area(shmmap.Circle(1500.0, 1500.0, 30.0), wait=60.0)
    while not over.wait(0.5) and numbers:
        begin_s = time.perf_counter()
        client.area(shmmap.Circle(1500.0, 1500.0, 30.0), wait=0)
        middle_s = time.perf_counter()
        x, y = numbers.pop()
        found = client.selected([f"city_{20 * x}_{20 * y}.pcd"], wait=60.0)
        run.warm_ms.append((middle_s - begin_s) * 1e3)
        if found.cells:  # else the origin was away
            run.cold_ms.append((time.perf_counter() - middle_s) * 1e3)
    del warm


def drive(origin: Origin, kind: str, args: argparse.Namespace) -> Run:
    """One daemon, its vehicle, and a client beside it."""
    share = "0" if kind == "nothing ahead" else "0.5"
    options = [*origin.options, "--budget", "256M", "--outage-tolerance", str(args.outage_tolerance)]
    one = DaemonProcess(origin.map_path, *options, "--prefetch-share", share, environment=origin.environment)
    run, over = Run(), threading.Event()
    with ExitStack() as stack:
        stack.enter_context(one)
        driver = stack.enter_context(shmmap.connect(one.endpoint))
        other = stack.enter_context(shmmap.connect(one.endpoint))
        thread = threading.Thread(target=beside, args=(other, over, run))
        thread.start()
        vehicle(driver, kind, origin, args, run)
        over.set()
        thread.join()
        run.counters = dict(read_statistics(one.instance, one.shm_dir).counters)
    return run


def p99(times: list[float]) -> float:
    """Return the 99th percentile."""
    return float(np.percentile(times, 99)) if times else math.nan


def main() -> None:
    """Drive with each, and print what each met."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0, help="of each drive")
    parser.add_argument("--mean", type=float, default=0.4, help="seconds that a file takes")
    parser.add_argument(
        "--outage", type=float, default=10.0, help="seconds for which no file can be read; 0: none"
    )
    parser.add_argument("--every", type=float, default=120.0, help="seconds from one outage to the next")
    parser.add_argument(
        "--throttle", type=float, default=0.0,
        help="bytes a second of each loader, with --bucket of the link; 0: any",
    )  # fmt: skip
    parser.add_argument("--bucket", action="store_true", help="an S3 server behind a slow link")
    parser.add_argument("--speed", type=float, default=12.0, help="of the vehicle, m/s")
    parser.add_argument("--outage-tolerance", type=float, default=10.0, help="the daemon's setting")
    parser.add_argument("--only", choices=KINDS, help="one of the three")
    args = parser.parse_args()
    if args.seconds * args.speed > 4 * 2400.0:
        parser.error("the path is 9.6 km long: drive for a shorter time, or slower")
    runs: dict[str, Run] = {}
    warnings.simplefilter("ignore", shmmap.ShmmapWarning)  # of points outside their cell, and of what is late
    print(f"load {os.getloadavg()[0]:.1f}", flush=True)
    with (
        tempfile.TemporaryDirectory(dir="/dev/shm") as scratch,
        origins(Path(scratch) / "map", args) as origin_of,
    ):
        for kind in [args.only] if args.only else KINDS:
            run = runs[kind] = drive(origin_of(kind), kind, args)
            counters = run.counters
            over = counters["bytes_loaded"] / counters["bytes_used"]
            longest_ms = max(value for name, value in counters.items() if name.startswith("longest")) / 1e6
            print(
                f"{kind:13} requests {run.queries:4}, all in memory {100 * run.warm / run.queries:6.2f} %,"
                f" late cells {run.late:5}; loaded/used {over:.2f};"
                f" p99 of single cold cells {p99(run.cold_ms):7.0f} ms ({len(run.cold_ms)}),"
                f" of warm requests {p99(run.warm_ms):6.2f} ms; longest turn {longest_ms:.1f} ms;"
                f" load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
            if run.late_at_s and kind != "nothing ahead":
                print("  seconds at which cells were late:", *(f"{at_s:.1f}" for at_s in run.late_at_s))
    if not args.only:
        nothing, poses, route = (runs[kind] for kind in KINDS)
        print(f"with the route {route.late} cells are late (limit 0)")
        share = 100 * poses.warm / poses.queries
        least = 98 if args.bucket else 97
        print(f"without it {share:.1f} % of requests find all in memory (at least {least} %)")
        for kind in KINDS[1:]:
            ratio = p99(runs[kind].cold_ms) / p99(nothing.cold_ms)
            print(f"cold cells beside it, {kind}: p99 {ratio:.2f} times as long (limit 1.2)")


if __name__ == "__main__":
    main()
