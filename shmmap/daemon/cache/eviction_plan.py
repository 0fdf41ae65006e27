# SPDX-License-Identifier: Apache-2.0
"""Which segments are evicted next: a list of those that clients will need last, without any I/O.

All residents are looked at, some in each step, and at most `MAX_LISTED` are listed.  Once as many are listed,
only those in squares of the map that can matter are scored.  The list is not kept up to date: whether a
segment may still be evicted is asked again when its turn comes (`shmmap.daemon.cache.evictor`), and another
list is made while clients move and memory is short.
"""

from __future__ import annotations

import heapq
import math
from bisect import insort
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import NOWHERE, PAIRS_PER_BLOCK, Places, Squares, until_needed

MAX_LISTED: Final = 1024
BLOCK: Final = 32
"""Segments looked at together; fewer where there are many places."""
WORK_PER_STEP: Final = 8000
"""Work after which a step ends: a sixth of a millisecond."""
LOOK_WORK: Final = 96
"""Work of looking at a segment."""
LIST_WORK: Final = 256
"""Work of listing it."""
HAND_OUT_GRACE_S: Final = 1.0
"""A segment that was just handed out is not evicted for this long, so that its reader can open it."""
MAX_SCORE: Final = 1e12
"""Score of what will never be needed; finite, so that scores can be compared."""
SPARE_SCORE: Final = 1e15
"""Added to the score of what was loaded into spare memory."""
SOON_S: Final = 30.0
"""Added to the time until a segment is needed; without it, size would not matter for those needed soon."""


def eviction_scores(some: Sequence[Resident], places: Places, now_s: float) -> NDArray[np.float64]:
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
    spare = SPARE_SCORE * np.array([resident.spare for resident in some], dtype=np.float64)
    if not len(places):
        return spare - np.array([resident.last_use_s for resident in some], dtype=np.float64)
    boxes = np.array([resident.box for resident in some]).reshape(-1, 4)
    sizes = np.array([resident.nbytes for resident in some], dtype=np.float64)
    scores: NDArray[np.float64] = (until_needed(boxes, places, now_s) + SOON_S) * np.sqrt(sizes)
    return np.minimum(scores, MAX_SCORE) + spare


class Candidate(NamedTuple):
    """A segment that may be evicted; the greatest candidate goes first.  Numbers are unique.

    Segments in their grace come last, the first whose grace ends in front; before them, those that a session
    reports to hold, since most likely a process has them mapped.
    """

    is_past_grace: bool
    is_unclaimed: bool
    score: float
    unused: float
    number: int
    resident: Resident


_numbers = count()


@dataclass(eq=False, slots=True)
class EvictionPlan:
    """The candidates of one look at all residents.

    Attributes
    ----------
    places, now_s
        Positions of clients by which segments are scored, and when.
    places_version
        Of the positions, see `shmmap.daemon.transport.sessions.Sessions`.
    listed
        The candidates, the one that goes first at the end.
    is_whole
        Whether all candidates were listed, but for some whose grace ends later.
    work
        Work of making it so far.
    """

    places: Places = field(default_factory=lambda: NOWHERE)
    places_version: int = -1
    now_s: float = -math.inf
    listed: list[Candidate] = field(default_factory=list)
    is_whole: bool = True
    work: int = 0

    def make(self, residents: Iterator[Resident], may_go: Callable[[Resident], bool]) -> Iterator[None]:
        """Look at all residents, some in each step, and list those that may go."""
        block = min(BLOCK, 2 * PAIRS_PER_BLOCK // max(1, len(self.places)))
        squares = Squares(self.places, self.now_s)
        heap: list[Candidate] = []
        few: list[Resident] = []  # to be scored together
        begun = self.work
        while some := list(islice(residents, block)):
            before, known = squares.looked_at, len(few)
            few += self._above(heap[0], some, squares) if len(heap) == MAX_LISTED else some
            self.is_whole &= len(few) - known == len(some)
            self.work += LOOK_WORK * len(some) + len(self.places) * (squares.looked_at - before)
            if len(few) >= block:
                self._list(few[:block], heap, may_go)
                few = few[block:]
            if self.work >= begun + WORK_PER_STEP:
                yield
                begun = self.work
        self._list(few, heap, may_go)
        self.listed = sorted(heap)
        self.is_whole |= bool(heap) and not self.listed[-1].is_past_grace  # others are in their grace, too

    def _list(
        self, some: Sequence[Resident], heap: list[Candidate], may_go: Callable[[Resident], bool]
    ) -> None:
        """Score segments, and put those into the ``heap`` that may go before others in it."""
        for one in self._candidates(some):
            if len(heap) == MAX_LISTED and one < heap[0]:
                self.is_whole = False
            elif may_go(one.resident):
                heapq.heappush(heap, one)
                if len(heap) > MAX_LISTED:
                    heapq.heappop(heap)
                    self.is_whole = False
        self.work += (LIST_WORK + len(self.places)) * len(some)

    def _above(self, least: Candidate, some: Sequence[Resident], squares: Squares) -> Sequence[Resident]:
        """Leave out segments that go later than ``least``, by what is known of their squares."""
        if not (len(self.places) and least.is_past_grace):
            return some
        score, is_held = least.score, not least.is_unclaimed
        latest_s = squares.latest_s([one.box for one in some])
        return [
            one
            for one, its_s in zip(some, latest_s, strict=True)
            if (its_s + SOON_S) * math.sqrt(one.nbytes) >= score
            or one.spare
            or (is_held and not one.sessions)
        ]

    def add(self, some: Sequence[Resident]) -> None:
        """List some more."""
        self.listed += self._candidates(some)
        self.listed.sort()

    def settle(self, may_go: Callable[[Resident], bool]) -> bool:
        """Bring the candidate that goes first to the end of the list; return False if that takes longer.

        Those that may not go any more are dropped; what was used since it was listed goes last.
        """
        for _ in range(BLOCK):
            if not self.listed:
                return True
            one = self.listed[-1]
            unused = -one.resident.last_use_s
            is_listed = may_go(one.resident)
            if is_listed and unused == one.unused:
                return True
            del self.listed[-1]
            if is_listed:
                insort(self.listed, one._replace(is_past_grace=False, score=0.0, unused=unused))
        return False

    def score(self, resident: Resident) -> float:
        """Return the score that a segment would have had."""
        return float(eviction_scores([resident], self.places, self.now_s)[0])

    def _candidates(self, some: Sequence[Resident]) -> Iterator[Candidate]:
        scores: list[float] = eviction_scores(some, self.places, self.now_s).tolist()
        for resident, score in zip(some, scores, strict=True):
            unused = -resident.last_use_s
            is_past_grace = self.now_s - resident.last_use_s >= HAND_OUT_GRACE_S
            rank = (is_past_grace, not resident.sessions, is_past_grace and score, unused)
            yield Candidate(*rank, next(_numbers), resident)
