# SPDX-License-Identifier: Apache-2.0
"""Absent cells: what is wanted, which load comes next, what is under way, what failed.

Processes that ask take turns, and of each one's loads the nearest comes first: however many cells one process
asks for, another one's cells do not wait for more than a fair share of them.  Turns are by the time that
loaders spend, as `shmmap.daemon.transport.inbox` has them by that of the loop; until a load has ended it
counts by its bytes.  What no client waits for (checks of adopted segments, pinned cells) comes when nothing
else is queued.
"""

from __future__ import annotations

import heapq
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.records import SPACE_CODES, Failure, Key, Load, Resident
from shmmap.layers.points import LAYER
from shmmap.segment.version import Stamp

__all__ = ["BACKGROUND", "LoadQueue", "Loads"]

BACKGROUND: Final = 1e12
"""From this priority on no client waits for a load."""
PREFETCH: Final = 2.0 * BACKGROUND
"""From this priority on no client has asked for a load yet; and the asker of those."""
FIRST_RETRY_S: Final = 1.0
LAST_RETRY_S: Final = 30.0
BUDGET_RETRY_S: Final = 0.1
MAX_FAILURES: Final = 1 << 14
"""Failures of a kind that are remembered: requests for always new layers must not fill the memory."""
LOAD_S: Final = 1e-4
"""Time charged to a load besides that for its bytes: many tiny cells are work, too."""
BYTE_S: Final = 1e-9
LOOKED_BEHIND: Final = 8
"""Loads of each kind of an asker that are looked at to know what room is needed soon."""
MAX_REMEMBERED: Final = 1024
"""Askers whose clocks are remembered; those forgotten when idle lose a debt of loads that have ended."""

_Heap = list[tuple[float, int, Load]]


@dataclass(eq=False, slots=True)
class _Asker:
    """One asker's loads by priority, computed layers in the second heap.

    ``clock_s`` is the time of loaders that it was given, ``running`` how many of its loads are under way.
    """

    clock_s: float
    heaps: tuple[_Heap, _Heap] = field(default_factory=lambda: ([], []))
    best: dict[int, float] = field(default_factory=dict)
    running: int = 0


