# SPDX-License-Identifier: Apache-2.0
"""Which segment goes next, and when there is room: retires the segments that clients will need last.

A plan (`shmmap.daemon.cache.eviction_plan`) lists them.  When its turn comes, a segment goes if it is still
in service, no request or pin needs it, and no process uses it.  The segments that were just handed out come
last: a load waits for the end of their grace if no process has opened them by then.  When none is left, those
that have come into question since are listed.  One turn of the serving loop handles a bounded number of
segments; the others follow in later turns.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

import numpy as np

from shmmap.daemon.cache.eviction_plan import (
    BLOCK,
    HAND_OUT_GRACE_S,
    MAX_LISTED,
    EvictionPlan,
)
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.records import Resident
from shmmap.daemon.travel.places import NOWHERE, WORK_S, Places, until_needed

PREFETCHED_PER_TURN: Final = 64
"""Prefetched segments compared with a wish at a time: a tenth of a millisecond."""
PRESSURE_S: Final = 10.0
"""How long plans are made after memory was short.  A load helps to replace an outdated plan that is older."""
FREE_SHARE: Final = 8
"""Divisor: the first plan is made when less than 1/8 of the budget is free."""
PLACES_S: Final = 0.25
"""Shortest interval of merging clients' positions, which takes up to half a millisecond."""
PLAN_S: Final = 1.0
"""Shortest interval of plans that no load waits for: in a second, the time until a segment is needed hardly
changes."""
REST: Final = 3
"""... and in multiples of the time that a plan takes."""
LOOKS_PER_CALL: Final = 4
"""Segments looked at by one `Evictor.free`: a look takes 15 us, and retiring one is as much work again."""


class Freeing(enum.Enum):
    """What an attempt to free memory has come to."""

    ENOUGH = "enough memory is about to be free"
    LATER = "another attempt is worth it, at `Evictor.wake_s`"
    NO_MORE = "all other segments are in use, or needed"


