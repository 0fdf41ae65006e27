# SPDX-License-Identifier: Apache-2.0
"""Carries out what `Prefetch` wishes for, with loaders and memory that nobody asks for just now.

A wish becomes a load like any other when nothing else is queued and a loader has a free place: so one at most
waits, none is out of date, and what a client asks for comes first.  Some places are kept free, so that a
demand need not wait for a wish, unless the wish is nearly one itself.  Memory: a wish takes the place of what
will be needed later than itself, never of what will be needed sooner or is in use, and what was fetched ahead
and not asked for yet takes its share of the budget at most.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import Loads
from shmmap.daemon.loading.prefetch.prefetch import URGENT_S, Prefetch
from shmmap.daemon.loading.prefetch.way_ahead import WayAhead
from shmmap.daemon.loading.worker_pool import WorkerPool
from shmmap.daemon.records import Key, Load, Resident
from shmmap.daemon.transport.sessions import MOVES_AT_ONCE, Session

__all__ = ["Prefetcher"]

MOST_WAYS: Final = 256
"""Clients for which cells are fetched ahead; each costs a look at every wish."""
LATE_AT_ONCE: Final = 64
MOST_COLD: Final = 1 << 14
"""Cells that were not in memory, of all clients, between two turns; of more the first are forgotten."""
MOST_ENDED: Final = 1024
"""Loads that ended between two turns; of more the first are forgotten."""
FOLLOW_S: Final = 0.005
"""So long moves of a few clients may wait, and ended loads while nobody is on a way: of many that follow one
another all are looked at once."""
KEPT: Final = 4
"""A part of one loader's places is kept free for demands: a quarter, one at least."""
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

    Attributes
    ----------
    cold
        Cells that clients asked for and nobody had fetched ahead; filled by who answers them.
    ended
        Loads that have ended, whether they ran, the loader's time, and whether what they read was out of
        reach; filled by who ends them.
    """

    def __init__(
        self, cache: CellCache, loads: Loads, pool: WorkerPool, *, share: float, ride_out_s: float
    ) -> None:
        self._cache, self._loads, self._pool = cache, loads, pool
        self._sessions, self._ledger, self._evictor = cache.sessions, cache.ledger, cache.evictor
        self._layers, self._events, self._statistics = cache.layers, cache.events, cache.statistics
        self.cold: deque[tuple[Session, Key]] = deque(maxlen=MOST_COLD)
        self.ended: deque[tuple[Load, bool, float, bool]] = deque(maxlen=MOST_ENDED)
        self.share, self.ride_out_s = share, ride_out_s
        self.prefetch = Prefetch(self._is_absent, ride_out_s)
        self._now_s = 0.0
        self._next_s = -math.inf
        self._full_until_s = self._followed_s = self._answered_s = -math.inf
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
        """Look along all paths from the start: more of the map is known, or less."""
        self.prefetch.restart()
        self._next_s = -math.inf

    # --- clients ----------------------------------------------------------------------------------

    def _follow(self, session: Session) -> None:
        """A client has moved, or asked for another area; or is no more."""
        ways = self.prefetch.ways
        way = ways.get(session)
        if session.area is None or not self.share:
            ways.pop(session, None)
        elif way is not None and way.motion is session.motion:
            way.asks(session.area, session.layers)
        elif way is not None or len(ways) < MOST_WAYS:
            ways[session] = WayAhead(session.motion, session.area, session.layers)

    def _note_late(self) -> None:
        """Count what clients on their way wait for; of who has just come or jumped nobody could know."""
        for _ in range(min(LATE_AT_ONCE, len(self.cold))):
            session, key = self.cold[0]
            if session in self._sessions.moved:
                break  # first where it is
            self.cold.popleft()
            if session.motion.travelled_m > 0.0:
                self._events.prefetch_missed(session, key)

    # --- a chore of the serving loop --------------------------------------------------------------

    @property
    def next_s(self) -> float:
        """When there is something to do: at once when clients moved, loads ended, or a way is looked over."""
        many = len(self._sessions.moved) > MOVES_AT_ONCE
        if self.cold or many or (self.ended and self.prefetch.ways):
            return -math.inf
        next_s = self._next_s if self.prefetch.ways else math.inf
        return min(next_s, self._followed_s + FOLLOW_S) if self._sessions.moved or self.ended else next_s

    def turn(self, now_s: float) -> None:
        """Follow some clients that moved, and wish for what is needed first of what nobody asks for."""
        self._now_s = now_s
        self._followed_s = now_s
        for session in self._sessions.follow_moves():
            self._follow(session)
        self._note_late()
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
            self._next_s = math.inf  # until somebody asks for what was fetched
        else:
            computed = self._layers.is_computed(wish.cell, wish.layer)
            self._loads.prefetch(key, nbytes, wish.needed_in_s, computed=computed)
            self._next_s = now_s

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
        """Have memory freed for a wish; False if all there is will be needed sooner, or is in use."""
        index = self._cache.index_of(load.key.cell_id)
        if index is not None:
            nbytes, catalogue = load.estimate, self._cache.catalogue
            box = catalogue.box(index)
            wished = Resident("", load.key, 0, nbytes, 0, box, 0.0, 0.0, last_use_s=now_s)
            if self._evictor.free(shortage, now_s, rather_than=wished):
                return True
        self.full(now_s)
        return False

    def full(self, now_s: float) -> None:
        """There is no memory for a wish just now."""
        self._full_until_s = now_s + FULL_S

    def started(self, load: Load) -> None:
        """A wish was handed to a loader."""
        self._statistics.add("prefetch_started", load not in self._running)
        self._running[load] = load.estimate

    def _learn(self, load: Load, ran: bool, took_s: float, out: bool) -> None:
        """A load has ended: what that tells of where it comes from.

        A broken file counts as an answer.  The failure of a load that began before another one succeeded
        belongs to an outage that is over.
        """
        self._running.pop(load, None)
        if not ran or not load.sources or (out and self._now_s - took_s < self._answered_s):
            return
        if not out:
            self._answered_s = self._now_s
        if self.prefetch.health.ended(took_s, failed=out):
            self._loads.forget_failures()

    def lacks_room(self, now_s: float) -> bool:
        """Whether there was no memory for the last wish."""
        return self._no_room or now_s < self._full_until_s

    def shortage(self, now_s: float) -> int:
        """What keeps cells from being fetched ahead: 0 nothing, 1 their share is full, 2 the budget is."""
        if self._ledger.prefetched_bytes + sum(self._running.values()) >= self.budget_bytes:
            return 1 if self.share else 0
        return 2 if now_s < self._full_until_s else 0
