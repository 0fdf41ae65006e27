# SPDX-License-Identifier: Apache-2.0
"""Carries out the wishes of `Prefetch` with loaders and memory that no client needs at the moment.

A wish becomes an ordinary load when nothing else is queued and a loader has a free place.  So at most one
wish waits, none is outdated, and clients' requests come first.  Some places are kept free, so that a demand
does not wait for a wish, unless the wish is almost a demand itself.  Memory: a wish replaces segments that
are needed later than itself, never segments that are needed sooner or are in use.  Prefetched segments that
no client has asked for take at most their share of the budget; in a full share, too, those needed first stay.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.evictor import Freeing
from shmmap.daemon.loading.link import Link
from shmmap.daemon.loading.loads import Attempt, Load, Loads, Purpose, kind_of
from shmmap.daemon.loading.look_ahead import URGENT_S, Prefetch, Reader
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.transport.sessions import MOVES_PER_STEP, Session

MAX_PATHS: Final = 256
"""Clients for which cells are prefetched; each adds a comparison to every wish."""
MISSES_PER_TURN: Final = 64
MAX_COLD: Final = 1 << 14
"""Limit of cells noted between two turns as requested but not in memory; the oldest are dropped."""
MAX_ENDED: Final = 1024
"""Limit of ended loads noted between two turns; the oldest are dropped."""
LEARNED_PER_STEP: Final = 64
"""Ended loads from which one step learns whether the origin answers; the others wait for the next."""
FOLLOW_S: Final = 0.005
"""How long a few clients' moves may wait, or ended loads while no client moves, to be handled together."""
KEPT: Final = 4
"""Divisor: 1/4 of one loader's places, at least one, is kept free for demands."""
SWAP_S: Final = 0.25
"""How long a full share is not searched again after a search found no segment to give up."""
FULL_S: Final = 1.0
"""How long nothing is prefetched after there was no memory for a wish."""