@dataclass(eq=False, slots=True)
class Evictor:
    """Retires the segments that a plan lists, and makes plans.

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
    _plan: EvictionPlan = field(default_factory=lambda: EvictionPlan(is_whole=False))
    _next: EvictionPlan = field(default_factory=EvictionPlan)
    _making: Iterator[None] | None = None  # of the next plan
    _stepped_s: float = -math.inf
    _rests_until_s: float = -math.inf
    _placed: tuple[Places, int] = (NOWHERE, -1)
    _placed_s: float = -math.inf
    _pressure_until_s: float = -math.inf

    def free(self, shortage: int, now_s: float, *, rather_than: Resident | None = None) -> Freeing:
        """Retire a segment, or look at a few, unless ``shortage`` bytes are about to be free.

        Parameters
        ----------
        rather_than
            Prefetched cell that the room is for: segments that would be evicted after it stay.
        """
        ledger = self.reclaimer.ledger
        self.wake_s = math.inf
        if shortage <= ledger.coming_bytes:
            return Freeing.ENOUGH
        self._pressure_until_s = now_s + PRESSURE_S
        ledger.evictable.look_again(now_s)
        if self._plan.listed and now_s >= self._plan.now_s + PRESSURE_S and self._is_outdated:
            self.run_step(now_s)
        for _ in range(LOOKS_PER_CALL):
            if not self._plan.settle(lambda one: self._may_go(one, now_s)):
                break
            first = self._plan.listed[-1] if self._plan.listed else None
            if first is None or not first.is_past_grace:
                if self._list_more(now_s):
                    break
                if first is None:
                    return Freeing.NO_MORE
            resident, graced_s = first.resident, first.resident.last_use_s + HAND_OUT_GRACE_S
            if rather_than is not None and not (
                first.is_past_grace and first.score > self._plan.score(rather_than)
            ):
                return Freeing.NO_MORE
            if self._is_in_use(resident, now_s):
                continue
            if graced_s > now_s:  # all others are in use
                self.wake_s = graced_s
                return Freeing.LATER
            self.reclaimer.retire(resident, now_s, "room")
            self.evicted_count += 1
            if shortage <= ledger.coming_bytes:
                return Freeing.ENOUGH
            break
        self.wake_s = now_s
        return Freeing.LATER

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
        places, _version = self._positions(now_s)
        boxes = np.array([one.box for one in (wished, *some)])
        wished_s, *times_s = until_needed(boxes, places, now_s).tolist()
        later = sorted((its_s, number) for number, its_s in enumerate(times_s) if its_s > wished_s)
        work = LOOKS_PER_CALL
        while later and shortage > 0 and work:
            resident = some[later.pop()[1]]
            self.reclaimer.retire(resident, now_s, "room")
            self.evicted_count += 1
            shortage -= resident.nbytes
            work -= 1
        return work < LOOKS_PER_CALL

    def _may_go(self, resident: Resident, now_s: float) -> bool:
        """Whether a segment is in service, not needed, and was not found in use a moment ago."""
        ledger = self.reclaimer.ledger
        return (
            ledger.resident_named(resident.name) is resident
            and not ledger.is_needed(resident.key)
            and not ledger.evictable.is_left_alone(resident, now_s)
        )

    def _is_in_use(self, resident: Resident, now_s: float) -> bool:
        """Whether a process has a segment mapped; if so, leave it alone for a while."""
        if not self.reclaimer.is_pinned(resident):
            return False
        is_watched = self.reclaimer.pins.watch_next_close(resident.name)
        self.reclaimer.ledger.evictable.found_in_use(resident, now_s, is_watched=is_watched)
        return True

    # --- plans ------------------------------------------------------------------------------------

    @property
    def next_s(self) -> float:
        """When `run_step` has something to do: if anything changed, for a while after memory was short.

        The first plan is made before.
        """
        if self._stepped_s >= self._pressure_until_s and not self._will_be_needed:
            return math.inf
        if self._making is not None:
            return self._rests_until_s
        interval_s = max(PLAN_S, REST * WORK_S * self._plan.work)
        return max(self._rests_until_s, self._plan.now_s + interval_s) if self._is_outdated else math.inf

    def run_step(self, now_s: float) -> None:
        """Make a part of the next plan; once it is made, it takes the place of the present one."""
        self._stepped_s = now_s
        if self._making is None:
            evictable = self.reclaimer.ledger.evictable
            evictable.take_new()
            self._next = EvictionPlan(*self._positions(now_s), now_s)
            self._making = self._next.make(evictable.squares(), lambda one: self._may_go(one, now_s))
        before = self._next.work
        if next(self._making, self) is self:
            self._plan, self._making = self._next, None
        self._rests_until_s = now_s + WORK_S * (self._next.work - before)

    def _positions(self, now_s: float) -> tuple[Places, int]:
        """Return positions of clients and their version, at most `PLACES_S` old."""
        sessions = self.reclaimer.sessions
        if sessions.places_version != self._placed[1] and now_s >= self._placed_s + PLACES_S:
            self._placed_s, self._placed = now_s, (sessions.places(), sessions.places_version)
        return self._placed

    @property
    def _will_be_needed(self) -> bool:
        """Whether there is no plan yet, and memory will soon be short."""
        ledger = self.reclaimer.ledger
        return self._plan.now_s == -math.inf and ledger.shortage(ledger.budget_bytes // FREE_SHARE) > 0

    @property
    def _is_outdated(self) -> bool:
        """Whether another plan would list other segments."""
        plan, reclaimer = self._plan, self.reclaimer
        have_clients_moved = reclaimer.sessions.places_version != plan.places_version
        is_short = not plan.is_whole and len(plan.listed) < MAX_LISTED // 2
        evictable = reclaimer.ledger.evictable
        return have_clients_moved or is_short or bool(evictable.new) or evictable.has_more

    def _list_more(self, now_s: float) -> bool:
        """List what has come into question since, or make a part of the next plan; False if none is left."""
        plan, evictable = self._plan, self.reclaimer.ledger.evictable
        too_many = evictable.has_more or len(plan.listed) > MAX_LISTED + BLOCK
        if self._making is None and not too_many and plan.is_whole:
            some = evictable.take_new()
            plan.add([resident for resident in some if self._may_go(resident, now_s)])
            return bool(some)
        self.run_step(now_s)
        return True
