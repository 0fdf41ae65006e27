# SPDX-License-Identifier: Apache-2.0
"""Budget of the link to a remote origin: how much may be under way, and for what.

What has been asked of an origin cannot be taken back: on a narrow link a cell that a client waits for comes
after all of it.  So only as much is asked for as the link carries in half a second, or in twice the time
until an answer begins, and always one object.  The rate is the greatest of the last ten seconds in which
something came: an average would fall in an outage, and the budget with it.  Clients' demands take all of
that, wishes half, and pages of the list of cells that nothing needs yet only a link that is idle.

All is policy, without any I/O: the clock is given.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from shmmap.daemon.map.arrivals import Arrivals

Cause: TypeAlias = Literal["demand", "ahead"]

UNDER_WAY_S: Final = 0.5
"""The link's time that may be under way, seconds."""
LONGEST_DELAY_S: Final = 1.0
"""Longest time until an answer begins that is believed: what is under way delays answers, too."""
DELAYS: Final = 16
"""Answers from which that time is estimated."""
FIRST_BYTES: Final = 256 << 10
"""Bytes under way before anything has come."""
DOUBLED_S: Final = 0.1
"""Interval at which this is doubled while no answer begins: the link is idle meanwhile."""
DOUBLED: Final = 5
"""How often it is doubled."""
SLOT_S: Final = 0.25
"""Time over which a rate is measured, seconds; and what an answer's pieces may be late by is a part of it."""
SUSPENDED_S: Final = 1.0
"""Most time between two looks that is measured, seconds: this process may have stood still."""
REMEMBERED_S: Final = 10.0
"""Time with answers of which the greatest rate counts, seconds."""
STALLED_S: Final = 0.75
"""Silence after which another object may begin, whatever is under way, seconds."""
TRICKLE_BYTES: Final = 32 << 10
"""Bytes in that time below which the link is not what is slow, but some answers are."""
OVERTAKEN: Final = 3
"""An object counts no more when this many times the budget has come since it was asked for."""


@dataclass(eq=False, slots=True)
class _Object:
    """Bytes that were asked for; they count until ``until_bytes`` have arrived in all.

    ``begun_s`` is when it was begun after a silence; -inf if it was not.
    """

    nbytes: int
    cause: Cause
    until_bytes: float
    begun_s: float
    counts: bool = True


