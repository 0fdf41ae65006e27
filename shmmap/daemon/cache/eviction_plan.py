# SPDX-License-Identifier: Apache-2.0
"""Which segments are evicted next: a list of those that clients will need last, without any I/O.

Of each square of the map it is known when all in it will be needed at the latest.  The squares whose segments
are needed last are looked at first, some in each step, until `MAX_LISTED` segments are listed and no other
square can matter.  The list is not kept up to date: whether a segment may still be evicted is asked again
when its turn comes (`shmmap.daemon.cache.evictor`), and another list is made while clients move and memory is
short.
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

from shmmap.daemon.cache.ledger import Square
from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import NOWHERE, PAIRS_PER_BLOCK, Places, until_needed, widened

MAX_LISTED: Final = 1024
BLOCK: Final = 32
"""Segments looked at together; fewer where there are many places."""
WORK_PER_STEP: Final = 8000
"""Work after which a step ends: a sixth of a millisecond."""
SQUARE_WORK: Final = 128
"""Work of estimating when a square is needed, as of looking at it, ..."""
LOOK_WORK: Final = 32
"""... of looking at a segment, ..."""
LIST_WORK: Final = 256
"""... and of listing it."""
DROPPED_PER_STEP: Final = 4096
"""Squares that need not be looked at, dropped together."""
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
    return spare + _weighted(until_needed(boxes, places, now_s), [resident.nbytes for resident in some])


def highest_scores(some: Sequence[Square], around: Places, now_s: float) -> NDArray[np.float64]:
    """Return scores that no segment in these squares exceeds, (N,); ``around``: `widened` places."""
    spare = SPARE_SCORE * np.array([square.may_be_spare for square in some], dtype=np.float64)
    if not len(around):
        return spare - np.array([square.oldest_s for square in some], dtype=np.float64)
    middles = np.array([square.middle for square in some]).reshape(-1, 2)
    latest_s = until_needed(np.hstack([middles, middles]), around, now_s)
    return spare + _weighted(latest_s, [square.largest for square in some])


def _weighted(until_s: NDArray[np.float64], sizes: Sequence[int]) -> NDArray[np.float64]:
    scores: NDArray[np.float64] = (until_s + SOON_S) * np.sqrt(np.array(sizes, dtype=np.float64))
    return np.minimum(scores, MAX_SCORE)


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

    def make(self, squares: Iterator[Square], may_go: Callable[[Resident], bool]) -> Iterator[None]:
        """Look at all squares, some in each step, and list those of their segments that may go."""
        begun, around = self.work, widened(self.places, self.now_s)
        block = min(BLOCK, PAIRS_PER_BLOCK // max(1, len(self.places)))
        queue: list[tuple[float, int, Square]] = []  # a heap, the highest score first
        while some := list(islice(squares, 2 * block)):
            highest: list[float] = highest_scores(some, around, self.now_s).tolist()
            for score, square in zip(highest, some, strict=True):
                heapq.heappush(queue, (-score, next(_numbers), square))
            self.work += (SQUARE_WORK + len(self.places)) * len(some)
            if self.work >= begun + WORK_PER_STEP:
                yield
                begun = self.work
        heap: list[Candidate] = []
        few: list[Resident] = []  # to be scored together
        while queue and not (self._is_enough(heap, -queue[0][0]) and heap[0].is_unclaimed):
            score, _, square = heapq.heappop(queue)
            for part in self._segments_of(square, block):
                if self._is_enough(heap, -score):
                    self.is_whole = False
                    part = [one for one in part if not one.sessions]
                few += part
                if len(few) >= block:
                    self._list(few, heap, may_go)
                    few = []
                if self.work >= begun + WORK_PER_STEP:
                    yield
                    begun = self.work
        self._list(few, heap, may_go)
        self.is_whole &= not queue
        while queue:
            del queue[-DROPPED_PER_STEP:]
            yield
        self.listed = sorted(heap)
        self.is_whole |= bool(heap) and not self.listed[-1].is_past_grace  # others are in their grace, too

    def _is_enough(self, heap: Sequence[Candidate], score: float) -> bool:
        """Whether the list is full, of segments past their grace with higher scores."""
        return len(heap) == MAX_LISTED and heap[0].is_past_grace and heap[0].score > score

    def _segments_of(self, square: Square, block: int) -> Iterator[list[Resident]]:
        """Yield the segments of a square in parts, and learn again what is known of them."""
        segments = iter(list(square.segments))
        square.forget()
        self.work += SQUARE_WORK
        while part := list(islice(segments, block)):
            square.learn(part)
            self.work += LOOK_WORK * len(part)
            yield part

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
