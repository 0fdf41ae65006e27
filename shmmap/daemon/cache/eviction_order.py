# SPDX-License-Identifier: Apache-2.0
"""The order in which segments are evicted, maintained as they are added, removed and used; without any I/O.

Asking for the next segments costs O(log n).  Scores are cached.  Those at the front are checked at each
query, so that no outdated score causes an eviction; all others are updated a few at a time
(`EvictionOrder.refresh`) while clients move.  A segment that has become less valuable since is found in the
next round.  As long as no client moves, the order is exactly that of a sort.

A segment that cannot be evicted now is deferred: until a given time, or until `EvictionOrder.reconsider`.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, insort
from collections.abc import Callable, Iterable, Sequence
from typing import Final, NamedTuple

from shmmap.daemon.records import Resident
from shmmap.large_tables import ShardedDict

FRONT: Final = 8
"""Segments offered at a time; when fewer are in order, this many are scored."""
TRIES: Final = 4
"""How often outdated scores at the front are recomputed before the front is taken as it is."""
BATCH: Final = 16
"""Segments scored, or put back in order, at a time: 0.1 ms if all of them change their places."""
TOLERANCE: Final = 0.1
"""A score that has changed by a smaller fraction is not updated unless it is at the front."""
_BLOCK: Final = 512


class Score(NamedTuple):
    """How segments are scored now; ``version`` changes whenever scores may."""

    of: Callable[[Sequence[Resident]], Iterable[float]]
    version: int = 0


class _Entry(NamedTuple):
    """A segment with its score; the greatest entry is evicted first. Numbers are unique."""

    unclaimed: bool  # no session reports that it holds it: most likely no process has it mapped
    score: float
    unused: float
    number: int
    resident: Resident
    version: int

    def is_outdated(self, version: int) -> bool:
        resident = self.resident
        return (
            self.version != version
            or self.unused != -resident.last_use_s
            or self.unclaimed is bool(resident.sessions)
        )


class _Sorted:
    """Entries in ascending order, in blocks: an insertion or removal moves at most one block."""

    def __init__(self) -> None:
        self._blocks: list[list[_Entry]] = []
        self._lasts: list[_Entry] = []

    def add(self, entry: _Entry) -> None:
        if not self._blocks:
            self._blocks, self._lasts = [[entry]], [entry]
            return
        at = min(bisect_left(self._lasts, entry), len(self._blocks) - 1)
        block = self._blocks[at]
        insort(block, entry)
        if len(block) > 2 * _BLOCK:
            self._blocks.insert(at, block[:_BLOCK])
            self._lasts.insert(at, block[_BLOCK - 1])
            del block[:_BLOCK]
            at += 1
        self._lasts[at] = block[-1]

    def remove(self, entry: _Entry) -> None:
        at = bisect_left(self._lasts, entry)
        block = self._blocks[at]
        del block[bisect_left(block, entry)]
        if block:
            self._lasts[at] = block[-1]
        else:
            del self._blocks[at], self._lasts[at]

    def greatest(self, count: int) -> list[_Entry]:
        """Return the greatest entries, greatest first."""
        found: list[_Entry] = []
        for block in reversed(self._blocks):
            found += block[: -1 - (count - len(found)) : -1]
            if len(found) == count:
                break
        return found


class Deferred:
    """Segments that cannot be evicted until a given time; infinity: until they are reconsidered."""

    def __init__(self) -> None:
        self._until_s: ShardedDict[Resident, float | None] = ShardedDict()
        self._heap: list[tuple[float, int, Resident]] = []
        self._number = 0

    def __len__(self) -> int:
        return len(self._until_s)

    def __contains__(self, resident: Resident) -> bool:
        return resident in self._until_s

    def put(self, resident: Resident, until_s: float) -> None:
        """Add a segment."""
        self._until_s[resident] = until_s
        if until_s < math.inf:
            self._number += 1
            heapq.heappush(self._heap, (until_s, self._number, resident))

    def take(self, resident: Resident) -> bool:
        """Remove a segment; return whether it was present."""
        return self._until_s.pop(resident, None) is not None

    def first(self) -> tuple[float, Resident] | None:
        """Return when the first deferral ends at the earliest, and its segment, which may have been removed.

        Removed segments are dropped here, a bounded number per call: very many may have been removed.
        """
        for _ in range(BATCH):
            if not self._heap or self._until_s.get(self._heap[0][2]) == self._heap[0][0]:
                break
            heapq.heappop(self._heap)
        return (self._heap[0][0], self._heap[0][2]) if self._heap else None

    def due(self, now_s: float) -> list[Resident]:
        """Remove and return segments whose deferral has ended, a bounded number."""
        found = []
        for _ in range(BATCH):
            if not self._heap or self._heap[0][0] > now_s:
                break
            until_s, _, resident = heapq.heappop(self._heap)
            if self._until_s.get(resident) == until_s:
                del self._until_s[resident]
                found.append(resident)
        return found

    def take_all(self) -> ShardedDict[Resident, float | None]:
        """Remove and return all segments."""
        found, self._until_s, self._heap = self._until_s, ShardedDict(), []
        return found


class EvictionOrder:
    """All residents, each in one state: new (not scored yet), in order, or deferred.

    Attributes
    ----------
    in_grace
        Segments deferred because they were just handed out: readers may be opening them.
    deferred
        Segments deferred because a request or pin needs them, or a process has them mapped.
    new : ShardedDict
        Segments not scored yet; segments that enter service are added here.
    changes : int
        How often a segment was added or reconsidered, so that more may be evictable now.
    scored : int
        Number of scores computed so far.
    """

    def __init__(self) -> None:
        self.in_grace = Deferred()
        self.deferred = Deferred()
        self.scored = self.changes = 0
        self.new: ShardedDict[Resident, float | None] = ShardedDict()
        self._entries: ShardedDict[Resident, _Entry] = ShardedDict()
        self._sorted = _Sorted()
        self._number = 0
        self._tries = 0
        self._tried: dict[Resident, None] = {}

    def __len__(self) -> int:
        return len(self.new) + len(self._entries) + len(self.in_grace) + len(self.deferred)

    def leave(self, resident: Resident) -> None:
        """Remove a segment from the order."""
        entry = self._entries.pop(resident, None)
        if entry is not None:
            self._sorted.remove(entry)
        elif resident in self.new:
            del self.new[resident]
        elif not self.in_grace.take(resident):
            self.deferred.take(resident)

    def reconsider(self, resident: Resident) -> bool:
        """Note that a user has released a segment; return whether the segment was deferred."""
        entry, resident.deferred_s = self._entries.get(resident), 0.0
        if self.deferred.take(resident) or (entry is not None and entry.unclaimed is bool(resident.sessions)):
            self.leave(resident)
            self.new[resident] = None
            self.changes += 1
            return entry is None
        return False

    def reconsider_all(self) -> None:
        """Note that any segment deferred as mapped or needed may have been released."""
        few, many = self.new, self.deferred.take_all()
        if len(few) > len(many):
            few, many = many, few
        many.update(few)  # the smaller table is merged into the larger one
        self.changes += 1
        self.new = many

    def defer(self, resident: Resident, where: Deferred, until_s: float) -> None:
        """Defer a segment; ``where`` is `in_grace` or `deferred`."""
        self.leave(resident)
        where.put(resident, until_s)

    def front(self, score: Score) -> list[Resident] | None:
        """Return the segments to evict first, in order, at most `FRONT`; empty if all are deferred.

        Only scored segments are considered, see `fill`.  Returns None if scores at the front were outdated:
        they have been updated, and the caller should ask again.
        """
        front = self._sorted.greatest(FRONT)
        outdated = [entry.resident for entry in front if entry.is_outdated(score.version)]
        if outdated:
            self._place(outdated, score)
            self._tries += 1
            self._tried.update(dict.fromkeys(outdated))
            if self._tries < TRIES:
                return None
            # whatever else there is, these are evicted before most others
            tried = [entry for one in self._tried if (entry := self._entries.get(one)) is not None]
            front = sorted(tried, reverse=True)
        self._tries = 0
        self._tried.clear()
        return [entry.resident for entry in front]

    def fill(self, score: Score, now_s: float) -> bool:
        """Score some new or no longer deferred segments if few are in order; return whether any were."""
        for resident in (*self.in_grace.due(now_s), *self.deferred.due(now_s)):
            self.new[resident] = None
        if len(self._entries) >= FRONT or not self.new:
            return False  # they wait: scoring many at once costs little more than one
        self.score_new(score, FRONT)
        return True

    def score_new(self, score: Score, most: int = BATCH) -> None:
        """Score new segments, a bounded number."""
        if self.new:
            self._place([self.new.popitem()[0] for _ in range(min(most, len(self.new)))], score)

    def refresh(self, some: Iterable[Resident], score: Score) -> None:
        """Update the scores of some segments."""
        entries = [entry for one in some if (entry := self._entries.get(one)) is not None]
        outdated = [entry for entry in entries if entry.is_outdated(score.version)]
        if not outdated:
            return
        scores = self._scores([entry.resident for entry in outdated], score)
        for entry, now in zip(outdated, scores, strict=True):
            unclaimed = not entry.resident.sessions
            if unclaimed is not entry.unclaimed or abs(now - entry.score) > TOLERANCE * abs(entry.score):
                self._put(entry.resident, now, score.version)

    def _place(self, some: Sequence[Resident], score: Score) -> None:
        for resident, now in zip(some, self._scores(some, score), strict=True):
            self._put(resident, now, score.version)

    def _scores(self, some: Sequence[Resident], score: Score) -> list[float]:
        self.scored += len(some)
        return list(map(float, score.of(some)))

    def _put(self, resident: Resident, score: float, version: int) -> None:
        self.leave(resident)
        self._number += 1
        entry = _Entry(not resident.sessions, score, -resident.last_use_s, self._number, resident, version)
        self._entries[resident] = entry
        self._sorted.add(entry)
