# SPDX-License-Identifier: Apache-2.0
"""Carries out what `Prefetch` wishes for, with loaders and memory that nobody asks for just now.

A wish becomes a load like any other, behind everything that somebody asks for.  One loader is kept free, so
that a demand need not wait for a wish; and there is never more than one wish in the queue, so none is
out of date.  Memory: a wish takes the place of what will be needed later than itself, never of what will
be needed sooner or is in use, and what was fetched ahead and not asked for yet takes its share of the
budget at most.
"""

from __future__ import annotations

import math
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.loading.prefetch.prefetch import Prefetch
from shmmap.daemon.loading.prefetch.way_ahead import WayAhead
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.records import SPACE_CODES, Key, Load, Resident
from shmmap.daemon.transport.sessions import Session

__all__ = ["Prefetcher"]

MOST_WAYS: Final = 256
"""Clients for which cells are fetched ahead; each costs a look at every wish."""
FULL_S: Final = 1.0
"""So long nothing is fetched ahead after there was no room for it."""


class Prefetcher:
    """Has fetched what clients will ask for.

    Parameters
    ----------
    share
        Part of the budget that may be taken by what nobody has asked for yet; 0: nothing is fetched ahead.
    ride_out_s
        See `Prefetch`.
    """

    def __init__(
        self, cache: CellCache, loads: Loads, pool: WorkerPool, *, share: float, ride_out_s: float
    ) -> None:
        self._cache, self._loads, self._pool = cache, loads, pool
        self.share, self.ride_out_s = share, ride_out_s
        self.prefetch = Prefetch(self._is_absent, ride_out_s)
        self._now_s = 0.0
        self._next_s = -math.inf
        self._full_until_s = -math.inf
        self._queued: Load | None = None
        self._running: dict[Load, int] = {}

    # --- clients ----------------------------------------------------------------------------------

    def follow(self, session: Session) -> None:
        """A client asked for an area, and may go on from there."""
        ways = self.prefetch.ways
        way = ways.get(session)
        if self._next_s == math.inf:  # what it was handed may have been what took the memory
            self._next_s = -math.inf
        if session.area is None or not self.share:
            return
        if way is not None and way.motion is session.motion:
            way.asks(session.area, session.layers)
        elif way is not None or len(ways) < MOST_WAYS:
            self._next_s = -math.inf
            ways[session] = WayAhead(session.motion, session.area, session.layers)

    def leave(self, session: Session) -> None:
        """A client does not go on."""
        self.prefetch.ways.pop(session, None)

    # --- loads ------------------------------------------------------------------------------------

    def is_due(self, now_s: float) -> bool:
        """Whether `wish` may find something."""
        return now_s >= self._next_s

    def wish(self, now_s: float) -> bool:
        """Queue what is needed first of what nobody has asked for yet; whether to look again at once."""
        self._now_s = now_s
        if now_s < self._full_until_s:
            self._next_s = self._full_until_s
            return False
        if not self._may_begin():
            self._next_s = math.inf  # until a load ends, or somebody asks for something
            return False
        cache, prefetch = self._cache, self.prefetch
        wish = prefetch.next(cache.catalogue, now_s)
        if wish is None:
            self._next_s = now_s if prefetch.more else prefetch.next_s(now_s)
            return prefetch.more
        key = Key(cache.catalogue.id(wish.cell), wish.layer)
        self._queued = self._loads.prefetch(key, cache.estimate(wish.cell, wish.layer), wish.needed_in_s)
        return True

    def _may_begin(self) -> bool:
        """Whether a loader has nothing to do but wait for demands, and there is memory for a wish."""
        queued, self._queued = self._queued, None
        if queued is not None and queued.prefetch and not queued.running and queued.key in self._loads.by_key:
            self._queued = queued
            return False
        ledger, spare = self._cache.ledger, 1 if self._pool.limit > 1 else 0
        taken = ledger.prefetched_bytes + sum(self._running.values())
        return self._pool.idle > spare and taken < self.share * ledger.budget_bytes

    def _is_absent(self, index: int, layer: str) -> bool:
        key = Key(self._cache.catalogue.id(index), layer)
        if self._cache.find_warm(index, layer, self._now_s) is not None or key in self._loads.by_key:
            return False
        failure = self._loads.failures.get(key)
        return failure is None or self._now_s >= failure.retry_at_s

    def make_room(self, load: Load, shortage: int, now_s: float) -> bool:
        """Have memory freed for a wish; False if all there is will be needed sooner, or is in use."""
        index = self._cache.index_of(load.key.cell_id)
        if index is not None:
            nbytes, box = load.estimate, self._cache.catalogue.box(index)
            wished = Resident("", load.key, 0, nbytes, 0, box, 0.0, 0.0, last_use_s=now_s)
            if self._cache.evictor.free(shortage, now_s, rather_than=wished):
                return True
        self._full_until_s = now_s + FULL_S
        return False

    def started(self, load: Load) -> None:
        """A load was handed to a loader."""
        if load.prefetch and load not in self._running:
            self._cache.statistics.add("prefetch_started")
        if load.prefetch:
            self._running[load] = load.estimate

    def heard(self, load: Load, failed: str, now_s: float) -> None:
        """A loader is done with a load; ``failed`` is the code, if it could not do it."""
        if failed in SPACE_CODES:
            if load.prefetch:
                self._full_until_s = now_s + FULL_S
        elif self.prefetch.health.ended(load.spent_s, failed=bool(failed)):
            self._loads.forget_failures()

    def over(self, load: Load) -> None:
        """There is no such load any more."""
        self._running.pop(load, None)
        self._next_s = -math.inf

    def shortage(self, now_s: float) -> int:
        """What keeps cells from being fetched ahead: 0 nothing, 1 their share is full, 2 the budget is."""
        ledger = self._cache.ledger
        if ledger.prefetched_bytes + sum(self._running.values()) >= self.share * ledger.budget_bytes:
            return 1 if self.share else 0
        return 2 if now_s < self._full_until_s else 0

    @property
    def next_s(self) -> float:
        """When to look again though nothing happens."""
        return self._next_s if self.prefetch.ways else math.inf
