# SPDX-License-Identifier: Apache-2.0
"""Carries out what `Prefetch` wishes for, with loaders and memory that no client needs just now.

A wish becomes a load like any other when nothing else is queued and a loader has a free place: so one at most
waits, none is out of date, and what a client asks for comes first.  Some places are kept free, so that a
demand need not wait for a wish, unless the wish is nearly one itself.  Memory: a wish takes the place of what
will be needed later than itself, never of what will be needed sooner or is in use, and what was fetched ahead
and not asked for yet takes its share of the budget at most: in a full share, too, what is needed first stays.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.loading.look_ahead import URGENT_S, Prefetch
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.records import Key, Load, Resident
from shmmap.daemon.transport.sessions import MOVES_PER_STEP, Session

__all__ = ["Prefetcher"]

MAX_PATHS: Final = 256
"""Clients for which cells are fetched ahead; each costs a look at every wish."""
MISSES_PER_TURN: Final = 64
MAX_COLD: Final = 1 << 14
"""Cells of all clients that were not in memory, between two turns; of more the first are forgotten."""
MAX_ENDED: Final = 1024
"""Loads that ended between two turns; of more the first are forgotten."""
FOLLOW_S: Final = 0.005
"""How long moves of a few clients may wait, and ended loads while no client moves: many of them are looked at
together."""
KEPT: Final = 4
"""Part of one loader's places that is kept free for demands: a quarter, one at least."""
SWAP_S: Final = 0.25
"""How long the full share is not looked through again after there was nothing in it to give up."""
FULL_S: Final = 1.0
"""How long nothing is fetched ahead after there was no room for it."""


