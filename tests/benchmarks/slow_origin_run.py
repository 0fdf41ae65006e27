# SPDX-License-Identifier: Apache-2.0
"""One drive beside a slow origin, in simulated time: which cells are late, and what was fetched for that.

Demands first, nearest first; a cell is loaded once, however many want it; one loader is kept free of what
no client has asked for.  Memory is limited, and what was not asked for yet takes half of it at most;
what is evicted is chosen by the daemon's own scores.  A load that failed is tried again as
`shmmap.daemon.loading.loads` does it.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.loading.link import Link
from shmmap.daemon.loading.loads import FIRST_RETRY_S, LAST_RETRY_S
from shmmap.daemon.loading.look_ahead import URGENT_S
from shmmap.daemon.map.arrivals import Arrivals
from shmmap.daemon.travel.motion import Motion
from shmmap.daemon.travel.places import places_of, until_needed
from shmmap.geometry import Circle
from shmmap.origin.catalogue import Catalogue
from shmmap.protocol.messages import Intent
from tests.benchmarks.slow_origin_drives import Drive
from tests.benchmarks.slow_origin_foresight import Margin, Nothing, Policy, Truth
from tests.benchmarks.slow_origin_model import Counts, Query, SlowOrigin, ThinLink

ROWS = ("none", "margin", "no route", "trajectory", "route", "oracle")
"""What is fetched ahead: nothing; 60 m more; along the motion learnt from poses; along 150 m of path, sent
again each second; along the whole route; what will be asked for."""
POSE_PERIOD_S = 1.0
"""How often a window sends its pose, and asks again for what it lacks."""
TRAJECTORY_M = 150.0
FULL_S = 1.0
"""So long nothing is fetched ahead after there was no room for it."""
EVICTED_AT_A_TIME = 32
"""Cells that are evicted at a time."""
POLL_S = 0.5
"""How long after an outage the origin is found to answer again, on average."""
TICK_S = 0.05
"""Interval at which bytes are reported while they come."""
LONGEST_WARM_UP_S = 120.0
WARM_UP_S = 30.0
"""Of rows that do not look ahead."""


@dataclass(frozen=True)
class Setting:
    """What the vehicle and the daemon do.

    Attributes
    ----------
    row
        One of `ROWS`.
    memory_cells
        Cells that fit into memory.
    share
        Part of them that may be there without having been asked for.
    budget
        Whether the link has one; else as much is under way as there are loaders.
    """

    row: str
    outage_tolerance_s: float = 10.0
    radius_m: float = 200.0
    step_m: float = 20.0
    loaders: int = 8
    memory_cells: int = 1000
    share: float = 0.5
    budget: bool = False


class _Simulation:
    """The state of one; see `simulate`."""

    def __init__(
        self, drive: Drive, catalogue: Catalogue, origin: SlowOrigin | ThinLink, setting: Setting
    ) -> None:
        self.drive, self.catalogue, self.origin, self.setting = drive, catalogue, origin, setting
        self.thin = origin if isinstance(origin, ThinLink) else None
        self.link = Link(Arrivals()) if setting.budget else None
        self.back_s = math.inf
        count = len(catalogue)
        self.boxes = np.ascontiguousarray(catalogue.boxes)
        self.present = np.zeros(count, bool)
        self.used = np.zeros(count, bool)
        self.loading = np.zeros(count, bool)
        self.retry_s, self.delay_s = np.zeros(count), np.zeros(count)
        self.now_s = 0.0
        self.motion = Motion()
        self.inside: NDArray[np.intp] = np.empty(0, np.intp)
        self.demands: list[int] = []
        self.running: list[tuple[float, int, float, bool]] = []
        self.open: list[Query] = []
        self.counts = Counts()
        self.in_memory = self.unused = 0
        self.full_until_s = self.wake_s = -math.inf
        self.asked_s: list[float] = drive.times_each(setting.step_m).tolist()
        self.route = [(float(x), float(y)) for x, y in drive.route]
        self.route_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(drive.route, axis=0).T))))
        self.foresight = self._foresight()

    def _foresight(self) -> Nothing:
        setting = self.setting
        if setting.row == "none":
            return Nothing()
        if setting.row == "margin":
            return Margin(self.is_absent)
        if setting.row == "oracle":
            return Truth(self.is_absent, setting.outage_tolerance_s, self._future())
        return Policy(
            self.is_absent, setting.outage_tolerance_s, self.motion, self._area(*self.drive.at(0.0))
        )

    def _area(self, x: float, y: float) -> Circle:
        return Circle(x, y, self.setting.radius_m)

    def _future(self) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        inside: NDArray[np.intp] = np.empty(0, np.intp)
        times, cells = [], []
        for time_s in self.asked_s:
            before, inside = inside, self.catalogue.query(self._area(*self.drive.at(time_s)))[0]
            new = np.setdiff1d(inside, before, assume_unique=True)
            times.append(np.full(len(new), time_s))
            cells.append(new)
        return np.concatenate(times), np.concatenate(cells)

    def is_absent(self, cell: int, layer: str) -> bool:
        del layer
        return not (self.present[cell] or self.loading[cell] or self.now_s < self.retry_s[cell])

    # --- the vehicle ------------------------------------------------------------------------------

    def send_pose(self) -> tuple[float, float]:
        """Send where the client is."""
        x, y = self.drive.at(self.now_s)
        route: tuple[tuple[float, float], ...] = ()
        if self.setting.row in ("route", "oracle"):
            route = tuple(self.route)
        elif self.setting.row == "trajectory":
            # its place on the route is about as far as it has travelled
            travelled = float(np.interp(self.now_s, self.drive.times_s, self.drive.travelled_m))
            share = travelled / float(self.drive.travelled_m[-1]) * float(self.route_m[-1])
            first, last = np.searchsorted(self.route_m, [share, share + TRAJECTORY_M])
            route = tuple(self.route[max(0, first - 1) : last + 1])
        self.motion.update(Intent(x, y, route=route), self.now_s)
        return x, y

    def ask(self) -> None:
        """The client asks for its area."""
        x, y = self.send_pose()
        area, before = self._area(x, y), self.inside
        self.inside = self.catalogue.query(area)[0]
        self.foresight.asks(area)
        new = np.setdiff1d(self.inside, before, assume_unique=True)
        lacking = set(self.inside[~self.present[self.inside]].tolist())
        late = len(lacking.intersection(new.tolist()))
        hit = self.inside[self.present[self.inside]]
        first_used = int(np.count_nonzero(~self.used[hit]))
        self.counts.used += first_used
        self.unused -= first_used
        self.used[hit] = True
        inside = set(self.inside.tolist())
        for query in self.open:
            query.lacking &= inside  # no query waits for what was passed
        self.close()
        counts = self.counts
        query = Query(self.now_s, x, y, len(new), late, lacking, 0.0, counts.fetched, counts.used)
        query.ahead = self.unused
        counts.queries.append(query)
        self.open += [query] if lacking else []
        self.ask_again()

    def ask_again(self) -> None:
        """What lacks is wanted, nearest first."""
        x, y = self.drive.at(self.now_s)
        lacking = self.inside[~self.present[self.inside]]
        wanted = lacking[~self.loading[lacking] & (self.now_s >= self.retry_s[lacking])]
        middles = self.boxes[wanted].reshape(-1, 2, 2).mean(axis=1)
        self.demands = wanted[np.argsort(-np.hypot(*(middles - (x, y)).T))].tolist()

    def close(self) -> None:
        """Queries that lack nothing any more are over."""
        for query in self.open:
            query.stall_s = self.now_s - query.asked_s
        self.open = [query for query in self.open if query.lacking]

    # --- the daemon -------------------------------------------------------------------------------

    def pump(self) -> None:
        """Give loaders something to do."""
        while self.demands and len(self.running) < self.setting.loaders and self.may_begin(ahead=False):
            cell = self.demands.pop()
            if self.is_absent(cell, "points"):
                self.make_room(0.0)
                self.begin(cell)
        self.wake_s = math.inf
        if self.demands and self.link is not None and len(self.running) < self.setting.loaders:
            self.wake_s = max(self.link.next_s(), self.now_s + 0.01)
        while not self.demands and len(self.running) < self.setting.loaders and self.may_begin(ahead=True):
            if self.now_s < self.full_until_s:
                self.wake_s = self.full_until_s
                return
            if self.unused + len(self.running) >= self.setting.share * self.setting.memory_cells:
                self.counts.no_room += 1
                self.note_full()
                return  # until something is asked for
            wish = self.foresight.next(self.catalogue, self.now_s)
            if wish is None and self.foresight.more:
                continue
            if wish is None:
                self.wake_s = max(self.foresight.next_s(self.now_s), self.now_s + 0.01)
                self.note_full()
                return
            if len(self.running) == self.setting.loaders - 1 and wish.needed_in_s > URGENT_S:
                return  # until a load ends
            if not self.make_room(wish.needed_in_s):
                self.counts.no_room += 1
                self.full_until_s = self.now_s + FULL_S
                self.note_full()
            else:
                self.begin(wish.cell)

    def may_begin(self, *, ahead: bool) -> bool:
        """Whether the link has room."""
        return self.link is None or self.link.may_begin(self.now_s, ahead=ahead)

    def note_link(self) -> None:
        """Note what has come."""
        nbytes = self.thin.take_bytes(self.now_s) if self.thin is not None else 0
        if self.link is not None:
            self.link.arrived(nbytes, self.now_s)

    def note_full(self) -> None:
        """Nothing is wished for: from now on it counts."""
        policy = self.setting.row not in ("none", "margin")
        if policy and self.counts.full_s == math.inf and self.present[self.inside].all() and self.now_s:
            # loads that run are done soon
            self.counts.full_s = max([end_s for end_s, *_ in self.running], default=self.now_s)

    def begin(self, cell: int) -> None:
        """Load a cell."""
        end_s, failed = self.origin.load(self.now_s)
        self.loading[cell] = True
        if self.link is not None:
            ahead = cell not in self.inside
            nbytes = self.thin.object_bytes if self.thin is not None else 0
            self.link.begin(cell, nbytes, self.now_s, "ahead" if ahead else "demand")
        heapq.heappush(self.running, (end_s, cell, self.now_s, failed))

    def end(self) -> None:
        """The load that ends first has ended."""
        _, cell, began_s, failed = heapq.heappop(self.running)
        self.loading[cell] = False
        if self.link is not None:
            self.link.end(cell, 0 if failed or self.thin is None else self.thin.object_bytes)
        if failed and self.thin is not None:  # what polls the origin finds out that it is back
            outages = self.thin.outages
            self.back_s = outages.next_s(began_s) + outages.length_s + POLL_S
            self.foresight.health.unreachable = self.back_s > self.now_s
        if failed:
            delay_s = min(2.0 * self.delay_s[cell], LAST_RETRY_S) or FIRST_RETRY_S
            self.delay_s[cell], self.retry_s[cell] = delay_s, self.now_s + delay_s
        else:
            self.present[cell] = True
            self.delay_s[cell] = self.retry_s[cell] = 0.0
            self.in_memory += 1
            self.counts.fetched += 1
            waited_for = False
            for query in self.open:
                waited_for |= cell in query.lacking
                query.lacking.discard(cell)
            self.used[cell] = waited_for
            self.counts.used += waited_for
            self.unused += not waited_for
            self.close()
        self.foresight.note_origin(self.now_s)
        if self.foresight.health.ended(self.now_s - began_s, failed=failed):
            self.delay_s[:] = self.retry_s[:] = 0.0
            self.ask_again()

    def make_room(self, needed_in_s: float) -> bool:
        """Evict what is needed last; False if all is needed sooner than this."""
        if self.in_memory + len(self.running) < self.setting.memory_cells:
            return True
        places = places_of(self.motion, self.setting.radius_m)
        there = np.flatnonzero(self.present)
        there = np.setdiff1d(there, self.inside, assume_unique=True)
        until_s = until_needed(self.boxes[there], places, self.now_s)
        last = np.argsort(until_s)[-EVICTED_AT_A_TIME:]
        victims = there[last[until_s[last] > needed_in_s]]
        self.present[victims] = False
        self.unused -= int(np.count_nonzero(~self.used[victims]))
        self.in_memory -= len(victims)
        return len(victims) > 0

    def run(self) -> Counts:
        """Drive."""
        ask_at, send_s = 0, 0.0
        if self.setting.row in ("none", "margin"):
            self.counts.full_s = WARM_UP_S
        while True:
            ask_s = self.asked_s[ask_at] if ask_at < len(self.asked_s) else math.inf
            end_s = self.running[0][0] if self.running else math.inf
            wake_s = self.wake_s if self.wake_s > self.now_s else math.inf
            tick_s = self.now_s + TICK_S if self.running and self.link is not None else math.inf
            self.now_s = min(ask_s, send_s, end_s, wake_s, self.back_s, tick_s)
            if self.now_s >= self.drive.length_s:
                break
            self.note_link()
            if self.now_s == self.back_s:
                self.back_s = math.inf
                self.foresight.health.unreachable = False
                self.foresight.health.answers()
                self.delay_s[:] = self.retry_s[:] = 0.0
                self.ask_again()
            elif self.now_s == end_s:
                self.end()
            elif self.now_s == ask_s:
                ask_at += 1
                self.ask()
            elif self.now_s == send_s:
                send_s += POSE_PERIOD_S
                self.send_pose()
                self.ask_again()
            self.pump()
        self.now_s = self.drive.length_s
        self.close()
        self.counts.full_s = min(self.counts.full_s, LONGEST_WARM_UP_S)
        return self.counts


def simulate(drive: Drive, catalogue: Catalogue, origin: SlowOrigin | ThinLink, setting: Setting) -> Counts:
    """Drive once, and count."""
    return _Simulation(drive, catalogue, origin, setting).run()
