# SPDX-License-Identifier: Apache-2.0
"""Does what is in memory keep ahead of the clients, and can loaders give what their motion needs?

The ways of all clients that move are looked over one after the other, a few steps at each beat, whether cells
are fetched ahead or not.  What several clients will need counts once.  When all have been looked at, the
gauges show what was found, and the next *round* begins.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.prefetch.prefetcher import MOST_WAYS
from shmmap.daemon.loading.prefetch.way_ahead import MOST_CELLS, WayAhead
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_view import CatalogueView
from shmmap.daemon.records import SPACE_CODES, Key
from shmmap.daemon.transport.sessions import Session, Sessions
from shmmap.sparse_table import sparse_zeros

__all__ = ["KeepingAhead"]

LOOKS_A_BEAT: Final = 3
LOOKS_S: Final = 0.0003
"""Most steps along clients' ways at one beat, and time of the processor after which none is begun: around an
area of very many cells one takes a millisecond."""
STEP_M: Final = 10.0
MOST_TABLES: Final = 16
"""Layers of which it is known which cells are counted in a round; those of further ones may count twice."""
PASSING_CODES: Final = SPACE_CODES | {"offline", "load_timeout"}
"""Failures that are no matter of the file: a cell that failed otherwise cannot be had, and is not missed."""


@dataclass(eq=False, slots=True)
class _Round:
    """What was found of the clients looked at so far.

    ``needed`` is in loads a second, ``least_s`` the least time for which all is in memory, ``look_ahead_s``
    the longest that is looked at, ``counted`` says by layer of each cell whether somebody needs it: a set
    of as many as many clients need takes ten milliseconds to be freed.
    """

    left: deque[Session]
    catalogue: CatalogueView
    clients: int = 0
    routed: int = 0
    fastest_mps: float = 0.0
    needed: float = 0.0
    least_s: float = float("inf")
    look_ahead_s: float = 0.0
    counted: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def count(self, index: int, layer: str) -> bool:
        """Count what somebody needs; whether nobody did before."""
        table = self.counted.get(layer)
        if table is None:
            if len(self.counted) >= MOST_TABLES:
                return True
            table = self.counted[layer] = sparse_zeros(len(self.catalogue), np.bool_)
        is_new = not table[index]
        table[index] = True
        return is_new


@dataclass(eq=False, slots=True)
class _Looking:
    """One client's way, being looked over: loads that it needs, those that nobody before it does."""

    way: WayAhead
    ahead_s: float | None = None
    found: int = 0
    new: int = 0


