# SPDX-License-Identifier: Apache-2.0
"""Eviction: retires the segments that clients will need last, except those that a process has mapped.

One turn of the serving loop handles a bounded number of segments; the others follow in later turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.eviction_order import BATCH, Score
from shmmap.daemon.cache.reclaimer import (
    HAND_OUT_GRACE_S,
    LOOKS_PER_TURN,
    SHARE_S,
    WATCHED_INTERVAL_S,
    Reclaimer,
)
from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import NOWHERE, Places, until_needed

PIN_MEMO_S: Final = 0.2
"""How long, at least, a segment found pinned is not considered again.  The time grows with each try if the
kernel reports when a process closes the segment."""
PREFETCHED_PER_TURN: Final = 64
"""Prefetched segments compared with a wish at a time: a tenth of a millisecond."""
PRESSURE_S: Final = 10.0
"""How long scores are kept up to date after memory was short."""
REFRESH_S: Final = 0.004
"""How often a few scores are updated."""
ROUND_S: Final = 2.0
"""Minimum interval of rounds that update the scores of all segments, a few at a time."""
WORK_PER_TURN: Final = 4
"""Segments handled by one `free`: checking one takes 15 us, and retiring one is as much work again."""
PLACES_S: Final = 0.25
"""How often the positions of moving clients are updated."""
MAX_SCORE: Final = 1e12
"""Score of what will never be needed; finite, so that scores can be compared."""
SPARE_SCORE: Final = 1e15
"""Added to the score of what was loaded into spare memory."""
SOON_S: Final = 30.0
"""Added to the time until a segment is needed; without it, size would not matter for those needed soon."""


def eviction_scores(candidates: Sequence[Resident], places: Places, now_s: float) -> NDArray[np.float64]:
    """Score segments, (N,): the highest is evicted first; among equals, the one unused for longest.

    The score is the time until a segment is needed (s), weighted by the square root of its size: of the
    exponents tried, this one saved most bytes of loading where sizes differ.  Without any place the least
    recently used segment is evicted first.  Requested, prefetched and computed segments are scored alike;
    what was loaded into spare memory goes before all others.

    Parameters
    ----------
    places
        Present and future positions of the clients.
    """
    spare = SPARE_SCORE * np.array([resident.spare for resident in candidates], dtype=np.float64)
    if not len(places):
        return spare - np.array([resident.last_use_s for resident in candidates], dtype=np.float64)
    boxes = np.array([resident.box for resident in candidates]).reshape(-1, 4)
    sizes = np.array([resident.nbytes for resident in candidates], dtype=np.float64)
    scores: NDArray[np.float64] = (until_needed(boxes, places, now_s) + SOON_S) * np.sqrt(sizes)
    return np.minimum(scores, MAX_SCORE) + spare


_UNTIL_CLIENTS_MOVE: Final = Score(lambda some: eviction_scores(some, NOWHERE, 0.0))


@dataclass(eq=False, slots=True)
class Evictor:
    """Retires segments in the eviction order, and keeps that order up to date.

    Attributes
    ----------
    evicted_count
        Number of segments retired to make room.
    wake_s
        When `free` is worth calling again although nothing changed: at once, or when a grace period ends.
    """

    reclaimer: Reclaimer
    evicted_count: int = 0
    wake_s: float = math.inf
    # count of changes after which nothing could be freed, until when that holds, and when to try again
    _waits: tuple[int, float, float] = (-1, -math.inf, -math.inf)
    _score: Score = _UNTIL_CLIENTS_MOVE
    _round: Iterator[Resident] = field(default_factory=lambda: iter(()))
    _round_version: int = 0
    _round_s: float = -math.inf
    _placed_s: float = -math.inf
    _refreshed_s: float = -math.inf
    _refresh_until_s: float = -math.inf
    _new_ones: bool = False

    def free(self, shortage: int, now_s: float, *, rather_than: Resident | None = None) -> bool:
        """Retire segments until ``shortage`` bytes are about to be freed; return False if the rest is in use.

        True may also mean that calling again at ``wake_s`` helps.

        Parameters
        ----------
        rather_than
            Prefetched cell that the room is for: segments that would be evicted after it stay.
        """
        ledger = self.reclaimer.ledger
        self.wake_s = math.inf
        missing = shortage - ledger.coming_bytes
        if missing <= 0:
            return True
        self._refresh_until_s = now_s + PRESSURE_S
        order, work = ledger.order, 0
        if rather_than is None and order.changes == self._waits[0] and now_s < self._waits[1]:
            self.wake_s = self._waits[2]
            return True
        score = self._scored(now_s, 4.0 * PLACES_S)  # normally `run_step` keeps them up to date
        if order.fill(score, now_s):
            self.wake_s = now_s
            return True
        first = order.front(score)
        if first is None:
            self.wake_s = now_s
            return True
        if rather_than is not None:
            least, *scores = score.of([rather_than, *first])
            first = [resident for resident, its in zip(first, scores, strict=True) if its > least]
        for resident in first:
            graced_s = resident.last_use_s + HAND_OUT_GRACE_S
            if ledger.is_needed(resident.key):
                order.defer(resident, order.deferred, math.inf)
            elif graced_s > now_s:
                order.defer(resident, order.in_grace, graced_s)
            elif work >= WORK_PER_TURN:
                break
            elif self._found_in_use(resident, now_s):
                work += 1
            else:
                work = WORK_PER_TURN
                missing -= resident.nbytes
                self.reclaimer.retire(resident, now_s, "room")
                self.evicted_count += 1
                if missing <= 0:
                    return True
        if first:
            self.wake_s = now_s
            return True
        if rather_than is not None:
            return ledger.coming_bytes >= shortage
        return self._is_any_soon_free(now_s) or ledger.coming_bytes >= shortage

    def give_up_prefetched(self, shortage: int, now_s: float, wished: Resident) -> bool:
        """Retire prefetched segments that no client has asked for and that are needed later than ``wished``.

        Returns whether there were any.  Each call examines some of them, the next call others.
        """
        ledger = self.reclaimer.ledger
        some = [
            one for one in islice(ledger.prefetched, PREFETCHED_PER_TURN) if not ledger.is_needed(one.key)
        ]
        for resident in some:  # move them to the end
            del ledger.prefetched[resident]
            ledger.prefetched[resident] = None
        least, *scores = self._scored(now_s, 4.0 * PLACES_S).of([wished, *some])
        later = sorted((its, number) for number, its in enumerate(scores) if its > least)
        work = WORK_PER_TURN
        while later and shortage > 0 and work:
            resident = some[later.pop()[1]]
            self.reclaimer.retire(resident, now_s, "room")
            self.evicted_count += 1
            shortage -= resident.nbytes
            work -= 1
        return work < WORK_PER_TURN

    def _is_any_soon_free(self, now_s: float) -> bool:
        """Whether a grace period is worth waiting for: no process has opened that segment yet."""
        ledger = self.reclaimer.ledger
        order = ledger.order
        for _ in range(LOOKS_PER_TURN):
            soon = order.in_grace.first()
            if soon is None:
                return False
            until_s, resident = soon
            if resident not in order.in_grace:
                continue
            if ledger.is_needed(resident.key):
                order.defer(resident, order.deferred, math.inf)
            elif not self._found_in_use(resident, now_s):
                deferred = order.deferred.first()
                first_s = min(until_s, deferred[0]) if deferred is not None else until_s
                self._waits = order.changes, first_s, until_s
                self.wake_s = until_s
                return True
        self.wake_s = now_s
        return True

    def _found_in_use(self, resident: Resident, now_s: float) -> bool:
        """Whether a process has a segment mapped; if so, defer it."""
        if not self.reclaimer.is_pinned(resident):
            return False
        order = self.reclaimer.ledger.order
        longer_s = 2.0 * resident.deferred_s if self.reclaimer.pins.watch_next_close(resident.name) else 0.0
        resident.deferred_s = min(max(PIN_MEMO_S, longer_s), WATCHED_INTERVAL_S)
        order.defer(resident, order.deferred, now_s + max(resident.deferred_s, SHARE_S * len(order.deferred)))
        return True

    # --- keeping the order up to date -----------------------------------------------------------

    @property
    def next_s(self) -> float:
        """When `run_step` has something to do; for a while after memory was short."""
        return self._refreshed_s + REFRESH_S if self._refreshed_s < self._refresh_until_s else math.inf

    def run_step(self, now_s: float) -> None:
        """Score some new segments, or update some scores, alternately."""
        self._refreshed_s = now_s
        ledger, before = self.reclaimer.ledger, self._score
        score = self._scored(now_s, PLACES_S)
        if score is not before:
            return  # enough for this turn
        self._new_ones = not self._new_ones
        if self._new_ones:
            ledger.order.score_new(score)
        elif some := list(islice(self._round, BATCH)):
            ledger.order.refresh(some, score)
        elif self._round_version != score.version and now_s - self._round_s >= ROUND_S:
            self._round_s = now_s
            self._round, self._round_version = ledger.segments.walk(), score.version

    def _scored(self, now_s: float, age_s: float) -> Score:
        """Return how segments are scored, by client positions that are at most ``age_s`` old."""
        sessions = self.reclaimer.sessions
        if sessions.places_version != self._score.version and now_s - self._placed_s >= age_s:
            self._placed_s = now_s
            places = sessions.places()
            self._score = Score(lambda some: eviction_scores(some, places, now_s), sessions.places_version)
        return self._score
