# SPDX-License-Identifier: Apache-2.0
"""Very many segments under a full budget, and very many bytes to free: only their number was slow."""

from __future__ import annotations

import math
import random
import time
from contextlib import ExitStack
from typing import Final

from tests.benchmarks.hostile.actors import Actor, Orders, fills, walks_cold
from tests.benchmarks.hostile.beside import Beside
from tests.benchmarks.hostile.stage import Report, Stage, scene
from tests.support.daemon_process import DaemonProcess
from tests.support.raw_client import RawClient, circle

SEGMENT_BYTES: Final = 8192
"""Of a cell with one point."""
ROUTE_VERTICES: Final = 64


def budget_for(segments: int) -> str:
    """A budget that ``segments`` segments fill, the statistics segment included."""
    return str(segments * (SEGMENT_BYTES + 100) + (1 << 20))


def idles_with_routes(orders: Orders, endpoint: str, count: int, span_m: float) -> int:
    """Sessions that each send a position and a long route, and nothing more."""
    rng = random.Random(count)
    sessions = []
    for _ in range(count):
        session = RawClient(endpoint, name="idles", timeout=120.0)
        x, y = (rng.uniform(0.0, span_m) for _ in range(2))
        route = [[x + 300.0 * math.cos(n), y + 300.0 * math.sin(n)] for n in range(ROUTE_VERTICES)]
        session.area(circle(-1e6, 0.0, 1.0), wait=None, intent=[x, y, 0.0, 0.0, None, route])  # no cells
        sessions.append(session)
    orders.say(count)
    while orders.go_on(60.0):
        pass
    return count


@scene("A4", "Idle sessions with routes cost the loads of others nothing")
def routes(report: Report, stage: Stage) -> None:
    """A full budget of 7430 segments; 40, then 300 idle sessions with routes of 64 vertices; cold cells."""
    side, segments = 141, 7430
    span_m = side * 20.0
    cold_m = (segments // side + 2) * 20.0
    with ExitStack() as stack:
        one = stack.enter_context(stage.served(stage.many_cells(side), "--budget", budget_for(segments)))
        with Actor(fills, one.endpoint, side, segments) as filler:
            filler.said(900.0)
        stack.enter_context(Beside(report, one))
        alone = 0.0
        for count in (0, 40, 300):
            idlers = stack.enter_context(Actor(idles_with_routes, one.endpoint, count, span_m))
            idlers.said(900.0)
            with Actor(walks_cold, one.endpoint, 12.0, (0.0, span_m), (cold_m, span_m)) as walker:
                came, took_s = walker.said(900.0)
            rate = came / took_s
            alone = alone or rate
            report.note(
                f"{count} sessions with routes, {len(one.segments())} segments: {rate:.1f} cold cells/s"
            )
            report.limit("without them, over with them", alone / max(rate, 1e-3), 1.5)


@scene("A5", "Cold cells under a full budget come as quickly with 100 000 segments as with 1000")
def many_segments(report: Report, stage: Stage) -> None:
    """Budgets full with 1000, 1974, 7438 and 100 000 segments; the same cold walks on each, in turns."""
    side = 330
    span_m = side * 20.0
    sizes = (1000, 1974, 7438, 100_000)
    rates: dict[int, list[float]] = {size: [] for size in sizes}
    with ExitStack() as stack:
        daemons = {}
        for size in sizes:
            daemons[size] = stack.enter_context(
                stage.served(stage.many_cells(side), "--budget", budget_for(size))
            )
            with Actor(fills, daemons[size].endpoint, side, size) as filler:
                filler.said(1200.0)

        def walk(one: DaemonProcess, part: int) -> float:
            x_m = (span_m / 4.0 * part, span_m / 4.0 * (part + 1))  # not visited before
            with Actor(walks_cold, one.endpoint, 5.0, x_m, (span_m - 540.0, span_m), True) as walker:
                came, took_s = walker.said(900.0)
            return float(came / took_s)

        for part in range(3):
            for size, one in daemons.items():
                rates[size].append(walk(one, part))
        with Beside(report, daemons[sizes[-1]]):  # not before: that daemon alone would serve others, too
            walk(daemons[sizes[-1]], 3)
        for size, one in daemons.items():
            shown = ", ".join(f"{rate:.1f}" for rate in rates[size])
            report.note(f"{len(one.segments())} segments: {shown} cold cells/s")
    ratio = max(rates[sizes[0]]) / max(max(rates[sizes[-1]]), 1e-3)
    report.limit("cold cells/s with 1000, over those with 100 000 segments", ratio, 1 / 0.8)


def loads_and_evicts(orders: Orders, endpoint: str, metres: float, rounds: int) -> tuple[int, int]:
    """Load what lies in a square, release it, and have it evicted; returns bytes of a round, and rounds."""
    nbytes = 0
    with RawClient(endpoint, name="evicts", timeout=300.0) as client:
        for _ in range(rounds):
            cells = client.area(["box", 61.0, 61.0, metres, metres, None, None], wait=300.0).cells
            nbytes = sum(cell.bytes for cell in cells)
            client.release()
            time.sleep(1.2)  # what was handed out a moment ago may be about to be opened
            client.ask("evict", [cell.id for cell in cells])
            while client.ask("stats")[4]["zombies"]:
                time.sleep(0.05)
    return nbytes, rounds


@scene("A11", "Freeing memory delays no client")
def freeing(report: Report, stage: Stage) -> None:
    """64 cells of 1 MB evicted at once, ten times; then 625 of them, three times."""
    with stage.served(stage.many_cells(28, 65_000), "--budget", "2G") as one, Beside(report, one):
        for cells_wide, rounds in ((8, 10), (25, 3)):
            metres = 61.0 + 20.0 * cells_wide - 2.0
            with Actor(loads_and_evicts, one.endpoint, metres, rounds) as attacker:
                nbytes, times = attacker.said(600.0)
            report.note(f"{nbytes / 1e6:.0f} MB were freed at once, {times} times")


def holds_and_asks_for_more(orders: Orders, endpoint: str, held_m: float) -> dict[str, int]:
    """Hold all that the quota allows, and keep asking for more."""
    import shmmap

    found = {"held": 0, "requests": 0, "refused": 0}
    with shmmap.connect(endpoint, name="holds", timeout=600.0) as client:
        held = []
        for row in range(round(held_m / 20.0)):  # what is not in memory yet is taken for larger than it is
            y = 20.0 * row + 1.0
            held.append(client.area(shmmap.Box(1.0, y, held_m, y + 1.0), wait=600.0))
        found["held"] = sum(map(len, held))
        orders.say(dict(found))
        while orders.go_on():
            more = client.area(shmmap.Box(held_m + 5.0, 1.0, held_m + 400.0, 400.0), wait=None)
            found["requests"] += 1
            found["refused"] += len(more.failed)
            del more
    return found


@scene("A12", "A client near its quota, with very much mapped, costs the others nothing")
def near_the_quota(report: Report, stage: Stage) -> None:
    """5929 cells held, and requests for 400 more that the quota does not allow, for 15 s."""
    held = 77
    quota = str(held**2 * SEGMENT_BYTES + (64 << 10))
    flags = ["--budget", "1G", "--session-quota", quota]
    with (
        stage.served(stage.many_cells(141), *flags) as one,
        Actor(holds_and_asks_for_more, one.endpoint, held * 20.0 - 1.0) as attacker,
    ):
        report.note(f"{attacker.said(600.0)['held']} cells are held and mapped")
        with Beside(report, one):
            time.sleep(15.0)
        found = attacker.end()
        report.note(f"beside {found}")
        report.must("the quota refused something", found["refused"] > 0)