class KeepingAhead:
    """Keeps the gauges that tell whether clients find in memory what they come to."""

    def __init__(self, cache: CellCache, scheduler: Scheduler, sessions: Sessions) -> None:
        self._cache, self._scheduler, self._sessions = cache, scheduler, sessions
        self._round: _Round | None = None
        self._looking: _Looking | None = None
        self._out_since_s: float | None = None

    def look(self, now_s: float) -> None:
        """Go on looking, and bring the gauges up to date."""
        self._look_at_origin(now_s)
        if self._cache.unentered:  # after a reload it takes a moment until what is in memory is found
            return
        end_s = time.thread_time() + LOOKS_S
        for number in range(LOOKS_A_BEAT):
            if number and time.thread_time() > end_s:
                return
            current = self._round
            if current is None or current.catalogue is not self._cache.catalogue:
                first = deque(islice(self._sessions, MOST_WAYS))
                current, self._looking = _Round(first, self._cache.catalogue), None
                self._round = current
            if self._looking is None:
                self._looking = self._next(current, now_s)
            if self._looking is None:
                self._tell(current)
                self._round = None
                return
            self._step(current, self._looking)

    def _look_at_origin(self, now_s: float) -> None:
        """What loads tell of where the map comes from, and what keeps cells from being fetched ahead."""
        prefetcher, statistics = self._scheduler.prefetcher, self._cache.statistics
        budget_bytes = self._cache.ledger.budget_bytes
        health, limit = prefetcher.prefetch.health, self._scheduler.pool.limit
        statistics.set("most_workers", limit)
        statistics.set("ride_out_ns", int(prefetcher.ride_out_s * 1e9))
        statistics.set("prefetch_budget_bytes", int(prefetcher.share * budget_bytes))
        statistics.set("prefetch_short", prefetcher.shortage(now_s))
        # some loaders are reserved for cells that clients wait for; each one fetches many cells at once
        loaders = max(limit * self._scheduler.pool.places - prefetcher.kept_places, 1)
        statistics.set("loadable_per_1000s", int(1e3 * loaders / health.mean_s) if health.mean_s else 0)
        statistics.set("origin_out", int(health.is_out))
        if health.is_out and self._out_since_s is None:
            self._out_since_s = now_s - health.waited_s
            statistics.add("origin_outages")
            statistics.set("origin_out_since_unix_ns", time.time_ns() - int(health.waited_s * 1e9))
        if self._out_since_s is not None:
            statistics.set("last_outage_ns", int((now_s - self._out_since_s) * 1e9))
            if not health.is_out:
                self._out_since_s = None
                statistics.set("origin_out_since_unix_ns", 0)

    def _next(self, current: _Round, now_s: float) -> _Looking | None:
        """The next client that moves, its way from the beginning; None if there is none."""
        while current.left:
            session = current.left.popleft()
            if session.area is None:
                continue
            way = WayAhead(session.motion, session.area, session.layers)
            if not way.moves:
                continue
            here, _ = current.catalogue.query(session.area, MOST_CELLS)
            if len(here) > MOST_CELLS:
                continue
            way.begin(now_s)
            current.clients += 1
            current.routed += session.motion.route is not None
            current.fastest_mps = max(current.fastest_mps, session.motion.speed_mps)
            cells = np.array(self._cache.at_height(here.tolist(), session.area.z), dtype=np.intp)
            cold = ((index, layer) for layer in way.layers for index in self._cold(cells, layer))
            misses = any(self._is_missing(index, layer) for index, layer in cold)
            return _Looking(way, 0.0 if misses else None)
        return None

    def _step(self, current: _Round, looking: _Looking) -> None:
        """Look at what comes next on a client's way."""
        way = looking.way
        look_ahead = self._scheduler.prefetcher.prefetch.look_ahead
        way.look(current.catalogue, look_ahead, STEP_M)
        while (first := way.first()) is not None:
            needed_in_s, index = first
            way.take()
            for layer in way.layers:
                looking.found += 1
                looking.new += current.count(index, layer)
                if looking.ahead_s is None and self._is_missing(index, layer):
                    looking.ahead_s = needed_in_s
        if way.over:
            self._looked(current, looking, way.looks_s(look_ahead))

    def _looked(self, current: _Round, looking: _Looking, look_ahead_s: float) -> None:
        """A client's way was looked over to its end."""
        way, ahead_s = looking.way, looking.ahead_s
        way.begin(way.began_s)  # says what the pass has found
        if looking.found:
            share = looking.new / looking.found
            current.needed += share * way.needed_per_m * len(way.layers) / way.pace_s
        current.look_ahead_s = max(current.look_ahead_s, look_ahead_s)
        current.least_s = min(current.least_s, look_ahead_s if ahead_s is None else ahead_s)
        self._looking = None

    def _cold(self, cells: NDArray[np.intp], layer: str) -> list[int]:
        """Those of some cells that are not simply warm."""
        versions = self._cache.warm.versions(layer, cells) or [0] * len(cells)
        return [index for index, version in zip(cells.tolist(), versions, strict=True) if not version]

    def _is_missing(self, index: int, layer: str) -> bool:
        """Whether a client that comes to a cell would have to wait for it."""
        if self._cache.warm.get(index, layer) is not None:
            return False
        loads = self._scheduler.loads
        failure = loads.failures.get(Key(self._cache.catalogue.id(index), layer))
        is_out = self._scheduler.prefetcher.prefetch.health.is_out
        return failure is None or is_out or failure.code in PASSING_CODES

    def _tell(self, current: _Round) -> None:
        """Show what a round has found."""
        statistics = self._cache.statistics
        statistics.set("moving_clients", current.clients)
        statistics.set("routed_clients", current.routed)
        statistics.set("fastest_mm_per_s", int(1e3 * current.fastest_mps))
        statistics.set("needed_per_1000s", int(1e3 * current.needed))
        statistics.set("look_ahead_ns", int(current.look_ahead_s * 1e9))
        statistics.set("ahead_ns", int(current.least_s * 1e9) if current.clients else 0)
