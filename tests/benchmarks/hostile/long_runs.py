# SPDX-License-Identifier: Apache-2.0
"""Minutes instead of moments: the worst attacks all at once, and honest work on a very large map."""

from __future__ import annotations

import math
import random
import time
from contextlib import ExitStack
from typing import Final

from shmmap.statistics.reader import read_statistics
from tests.benchmarks.hostile.actors import Actor, Orders, fills, walks_cold, works
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.files import reloads, touch_the_last
from tests.benchmarks.hostile.requests import SIDE, asks_for_normals, waits_with_many_requests
from tests.benchmarks.hostile.segments import ROUTE_VERTICES, budget_for, idles_with_routes
from tests.benchmarks.hostile.sessions import DESCRIPTORS, leaves_without_a_word, subscribes
from tests.benchmarks.hostile.stage import Report, Stage, scene
from tests.support.daemon_process import DaemonProcess
from tests.support.raw_client import RawClient, circle

SEGMENTS: Final = 7430


@scene("worst-five", "The worst of them all at once, for minutes, are as if they were not there")
def worst_five(report: Report, stage: Stage) -> None:
    """A1, A2, A3, A4 and A6 together under a full budget of 7430 segments and 1024 descriptors."""
    span = (0.0, SIDE * 20.0)
    flags = ["--budget", budget_for(SEGMENTS), "--cache-size", "0"]
    with ExitStack() as stack:
        one = stack.enter_context(stage.served(stage.many_cells(SIDE), *flags, descriptors=DESCRIPTORS))
        with Actor(fills, one.endpoint, SIDE, SEGMENTS) as filler:
            filler.said(900.0)
        with RawClient(one.endpoint, hello=False) as client:
            events_path = client.hello()[19]
        idlers = stack.enter_context(Actor(idles_with_routes, one.endpoint, 300, span[1]))
        idlers.said(900.0)
        stack.enter_context(Beside(report, one))
        attackers = [
            stack.enter_context(attacker)
            for attacker in (
                Actor(subscribes, events_path),
                Actor(waits_with_many_requests, one.endpoint, [58, 57, 57, 57], 3.0),
                Actor(leaves_without_a_word, one.endpoint, span, [10**9]),
                Actor(asks_for_normals, one.endpoint),
                Actor(walks_cold, one.endpoint, stage.minutes * 60.0, span, span),
            )
        ]
        time.sleep(stage.minutes * 60.0)
        for attacker in attackers:
            report.note(f"{attacker.name}: {last_words(attacker)}")


def last_words(attacker: Actor) -> str:
    """What an attacker came to; it may not get an answer any more."""
    try:
        return str(attacker.end(30.0))
    except RuntimeError as error:
        return str(error).splitlines()[-1]


VEHICLES: Final = 200
PROCESSES: Final = 8
STEP_S: Final = 2.0
SPEED_M_S: Final = 2.5
WINDOW_M: Final = 60.0
TURN_P999_MS: Final = 2.0
LONGEST_TURN_MS: Final = 10.0


def drives(orders: Orders, endpoint: str, vehicles: int, span_m: float, seed: int) -> int:
    """Vehicles, each a session, drive straight on and keep their windows; returns how often they asked."""
    rng = random.Random(seed)
    count = 0
    fleet = [RawClient(endpoint, name=f"vehicle {number}", timeout=120.0) for number in range(vehicles)]
    poses = [
        (rng.uniform(0, span_m), rng.uniform(0, span_m), rng.uniform(0, 2 * math.pi)) for _ in range(vehicles)
    ]
    held: list[set[int]] = [set() for _ in range(vehicles)]
    orders.say("drives")
    while True:
        for number, client in enumerate(fleet):
            if not orders.go_on(STEP_S / vehicles):
                return count
            x, y, heading = poses[number]
            vx, vy = SPEED_M_S * math.cos(heading), SPEED_M_S * math.sin(heading)
            x, y = (x + vx * STEP_S) % span_m, (y + vy * STEP_S) % span_m
            poses[number] = x, y, heading
            route = [[x + vx * 2.0 * n, y + vy * 2.0 * n] for n in range(ROUTE_VERTICES)]
            reply = client.differential(
                circle(x, y, WINDOW_M),
                packed=list(held[number]),
                wait=1.0,
                intent=[x, y, vx, vy, heading, route],
            )
            held[number].difference_update(reply.removed_versions)
            held[number].update(cell.version for cell in reply.cells)
            if reply.removed_versions:
                client.release(reply.removed_versions)
            count += 1


@scene("churn", "Very many cells, vehicles, evictions and a reload for minutes: no turn of the loop is long")
def churn(report: Report, stage: Stage) -> None:
    """A million cells, 100 000 of them in memory, 200 sessions with routes that drive, one reload."""
    side, segments = 1000, 100_000
    path = stage.many_cells(side)
    with ExitStack() as stack:
        one = stack.enter_context(stage.served(path, "--budget", budget_for(segments)))
        begin_s = time.monotonic()
        with Actor(fills, one.endpoint, side, segments) as filler:
            report.note(f"{filler.said(1800.0)} cells were loaded in {time.monotonic() - begin_s:.0f} s")
        beside = stack.enter_context(Beside(report, one))
        share = VEHICLES // PROCESSES
        drivers = [
            stack.enter_context(Actor(drives, one.endpoint, share, side * 20.0, seed))
            for seed in range(PROCESSES)
        ]
        for driver in drivers:
            driver.said()
        worker = stack.enter_context(Actor(works, is_bystander=True))
        before = counters_of(one)
        time.sleep(stage.minutes * 30.0)
        touch_the_last(path, side)
        with Actor(reloads, one.endpoint) as operator:
            took_s, failure = operator.said(900.0)
        report.must(f"the reload, {took_s:.1f} s, was answered", not failure, failure)
        time.sleep(stage.minutes * 30.0)
        after = counters_of(one)
        asked = sum(driver.end() for driver in drivers)
        for name in ("requests", "loads_finished", "evictions", "reloads"):
            report.note(f"{name}: {after[name] - before[name]}")
        report.note(f"{VEHICLES} vehicles asked {asked} times; {len(one.segments())} segments at the end")
        p999, longest = beside.turns.quantile_and_longest_ms(0.999)
        report.limit("99.9 % of the loop's turns take", p999, TURN_P999_MS, "ms")
        report.limit("the longest takes", longest, LONGEST_TURN_MS, "ms")
        same_p999, same_longest = worker.end()
        report.note(
            f"the same 0.4 ms of work beside it: p99.9 {same_p999:.2f}  longest {same_longest:.1f} ms"
        )


def counters_of(one: DaemonProcess) -> dict[str, int]:
    """The daemon's counters, from its statistics segment: no request delays another."""
    return dict(read_statistics(one.instance, one.shm_dir).counters)
