# SPDX-License-Identifier: Apache-2.0
"""Which segments are evicted next: a list of those that clients will need last, without any I/O.

All residents are looked at, some in each step, and at most `MAX_LISTED` are listed.  The list is not kept up
to date: whether a segment may still be evicted is asked again when its turn comes
(`shmmap.daemon.cache.evictor`), and another list is made while clients move and memory is short.
"""

from __future__ import annotations

import heapq
import math
from bisect import insort
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import NOWHERE, PAIRS_PER_BLOCK, Places, until_needed
from shmmap.large_tables import ShardedDict

MAX_LISTED: Final = 4096
BLOCK: Final = 128
"""Segments looked at in a step: 0.2 to 0.4 ms; fewer where there are many places."""
DUE_PER_CALL: Final = 16
HAND_OUT_GRACE_S: Final = 1.0
"""A segment that was just handed out is not evicted for this long, so that its reader can open it."""
IN_USE_S: Final = 0.2
"""How long, at least, a segment found in use is left alone.  The time doubles with each look if the kernel
reports when a process closes the segment."""
MAX_IN_USE_S: Final = 5.0
"""... and how long at most: a precaution."""
SHARE_S: Final = 0.0005
"""Minimum time between two looks when very many segments are mapped (a look takes 15 us)."""
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
        Whether all candidates were listed.
    """

    places: Places = field(default_factory=lambda: NOWHERE)
    places_version: int = -1
    now_s: float = -math.inf
    listed: list[Candidate] = field(default_factory=list)
    is_whole: bool = True

    def make(self, residents: Iterator[Resident], may_go: Callable[[Resident], bool]) -> Iterator[None]:
        """Look at all residents, some in each step, and list those that may go."""
        block = min(BLOCK, 2 * PAIRS_PER_BLOCK // max(1, len(self.places)))
        heap: list[Candidate] = []
        while some := list(islice(residents, block)):
            for one in self._candidates(some):
                if len(heap) == MAX_LISTED and one < heap[0]:
                    self.is_whole = False
                elif may_go(one.resident):
                    heapq.heappush(heap, one)
                    if len(heap) > MAX_LISTED:
                        heapq.heappop(heap)
                        self.is_whole = False
            if len(some) == block:
                yield
        self.listed = sorted(heap)

    def add(self, some: Sequence[Resident]) -> None:
        """List some more."""
        self.listed += self._candidates(some)
        self.listed.sort()

    def first(self) -> Candidate | None:
        """Return the candidate that goes first; what was used since it was listed goes last."""
        while self.listed:
            one = self.listed[-1]
            unused = -one.resident.last_use_s
            if unused == one.unused:
                return one
            del self.listed[-1]
            insort(self.listed, one._replace(is_past_grace=False, score=0.0, unused=unused))
        return None

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


class Evictable:
    """What has changed about which residents can be evicted.

    Attributes
    ----------
    new : ShardedDict
        Segments that entered service or were released since the last plan was begun.
    changes : int
        How often that happened.
    """

    def __init__(self) -> None:
        self.changes = 0
        self.new: ShardedDict[Resident, object] = ShardedDict()
        self._in_use: ShardedDict[Resident, Any] = ShardedDict()  # until when it is left alone, and how long
        self._heap: list[tuple[float, int, Resident]] = []

    def add(self, resident: Resident) -> None:
        """Note that a segment entered service, or that a request or pin needs it no more."""
        self.new[resident] = None
        self.changes += 1

    def leave(self, resident: Resident) -> None:
        """Forget a segment that left service."""
        self.new.pop(resident, None)
        self._in_use.pop(resident, None)

    def release(self, resident: Resident) -> bool:
        """Note that a user has released a segment; return whether it had been found in use."""
        was_in_use = self._in_use.pop(resident, None) is not None
        self.add(resident)
        return was_in_use

    def release_all(self) -> None:
        """Note that any segment that was found in use may have been released."""
        few, many = self.new, self._in_use
        if len(few) > len(many):
            few, many = many, few
        many.update(few)  # the smaller table is merged into the larger one
        self.new, self._in_use, self._heap = many, ShardedDict(), []
        self.changes += 1

    def found_in_use(self, resident: Resident, now_s: float, *, is_watched: bool) -> None:
        """Leave a segment alone for a while; ``is_watched``: the kernel reports its next close."""
        last_s = self._in_use.get(resident, (0.0, 0.0))[1]
        for_s = min(max(IN_USE_S, 2.0 * last_s * is_watched), MAX_IN_USE_S)
        until_s = now_s + max(for_s, SHARE_S * len(self._in_use))
        self._in_use[resident] = until_s, for_s
        heapq.heappush(self._heap, (until_s, next(_numbers), resident))

    def is_left_alone(self, resident: Resident, now_s: float) -> bool:
        """Whether a segment was found in use a moment ago."""
        known = self._in_use.get(resident)
        return known is not None and now_s < known[0]

    def next_look_s(self) -> float:
        """Return when the first of the segments found in use is looked at again, at the earliest."""
        return self._heap[0][0] if self._heap else math.inf

    def look_again(self, now_s: float) -> None:
        """Consider some of the segments again that have been left alone for long enough."""
        for _ in range(DUE_PER_CALL):
            if self.next_look_s() > now_s:
                break
            until_s, _, resident = heapq.heappop(self._heap)
            if self._in_use.get(resident, (0.0, 0.0))[0] == until_s:
                self.new[resident] = None