class Prefetcher:
    """Prefetches the cells that clients will ask for.

    Parameters
    ----------
    share
        Share of the budget for prefetched cells that no client has asked for yet; 0: no prefetching.
    outage_tolerance_s
        See `Prefetch`.
    """

    def __init__(
        self,
        cache: CellCache,
        loads: Loads,
        pool: WorkerPool,
        link: Link | None = None,
        *,
        share: float,
        outage_tolerance_s: float,
    ) -> None:
        self._cache, self._loads, self._pool, self._link = cache, loads, pool, link
        self._sessions, self._ledger, self._evictor = cache.sessions, cache.ledger, cache.evictor
        self._layers, self._events, self._statistics = cache.layers, cache.events, cache.statistics
        self.cold: deque[tuple[Session, Key]] = deque(maxlen=MAX_COLD)
        self.ended: deque[tuple[Attempt | None, bool]] = deque(maxlen=MAX_ENDED)
        self.share, self.outage_tolerance_s = share, outage_tolerance_s
        self.prefetch = Prefetch(self._is_missing, outage_tolerance_s)
        self._reader = Reader(self._is_absent)
        self.health = self.prefetch.health
        self._now_s = 0.0
        self._next_s = -math.inf
        self._full_until_s = self._followed_s = self._answered_s = -math.inf
        self._swapped_s = -math.inf
        self._running: dict[Load, int] = {}
        self._no_room = self._has_followed = False

    @property
    def budget_bytes(self) -> float:
        """Memory that prefetched cells may take until a client asks for them."""
        return self.share * self._ledger.budget_bytes

    def note_cold(self, session: Session, key: Key) -> None:
        """Note that a client is the first to ask for a cell that is not in memory."""
        load = self._loads.by_key.get(key)
        if load is None or load.work is Purpose.WISH:
            self.cold.append((session, key))
            self._statistics.add("prefetch_overtaken", load is not None and load.is_running)

    def restart(self) -> None:
        """Examine all paths from the start: the map or its origin is known better now."""
        self.prefetch.restart()
        self._next_s = -math.inf

    # --- clients ----------------------------------------------------------------------------------

    def _follow(self, session: Session) -> None:
        """Follow a client that has moved, asked for another area, or left."""
        paths = self.prefetch.paths
        if session.area is None or not self.share:
            paths.pop(session, None)
        elif session in paths or len(paths) < MAX_PATHS:
            self.prefetch.follow(session, session.motion, session.area, session.layers)

    def _count_misses(self) -> None:
        """Count prefetch misses: cells that moving clients wait for, except at first requests and jumps."""
        for _ in range(min(MISSES_PER_TURN, len(self.cold))):
            session, key = self.cold[0]
            if session in self._sessions.moved:
                break  # first update the client's position
            self.cold.popleft()
            if session.motion.travelled_m > 0.0:
                self._events.prefetch_missed(session, key)

    # --- a background task of the serving loop ----------------------------------------------------

    @property
    def next_s(self) -> float:
        """When there is something to do: at once if clients moved, loads ended, or a path is examined."""
        return min(self._news_s, self._next_s if self.prefetch.paths else math.inf)

    @property
    def _news_s(self) -> float:
        """When moves of clients and ends of loads are to be handled."""
        many = len(self._sessions.moved) > MOVES_PER_STEP
        if self.cold or many or (self.ended and self.prefetch.paths):
            return -math.inf
        return self._followed_s + FOLLOW_S if self._sessions.moved or self.ended else math.inf

    def run_step(self, now_s: float) -> None:
        """Follow some clients that moved, or prefetch the cell that is needed first, in turn."""
        self._now_s = now_s
        self._has_followed = not self._has_followed and self._news_s <= now_s
        if self._has_followed:
            self._followed_s, self._next_s = now_s, -math.inf
            for session in self._sessions.follow_moves():
                self._follow(session)
            self._count_misses()
            for _ in range(min(LEARNED_PER_STEP, len(self.ended))):
                self._learn(*self.ended.popleft())
            return
        self.prefetch.note_origin(now_s)
        if now_s < self._full_until_s:
            self._next_s = self._full_until_s
        elif not self._may_begin():
            self._next_s = self._link.rests_until_s if self._link is not None else math.inf  # or a load ends
        else:
            self._wish(now_s)

    def _may_begin(self) -> bool:
        """Whether a loader and the link could begin another load."""
        may = not len(self._loads) and self._pool.free_places > 0
        return may and (self._link is None or self._link.may_begin(self._now_s, ahead=True))

    @property
    def kept_places(self) -> int:
        """Number of places kept free for demands; never all places."""
        pool = self._pool
        return min(max(1, pool.places // KEPT), pool.limit * pool.places - 1)

    def _wish(self, now_s: float) -> None:
        cache, prefetch = self._cache, self.prefetch
        wish = prefetch.next(cache.catalogue, now_s, self._reader)
        if wish is None:
            self._next_s = prefetch.next_s(now_s, self._reader)
            return
        if wish.needed_in_s > URGENT_S and self._pool.free_places <= self.kept_places:
            # the last places are kept for demands, until a load ends or a client comes nearer
            self._next_s = now_s + wish.needed_in_s - URGENT_S
            return
        _, key, nbytes = cache.absent(wish.cell, wish.layer)
        taken = self._ledger.prefetched_bytes + sum(self._running.values())
        self._no_room = taken + nbytes > self.budget_bytes
        if self._no_room:
            shortage = int(taken + nbytes - self.budget_bytes)
            self._next_s = now_s if self._swap(key, wish.cell, nbytes, shortage) else math.inf
        else:
            kind = kind_of(cache, wish.cell, wish.layer)
            self._loads.prefetch(key, nbytes, wish.needed_in_s, kind=kind)
            self._next_s = now_s

    def _swap(self, key: Key, index: int, nbytes: int, shortage: int) -> bool:
        """Retire prefetched cells that are needed later than a wish for which their share has no room."""
        if self._now_s < self._swapped_s + SWAP_S:
            return False  # the next move of a client repeats the call
        swapped = self._evictor.give_up_prefetched(shortage, self._now_s, self._wished(key, index, nbytes))
        if not swapped:
            self._swapped_s = self._now_s
        return swapped

    def _wished(self, key: Key, index: int, nbytes: int) -> Resident:
        """Return a wish as if it were in memory, to compare it with segments."""
        box = self._cache.catalogue.box(index)
        return Resident("", key, 0, nbytes, 0, box, 0.0, 0.0, last_use_s=self._now_s)

    def _is_missing(self, index: int, layer: str) -> bool:
        """Whether a layer of a cell is not in memory."""
        return self._cache.find_warm(index, layer, self._now_s) is None

    def _is_absent(self, index: int, layer: str) -> bool:
        """Whether a cell could be prefetched; a cell larger than the share never can."""
        key = self._cache.key(index, layer)
        if key in self._loads.by_key or not self._is_missing(index, layer):
            return False
        failure = self._loads.failures.get(key)
        may_fit = self._cache.estimate(index, layer) <= self.budget_bytes
        return may_fit and (failure is None or self._now_s >= failure.retry_at_s)

    # --- loads ------------------------------------------------------------------------------------

    def make_room(self, load: Load, shortage: int, now_s: float) -> bool:
        """Free memory for a wish; return False if all other segments are needed sooner, or are in use."""
        index = self._cache.index_of(load.key.cell_id)
        if index is not None:
            wished = self._wished(load.key, index, load.estimate)
            if self._evictor.free(shortage, now_s, rather_than=wished) is not Freeing.NO_MORE:
                return True
        self.full(now_s)
        return False

    def full(self, now_s: float) -> None:
        """Note that there is no memory for a wish at present."""
        self._full_until_s = now_s + FULL_S

    def note_end(self, load: Load, *, out: bool) -> None:
        """Note the end of a load, and whether its source was unreachable."""
        self._running.pop(load, None)
        self.ended.append((load.attempt, out))

    def started(self, load: Load) -> None:
        """Note that a loader has begun a wish."""
        self._statistics.add("prefetch_started", load not in self._running)
        self._running[load] = load.estimate

    def _learn(self, attempt: Attempt | None, out: bool) -> None:
        """Infer from the end of a load whether its origin answers.

        A broken file counts as an answer.  The failure of a load that began before another load succeeded
        belongs to an outage that has ended.
        """
        if attempt is None or not attempt.sources:
            return
        if out and self._now_s - attempt.took_s < self._answered_s:
            return
        if not out:
            self._answered_s = self._now_s
        if self.health.ended(attempt.took_s, failed=out):
            self._loads.forget_failures()

    def lacks_room(self, now_s: float) -> bool:
        """Whether there was no memory for the last wish."""
        return self._no_room or now_s < self._full_until_s

    def shortage(self, now_s: float) -> int:
        """Return what prevents prefetching: 0 nothing, 1 the share is full, 2 the budget is full."""
        if self._ledger.prefetched_bytes + sum(self._running.values()) >= self.budget_bytes:
            return 1 if self.share else 0
        return 2 if now_s < self._full_until_s else 0