class Link:
    """What is under way over one link, and what may begin.

    Parameters
    ----------
    arrivals
        Bytes that the daemon's own threads receive.
    cap_bytes_s
        Limit of the rate that the user has set, bytes a second; 0: none.
    metered
        Whether only demands may use the link.

    Attributes
    ----------
    received : dict
        Bytes received so far, by cause: ``demand``, ``ahead``, ``index``.
    rate_bytes_s : float
        What the link carries, bytes a second; 0 before that is known.
    """

    def __init__(self, arrivals: Arrivals, *, cap_bytes_s: float = 0.0, metered: bool = False) -> None:
        self._arrivals, self._cap_bytes_s, self.metered = arrivals, cap_bytes_s, metered
        self.received = {"demand": 0, "ahead": 0, "index": 0}
        self.rate_bytes_s = 0.0
        self._objects: dict[Hashable, _Object] = {}
        self._in_order: deque[_Object] = deque()
        self._counted_bytes = self._arrived_bytes = 0
        self._slots: deque[tuple[float, float]] = deque()
        self._slots_s = self._slot_s = 0.0
        self._slot_bytes = 0
        self._delays_s: deque[float] = deque(maxlen=DELAYS)
        self._now_s = self._begun_s = self._moved_s = self._arrived_s = self._free_s = -math.inf
        self._trickled_bytes = self._doubled = 0

    # --- what happens -----------------------------------------------------------------------------

    def begin(self, key: Hashable, nbytes: int, now_s: float, cause: Cause) -> None:
        """Note that an object has been asked for; `end` has to follow."""
        self.update(now_s)
        self.end(key)
        if self._begun_s == -math.inf:
            self._begun_s = now_s
        begun_s = -math.inf
        if now_s >= self._moved_s + STALLED_S and now_s >= self._arrived_s + STALLED_S:
            self._moved_s = begun_s = now_s
        until_bytes = self._arrived_bytes + OVERTAKEN * (self.limit_bytes(now_s) + nbytes)
        one = self._objects[key] = _Object(nbytes, cause, until_bytes, begun_s)
        self._in_order.append(one)
        self._counted_bytes += nbytes
        if self._cap_bytes_s:
            self._free_s = max(self._free_s, now_s) + nbytes / self._cap_bytes_s

    def end(self, key: Hashable, received: int = 0) -> None:
        """Note that an object is here, or does not come; ``received`` bytes of it came over the link.

        Without `begin`, or a second time, this does nothing.
        """
        one = self._objects.pop(key, None)
        if one is None:
            return
        self._count_no_more(one)
        self.received[one.cause] += received
        if not received and self._moved_s == one.begun_s:  # it needed no link: the next one may begin
            self._moved_s = -math.inf
        if self._cap_bytes_s:
            self._free_s -= max(one.nbytes - received, 0) / self._cap_bytes_s

    def arrived(self, nbytes: int, now_s: float, delays_s: tuple[float, ...] = ()) -> None:
        """Note bytes that have come, and after which times answers began."""
        self._delays_s.extend(delays_s)
        self._note(nbytes, now_s)
        self.update(now_s)

    def update(self, now_s: float) -> None:
        """Note what the daemon's own threads have received, and that time has passed."""
        index, ahead = self._arrivals.take()
        self.received["index"] += index
        self._note(index + ahead, now_s)
        if self._objects or index or ahead or self._arrivals.pages_bytes:
            passed_s = now_s - self._now_s if self._now_s > -math.inf else 0.0
            self._slot_s += min(max(0.0, passed_s), SUSPENDED_S)
        self._now_s = now_s
        if self._slot_s >= SLOT_S:
            if self._slot_bytes:  # else it was an outage, or a wait for the first answer
                self._slots.append((self._slot_s, self._slot_bytes / self._slot_s))
                self._slots_s += self._slot_s
            self._slot_s, self._slot_bytes = 0.0, 0
            while self._slots and self._slots_s - self._slots[0][0] >= REMEMBERED_S:
                self._slots_s -= self._slots.popleft()[0]
            self.rate_bytes_s = max((rate for _, rate in self._slots), default=0.0)

    def _note(self, nbytes: int, now_s: float) -> None:
        if nbytes:
            self._arrived_s = now_s
            self._trickled_bytes += nbytes
            if self._trickled_bytes >= TRICKLE_BYTES:
                self._moved_s, self._trickled_bytes = now_s, 0
            self._slot_bytes += nbytes
            self._arrived_bytes += nbytes
            while self._in_order and self._in_order[0].until_bytes <= self._arrived_bytes:
                self._count_no_more(self._in_order.popleft())

    def _count_no_more(self, one: _Object) -> None:
        self._counted_bytes -= one.nbytes * one.counts
        one.counts = False
        while self._in_order and not self._in_order[0].counts:
            self._in_order.popleft()

    # --- what may begin ---------------------------------------------------------------------------

    @property
    def under_way_bytes(self) -> int:
        """Bytes that have been asked for, and count."""
        return self._counted_bytes + self._arrivals.pages_bytes

    def limit_bytes(self, now_s: float) -> float:
        """Bytes that may be under way."""
        rate = self.rate_bytes_s
        if rate:
            delay_s = sum(self._delays_s) / len(self._delays_s) if self._delays_s else 0.0
            limit = rate * max(UNDER_WAY_S, 2.0 * min(delay_s, LONGEST_DELAY_S))
        else:
            if not self._arrived_bytes and self._begun_s > -math.inf:
                self._doubled = min(int((now_s - self._begun_s) / DOUBLED_S), DOUBLED)
            limit = float((FIRST_BYTES << self._doubled) + 2 * self._arrived_bytes)
        return min(limit, self._cap_bytes_s * UNDER_WAY_S) if self._cap_bytes_s else limit

    def may_begin(self, now_s: float, *, ahead: bool) -> bool:
        """Whether another object may be asked for; ``ahead``: no client waits for it."""
        if (ahead and self.metered) or now_s < self._free_s:
            return False
        under_way = self.under_way_bytes
        if not under_way:
            return True
        if ahead:
            return under_way < 0.5 * self.limit_bytes(now_s)
        return under_way < self.limit_bytes(now_s) or now_s >= self._moved_s + STALLED_S

    def is_idle(self, now_s: float) -> bool:
        """Whether what nothing needs yet may be fetched."""
        return not (self.metered or self._objects) and now_s >= self._free_s

    @property
    def rests_until_s(self) -> float:
        """Until when nothing may begin, as the user's limit is used up; infinity if it is not."""
        return self._free_s if self._free_s > self._now_s and not self.metered else math.inf

    def next_s(self) -> float:
        """When a demand that may not begin now may begin, if nothing comes until then."""
        if self._free_s > self._now_s:
            return self._free_s
        known = self._slots or self._arrived_bytes or self._doubled == DOUBLED
        return self._moved_s + STALLED_S if known else self._now_s + DOUBLED_S