class LoadQueue:
    """Loads that wait for a worker or for room; one is here from `push` to `discard`.

    ``changes`` counts loads that came, went or were moved forward: another one may be next.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._loads: dict[int, Load] = {}
        self._askers: dict[Hashable, _Asker] = {}
        self._clock_s = 0.0
        self._chosen: Hashable = None

    def __len__(self) -> int:
        return len(self._loads)

    def count(self, asker: Hashable) -> int:
        """Return how many loads of an asker wait."""
        mine = self._askers.get(asker)
        return 0 if mine is None else sum(number in self._loads for number in mine.best)

    def push(self, load: Load, priority: float, asker: Hashable) -> None:
        """Queue a load for an asker; asked for again, it is never moved back."""
        self.changes += load.number not in self._loads
        self._loads[load.number] = load
        mine = self._askers.get(asker)
        if mine is None:
            mine = self._askers[asker] = _Asker(self._clock_s)
        known = mine.best.get(load.number)
        if known is None or priority < known:
            self.changes += 1
            mine.best[load.number] = priority
            heapq.heappush(mine.heaps[load.computed], (priority, load.number, load))

    def discard(self, load: Load) -> None:
        """Remove a load from the queue."""
        self.changes += 1
        self._loads.pop(load.number, None)

    def started(self, load: Load) -> None:
        """Remove a load that begins, and charge it to the asker whose turn it was; `ended` has to follow."""
        self.discard(load)
        load.payer, load.charged_s = self._chosen, LOAD_S + load.estimate * BYTE_S
        chosen = self._askers.get(self._chosen)
        if chosen is not None:
            chosen.running += 1
            chosen.clock_s += load.charged_s

    def ended(self, load: Load) -> None:
        """Charge a load that has ended, or goes back, for what it took."""
        payer = self._askers.get(load.payer)
        if payer is not None:
            payer.running -= 1
            payer.clock_s += load.spent_s - load.charged_s
        load.spent_s = 0.0

    def next(self, *, points: bool = True, layers: bool = True) -> Load | None:
        """Return the load that comes next, of those that are computed, that are not, or of all; or None."""
        best: tuple[bool, float, float, int] | None = None
        found: Load | None = None
        for asker, mine in list(self._askers.items()):
            self._clean(mine)
            if not any(mine.heaps) and self._is_square(mine):
                del self._askers[asker]
            for heap, wanted in zip(mine.heaps, (points, layers), strict=True):
                if heap and wanted:
                    priority, number, load = heap[0]
                    rank = (priority >= BACKGROUND, mine.clock_s, priority, number)
                    if best is None or rank < best:
                        best, found, self._chosen = rank, load, asker
        if found is not None:
            self._clock_s = max(self._clock_s, self._askers[self._chosen].clock_s)
        return found

    def bytes_behind(self) -> int:
        """Return the sum of the estimates of some loads that come after what `next` has just found."""
        chosen = self._askers.get(self._chosen)
        if chosen is None:
            return 0
        return sum(
            load.estimate
            for heap in chosen.heaps
            for _priority, number, load in heap[1:LOOKED_BEHIND]
            if number in self._loads
        )

    def _is_square(self, mine: _Asker) -> bool:
        """Whether an asker that waits for nothing can be forgotten: none else waits, or it owes no time."""
        if mine.running:
            return False
        return mine.clock_s <= self._clock_s or not self._loads or len(self._askers) > MAX_REMEMBERED

    def _clean(self, mine: _Asker) -> None:
        """Drop what no longer waits from the front, and from everywhere once it is the greater part."""
        for heap in mine.heaps:
            while heap and heap[0][1] not in self._loads:
                mine.best.pop(heapq.heappop(heap)[1], None)
        if sum(map(len, mine.heaps)) > 2 * len(self._loads) + 64:
            mine.best = {number: p for number, p in mine.best.items() if number in self._loads}
            for heap in mine.heaps:
                heap.clear()
            for number, priority in mine.best.items():
                load = self._loads[number]
                heapq.heappush(mine.heaps[load.computed], (priority, number, load))


class Loads:
    """What is wanted, queued and under way, and what failed; without any I/O.

    Parameters
    ----------
    ledger
        Promises the bytes of what is under way.

    ``by_key`` has the loads that have not ended; ``failures`` why the last load of a key failed, until it
    succeeds or the cause may have passed.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger
        self.by_key: dict[Key, Load] = {}
        self.failures: dict[Key, Failure] = {}
        self._keys_failed: dict[str, OrderedDict[Key, None]] = {}  # by code, oldest first
        self._queue = LoadQueue()
        self._numbers = 0

    def __len__(self) -> int:
        """How many loads wait for a worker or for room."""
        return len(self._queue)

    @property
    def changes(self) -> int:
        """How often it may have changed which load comes next."""
        return self._queue.changes

    def queued_of(self, asker: Hashable) -> int:
        """Return how many of an asker's loads wait."""
        return self._queue.count(asker)

    def want(
        self,
        key: Key,
        estimate: int,
        priority: float,
        asker: Hashable = None,
        *,
        computed: bool | None = None,
    ) -> Load:
        """Queue a load, or move a queued one forward; however many ask, there is one load.

        Askers take turns, in `LoadQueue`.  ``computed`` says that it may take long; by default what is
        not ``points`` does.
        """
        load = self.by_key.get(key)
        if load is None:
            self._numbers += 1
            computed = key.layer != LAYER if computed is None else computed
            load = self.by_key[key] = Load(
                key, estimate, priority, self._numbers, asker=asker, computed=computed
            )
        load.prefetch = False
        if load.running:
            load.wanted = True
            return load
        load.wanted, load.priority = True, min(load.priority, priority)
        self._queue.push(load, priority, asker)
        return load

    def prefetch(self, key: Key, estimate: int, needed_in_s: float, *, computed: bool | None = None) -> Load:
        """Queue a load that no client has asked for yet, behind everything that clients ask for."""
        load = self.want(key, estimate, PREFETCH + needed_in_s, PREFETCH, computed=computed)
        load.wanted, load.prefetch = False, True
        return load

    def is_promised(self, key: Key) -> bool:
        """Whether a load of this is on its way, more than a look at the file that it failed for."""
        load = self.by_key.get(key)
        return load is not None and load.unless is None

    def check(self, resident: Resident) -> None:
        """Queue the check of a segment of a previous run, behind everything that clients ask for."""
        load = self.want(resident.key, 0, float("inf"))
        load.adopted, load.wanted = resident, False

    def next_queued(self, *, points: bool = True, layers: bool = True) -> Load | None:
        """Return the nearest load of the asker whose turn it is, of the kinds that a worker can take."""
        while (load := self._queue.next(points=points, layers=layers)) is not None:
            if self.by_key.get(load.key) is load and not load.running:
                return load
            self._queue.discard(load)  # given up meanwhile
        return None

    def bytes_behind(self) -> int:
        """Bytes of some loads that come after what `next_queued` has just returned."""
        return self._queue.bytes_behind()

    def start(self, load: Load, now_s: float) -> bool:
        """Reserve the load's bytes and count it as running; False if they do not fit."""
        if not self._ledger.reserve(load.estimate):
            return False
        self._queue.started(load)
        load.running, load.started_s, load.reserved = True, now_s, load.estimate
        return True

    def grow(self, load: Load, nbytes: int) -> bool:
        """Raise a running load's reservation to ``nbytes``; False if that does not fit."""
        extra = max(0, nbytes - load.reserved)
        fits = self._ledger.reserve(extra)
        load.reserved += extra if fits else 0
        return fits

    def defer(self, load: Load) -> None:
        """Take a load that cannot be begun yet out of the queue, until `requeue`."""
        self._queue.discard(load)

    def requeue(self, load: Load) -> None:
        """Put a running load back (its worker died before its turn, or what it read is outdated)."""
        self._take_back(load)
        self._queue.push(load, load.priority, load.asker)

    def _take_back(self, load: Load) -> None:
        self._ledger.reserved_bytes -= load.reserved
        load.reserved = 0
        if load.running:
            load.running = False
            self._queue.ended(load)

    def finish(self, load: Load, failure: Failure | None = None) -> None:
        """End a load; ``failure``, if there is one, stands until a load succeeds or it is cleared."""
        self._take_back(load)
        self._queue.discard(load)
        if self.by_key.get(load.key) is load:
            del self.by_key[load.key]
            self.failures.pop(load.key, None)
            if failure is not None:
                self._remember(load.key, failure)

    def failure(self, key: Key, code: str, message: str, stamp: Stamp | None, now_s: float) -> Failure:
        """Describe why a load failed; the back-off doubles when it failed for the same reason before."""
        old = self.failures.get(key)
        if code in SPACE_CODES:
            delay_s = BUDGET_RETRY_S
        else:
            delay_s = min(2 * old.delay_s, LAST_RETRY_S) if old and old.code == code else FIRST_RETRY_S
        return Failure(code, message, stamp, now_s + delay_s, delay_s)

    def _remember(self, key: Key, failure: Failure) -> None:
        self.failures[key] = failure
        keys = self._keys_failed.setdefault(failure.code, OrderedDict())
        keys.pop(key, None)
        keys[key] = None
        if len(keys) > MAX_FAILURES:
            oldest, _ = keys.popitem(last=False)
            self._forget_failure(oldest, failure.code)

    def cancel(self, key: Key) -> None:
        """Drop a queued load and a standing failure of a key (its cell left the map)."""
        self.failures.pop(key, None)
        load = self.by_key.get(key)
        if load is not None and not load.running:
            self._queue.discard(load)
            del self.by_key[key]

    def forget_refusals(self) -> None:
        """Forget standing failures for lack of memory: there may be room now."""
        for code in SPACE_CODES:
            for key in self._keys_failed.pop(code, ()):
                self._forget_failure(key, code)

    def forget_failures(self) -> None:
        """Forget all other standing failures: what all of them came from has passed."""
        for code in [code for code in self._keys_failed if code not in SPACE_CODES]:
            for key in self._keys_failed.pop(code):
                self._forget_failure(key, code)

    def _forget_failure(self, key: Key, code: str) -> None:
        failure = self.failures.get(key)
        if failure is not None and failure.code == code:
            del self.failures[key]