class Prefetcher:
    """Fetches what clients will ask for.

    Parameters
    ----------
    share
        Part of the budget for what was fetched ahead and not asked for yet; 0: nothing is fetched ahead.
    outage_tolerance_s
        See `Prefetch`.
    """

    def __init__(
        self, cache: CellCache, loads: Loads, pool: WorkerPool, *, share: float, outage_tolerance_s: float
    ) -> None:
        self._cache, self._loads, self._pool = cache, loads, pool
        self._sessions, self._ledger, self._evictor = cache.sessions, cache.ledger, cache.evictor
        self._layers, self._events, self._statistics = cache.layers, cache.events, cache.statistics
        self.cold: deque[tuple[Session, Key]] = deque(maxlen=MAX_COLD)
        self.ended: deque[tuple[Load, bool, float, bool]] = deque(maxlen=MAX_ENDED)
        self.share, self.outage_tolerance_s = share, outage_tolerance_s
        self.prefetch = Prefetch(self._is_absent, outage_tolerance_s)
        self.health = self.prefetch.health
        self._now_s = 0.0
        self._next_s = -math.inf
        self._full_until_s = self._followed_s = self._answered_s = -math.inf
        self._swapped_s = -math.inf
        self._running: dict[Load, int] = {}
        self._no_room = False

    @property
    def budget_bytes(self) -> float:
        """Memory that prefetched cells may take until a client asks for them."""
        return self.share * self._ledger.budget_bytes

    def note_cold(self, session: Session, key: Key) -> None:
        """Note that a client is the first to ask for a cell, and that it is not in memory."""
        load = self._loads.by_key.get(key)
        if load is None or load.prefetch:
            self.cold.append((session, key))
            self._statistics.add("prefetch_overtaken", load is not None and load.running)

    def restart(self) -> None:
        """Look along all paths from the start: what is known of the map or its origin has changed."""
        self.prefetch.restart()
        self._next_s = -math.inf

    # --- clients ----------------------------------------------------------------------------------

    def _follow(self, session: Session) -> None:
        """Follow a client that has moved, asked for another area, or gone."""
        paths = self.prefetch.paths
        if session.area is None or not self.share:
            paths.pop(session, None)
        elif session in paths or len(paths) < MAX_PATHS:
            self.prefetch.follow(session, session.motion, session.area, session.layers)

    def _count_misses(self) -> None:
        """Count prefetch misses: cells that moving clients wait for; the first request and jumps are none."""
        for _ in range(min(MISSES_PER_TURN, len(self.cold))):
            session, key = self.cold[0]
            if session in self._sessions.moved:
                break  # first where it is
            self.cold.popleft()
            if session.motion.travelled_m > 0.0:
                self._events.prefetch_missed(session, key)

    # --- a background task of the serving loop ----------------------------------------------------

    @property
    def next_s(self) -> float:
        """When there is something to do: at once when clients moved, loads ended, or a path is looked at."""
        many = len(self._sessions.moved) > MOVES_PER_STEP
        if self.cold or many or (self.ended and self.prefetch.paths):
            return -math.inf
        next_s = self._next_s if self.prefetch.paths else math.inf
        return min(next_s, self._followed_s + FOLLOW_S) if self._sessions.moved or self.ended else next_s

    def run_step(self, now_s: float) -> None:
        """Follow some clients that moved, and fetch what is needed first of what is not asked for."""
        self._now_s = now_s
        self._followed_s = now_s
        for session in self._sessions.follow_moves():
            self._follow(session)
        self._count_misses()
        while self.ended:
            self._learn(*self.ended.popleft())
        if now_s < self._full_until_s:
            self._next_s = self._full_until_s
        elif not self._may_begin():
            self._next_s = math.inf  # until a load ends
        else:
            self._wish(now_s)

    def _may_begin(self) -> bool:
        """Whether a loader could begin one more."""
        return not len(self._loads) and self._pool.free_places > 0

    @property
    def kept_places(self) -> int:
        """How many places are kept free; not the only one."""
        pool = self._pool
        return min(max(1, pool.places // KEPT), pool.limit * pool.places - 1)

    def _wish(self, now_s: float) -> None:
        cache, prefetch = self._cache, self.prefetch
        wish = prefetch.next(cache.catalogue, now_s)
        if wish is None:
            self._next_s = now_s if prefetch.more else prefetch.next_s(now_s)
            return
        if wish.needed_in_s > URGENT_S and self._pool.free_places <= self.kept_places:
            # the last ones wait for demands, until a load ends or a client comes nearer
            self._next_s = now_s + wish.needed_in_s - URGENT_S
            return
        key, nbytes = cache.key(wish.cell, wish.layer), cache.estimate(wish.cell, wish.layer)
        taken = self._ledger.prefetched_bytes + sum(self._running.values())
        self._no_room = taken + nbytes > self.budget_bytes
        if self._no_room:
            shortage = int(taken + nbytes - self.budget_bytes)
            self._next_s = now_s if self._swap(key, wish.cell, nbytes, shortage) else math.inf
        else:
            computed = self._layers.is_computed(wish.cell, wish.layer)
            self._loads.prefetch(key, nbytes, wish.needed_in_s, computed=computed)
            self._next_s = now_s

    def _swap(self, key: Key, index: int, nbytes: int, shortage: int) -> bool:
        """Give up what was fetched ahead and is needed later, for a wish that their share has no room for."""
        if self._now_s < self._swapped_s + SWAP_S:
            return False  # the next move of a client asks again
        swapped = self._evictor.give_up_prefetched(shortage, self._now_s, self._wished(key, index, nbytes))
        if not swapped:
            self._swapped_s = self._now_s
        return swapped

    def _wished(self, key: Key, index: int, nbytes: int) -> Resident:
        """Return a wish as it would be in memory, to compare it with what is there."""
        box = self._cache.catalogue.box(index)
        return Resident("", key, 0, nbytes, 0, box, 0.0, 0.0, last_use_s=self._now_s)

    def _is_absent(self, index: int, layer: str) -> bool:
        """Whether a cell could be fetched ahead; one that is larger than the share never can."""
        key = self._cache.key(index, layer)
        if self._cache.find_warm(index, layer, self._now_s) is not None or key in self._loads.by_key:
            return False
        failure = self._loads.failures.get(key)
        may_fit = self._cache.estimate(index, layer) <= self.budget_bytes
        return may_fit and (failure is None or self._now_s >= failure.retry_at_s)

    # --- loads ------------------------------------------------------------------------------------

    def make_room(self, load: Load, shortage: int, now_s: float) -> bool:
        """Free memory for a wish; False if all there is will be needed sooner, or is in use."""
        index = self._cache.index_of(load.key.cell_id)
        if index is not None:
            wished = self._wished(load.key, index, load.estimate)
            if self._evictor.free(shortage, now_s, rather_than=wished):
                return True
        self.full(now_s)
        return False

    def full(self, now_s: float) -> None:
        """Note that there is no memory for a wish just now."""
        self._full_until_s = now_s + FULL_S

    def note_end(self, load: Load, took_s: float, *, out: bool) -> None:
        """Note the end of a load, the loader's time, and whether what it read was out of reach."""
        self.ended.append((load, load.running, took_s, out))

    def started(self, load: Load) -> None:
        """Note that a loader has a wish."""
        self._statistics.add("prefetch_started", load not in self._running)
        self._running[load] = load.estimate

    def _learn(self, load: Load, ran: bool, took_s: float, out: bool) -> None:
        """Learn from the end of a load whether its origin answers.

        A broken file counts as an answer.  The failure of a load that began before another one succeeded
        belongs to an outage that is over.
        """
        self._running.pop(load, None)
        if not ran or not load.sources or (out and self._now_s - took_s < self._answered_s):
            return
        if not out:
            self._answered_s = self._now_s
        if self.health.ended(took_s, failed=out):
            self._loads.forget_failures()

    def lacks_room(self, now_s: float) -> bool:
        """Whether there was no memory for the last wish."""
        return self._no_room or now_s < self._full_until_s

    def shortage(self, now_s: float) -> int:
        """Return what keeps cells from being fetched: 0 nothing, 1 their share is full, 2 the budget is."""
        if self._ledger.prefetched_bytes + sum(self._running.values()) >= self.budget_bytes:
            return 1 if self.share else 0
        return 2 if now_s < self._full_until_s else 0
