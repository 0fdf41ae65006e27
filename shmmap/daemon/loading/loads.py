# SPDX-License-Identifier: Apache-2.0
"""Absent cells: which are wanted, which load is next, which are running, and which failed.

Processes take turns, and of each process's loads the nearest comes first: however many cells one process asks
for, the cells of another wait only for a fair share of them.  Turns are counted in loader time, as
`shmmap.daemon.transport.inbox` counts them in the loop's time; a load that has not ended counts by its bytes.
Loads that no client waits for (checks of adopted segments, pinned cells) come when nothing else is queued.
"""

from __future__ import annotations

import enum
import heapq
import math
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.loading.link import Cause, Link
from shmmap.daemon.records import SPACE_CODES, Failure, Key, Resident
from shmmap.layers.points import LAYER
from shmmap.segment.version import Stamp

BACKGROUND: Final = 1e12
"""Priority from which on no client waits for a load."""
PREFETCH: Final = 2.0 * BACKGROUND
"""Priority from which on no client has asked for a load yet; also the asker of such loads."""
FIRST_RETRY_S: Final = 1.0
LAST_RETRY_S: Final = 30.0
BUDGET_RETRY_S: Final = 0.1
MAX_FAILURES: Final = 1 << 14
"""Failures remembered per kind: requests for always new layers must not fill the memory."""
LOAD_S: Final = 1e-4
"""Time charged to a load in addition to its bytes: many tiny cells are work, too."""
BYTE_S: Final = 1e-9
COMPUTED: Final = 1
"""Bit of a load's kind: it takes a worker that computes layers, which may take long."""
FETCHED: Final = 2
"""Bit of a load's kind: it reads a source, over the link if there is one."""
LOOKED_BEHIND: Final = 8
"""Loads of each kind of an asker that are examined to estimate the memory needed soon."""
MAX_REMEMBERED: Final = 1024
"""Askers whose clocks are remembered; forgetting an idle asker cancels the debt of its finished loads."""


class Purpose(enum.Enum):
    """Why a segment is loaded."""

    DEMAND = "a client has asked for it"
    SPARE = "only spare requests have asked for it"
    WISH = "no client has asked for it yet"


@dataclass(frozen=True, slots=True)
class LeftoverCheck:
    """Check of a previous run's segment; its cell is loaded if that fails and a client has asked for it."""

    resident: Resident
    is_asked_for: bool = False


@dataclass(frozen=True, slots=True)
class FailedFileCheck:
    """Check of a file that failed in the state ``stamp``: in another state its cell is loaded."""

    stamp: Stamp


Work: TypeAlias = Purpose | LeftoverCheck | FailedFileCheck
"""What a worker has to do for a key: make a segment, or a check that may lead to that."""


@dataclass(slots=True, eq=False)
class Attempt:
    """A worker's work at a load.

    ``sources`` are the states of its file and its neighbours' files in the catalogue when the worker was
    given the job, none for a check, and ``version`` is the version that follows from them.  In the end,
    ``spent_s`` is the loader time that it took, and ``took_s`` the whole time, fetching included.
    """

    started_s: float
    sources: tuple[Stamp, ...] = ()
    version: int = 0
    spent_s: float = 0.0
    took_s: float = 0.0


@dataclass(slots=True, eq=False)
class Load:
    """Work that is queued or that a worker does.

    ``kind`` is what it takes besides memory, as far as that is known when it is queued: `COMPUTED`,
    `FETCHED`, both or neither.  ``reserved`` bytes are promised to it while it runs, which is while there is
    an ``attempt``.  ``losses`` counts loaders that were lost through no fault of this load.
    """

    key: Key
    estimate: int
    priority: float
    number: int
    work: Work = Purpose.DEMAND
    asker: Hashable = None
    kind: int = 0
    attempt: Attempt | None = None
    reserved: int = 0
    losses: int = 0

    @property
    def is_running(self) -> bool:
        """Whether a worker has it."""
        return self.attempt is not None

    @property
    def is_ahead(self) -> bool:
        """Whether no client needs its segment now."""
        return self.work is Purpose.WISH or self.work is Purpose.SPARE


def kind_of(cache: CellCache, index: int, layer: str) -> int:
    """Return the kind of a load of a layer of a cell."""
    layers = cache.layers
    if not layers.is_computed(index, layer):
        return FETCHED
    if cache.warm.get(index, LAYER) is not None and not layers.halo_m((layer,)):
        return COMPUTED  # of points in memory
    return COMPUTED | FETCHED


_Heap = list[tuple[float, int, Load]]


@dataclass(eq=False, slots=True)
class _Asker:
    """One asker's loads by priority, a heap for each kind.

    ``clock_s`` is the loader time it has used, ``running`` the number of its loads under way.  ``best`` says
    for each load's number which entry counts: its priority, and the heap.
    """

    clock_s: float
    heaps: tuple[_Heap, ...] = field(default_factory=lambda: ([], [], [], []))
    best: dict[int, tuple[float, int]] = field(default_factory=dict)
    running: int = 0


class LoadQueue:
    """Loads that wait for a worker or for memory; a load is queued from `push` to `discard`.

    ``changes`` counts loads added, removed or moved forward: the next load may be another one.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._loads: dict[int, Load] = {}
        self._askers: dict[Hashable, _Asker] = {}
        self._charged: dict[Load, tuple[Hashable, float]] = {}  # running loads: asker, estimated seconds
        self._clock_s = 0.0
        self._chosen: Hashable = None

    def __len__(self) -> int:
        return len(self._loads)

    def count(self, asker: Hashable) -> int:
        """Return how many loads of an asker are queued."""
        mine = self._askers.get(asker)
        return 0 if mine is None else sum(map(self._loads.__contains__, mine.best))

    def push(self, load: Load, priority: float, asker: Hashable) -> None:
        """Queue a load for an asker; queued again, it may move forward but never back."""
        self.changes += load.number not in self._loads
        self._loads[load.number] = load
        mine = self._askers.get(asker)
        if mine is None:
            mine = self._askers[asker] = _Asker(self._clock_s)
        known, kind = mine.best.get(load.number), load.kind
        if known is None or priority < known[0] or kind != known[1]:
            self.changes += 1
            mine.best[load.number] = priority, kind
            heapq.heappush(mine.heaps[kind], (priority, load.number, load))

    def discard(self, load: Load) -> None:
        """Remove a load from the queue."""
        self.changes += 1
        self._loads.pop(load.number, None)

    def start(self, load: Load) -> None:
        """Take out the load that `choose` has chosen, and charge its asker for its bytes."""
        self.discard(load)
        estimate_s = LOAD_S + load.estimate * BYTE_S
        self._charged[load] = self._chosen, estimate_s
        payer = self._askers.get(self._chosen)
        if payer is not None:
            payer.running += 1
            payer.clock_s += estimate_s

    def end(self, load: Load, spent_s: float) -> None:
        """Charge a load that no longer runs for the loader time that it took, instead of its bytes."""
        asker, estimate_s = self._charged.pop(load)
        payer = self._askers.get(asker)
        if payer is not None:
            payer.running -= 1
            payer.clock_s += spent_s - estimate_s

    def choose(self, *, points: bool = True, layers: bool = True, link: bool = True) -> Load | None:
        """Choose the next load among points, computed layers, or both; None if there is none.

        Without ``link`` those that need it are passed over.
        """
        best: tuple[bool, float, float, int] | None = None
        found: Load | None = None
        for asker, mine in list(self._askers.items()):
            self._clean(mine)
            if not any(mine.heaps) and self._is_square(mine):
                del self._askers[asker]
            for heap, wanted in zip(
                mine.heaps, (points, layers, points and link, layers and link), strict=True
            ):
                if heap and wanted:
                    priority, number, load = heap[0]
                    rank = (priority >= BACKGROUND, mine.clock_s, priority, number)
                    if best is None or rank < best:
                        best, found, self._chosen = rank, load, asker
        if found is not None:
            self._clock_s = max(self._clock_s, self._askers[self._chosen].clock_s)
        return found

    def bytes_behind(self) -> int:
        """Return the sum of the estimates of some loads that follow the one `choose` has chosen."""
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
        """Whether an asker without queued loads can be forgotten: it owes no time, or nothing else waits."""
        if mine.running:
            return False
        return mine.clock_s <= self._clock_s or not self._loads or len(self._askers) > MAX_REMEMBERED

    def _clean(self, mine: _Asker) -> None:
        """Drop loads no longer queued from the front, and from everywhere once they are the majority."""
        for kind, heap in enumerate(mine.heaps):
            while heap and (mine.best.get(heap[0][1]) != (heap[0][0], kind) or heap[0][1] not in self._loads):
                priority, number, _load = heapq.heappop(heap)
                if mine.best.get(number) == (priority, kind):
                    del mine.best[number]
        if sum(map(len, mine.heaps)) > 2 * len(self._loads) + 64:
            mine.best = {number: best for number, best in mine.best.items() if number in self._loads}
            for heap in mine.heaps:
                heap.clear()
            for number, (priority, kind) in mine.best.items():
                heapq.heappush(mine.heaps[kind], (priority, number, self._loads[number]))


class Loads:
    """Loads that are wanted, queued and running, and those that failed; without any I/O.

    Parameters
    ----------
    ledger
        Reserves the bytes of running loads.
    link
        Counts what running loads fetch from a remote origin; None if cells are files.

    ``queue`` contains loads that wait, ``by_key`` all that have not ended; ``failures`` contains why the last
    load of a key failed, until a load succeeds or the cause may have passed.
    """

    def __init__(self, ledger: Ledger, link: Link | None = None) -> None:
        self._ledger, self._link = ledger, link
        self.by_key: dict[Key, Load] = {}
        self.failures: dict[Key, Failure] = {}
        self._keys_failed: dict[str, OrderedDict[Key, None]] = {}  # by code, oldest first
        self.queue = LoadQueue()
        self._numbers = 0

    def __len__(self) -> int:
        """Return how many loads are queued."""
        return len(self.queue)

    def want(
        self,
        key: Key,
        estimate: int,
        priority: float,
        asker: Hashable = None,
        *,
        kind: int = 0,
    ) -> Load:
        """Queue a load, or move a queued one forward; all askers of a key share one load, and take turns."""
        load = self._queue_for(key, estimate, priority, asker, Purpose.DEMAND, kind)
        if isinstance(load.work, LeftoverCheck):
            load.work = replace(load.work, is_asked_for=True)
        elif isinstance(load.work, Purpose):
            load.work = Purpose.DEMAND
        return load

    def prefetch(self, key: Key, estimate: int, needed_in_s: float, *, kind: int = 0) -> Load:
        """Queue a load that no client has asked for yet, after all loads that clients ask for."""
        return self._queue_for(key, estimate, PREFETCH + needed_in_s, PREFETCH, Purpose.WISH, kind)

    def spare(self, key: Key, estimate: int, asker: Hashable, *, kind: int = 0) -> Load:
        """Queue a load for a spare request, after all loads that clients ask for."""
        load = self._queue_for(key, estimate, BACKGROUND, asker, Purpose.SPARE, kind)
        if load.work is Purpose.WISH:
            load.work = Purpose.SPARE
        return load

    def check_leftover(self, resident: Resident) -> None:
        """Queue the check of a previous run's segment, after all loads that clients ask for."""
        load = self._queue_for(resident.key, 0, math.inf, None, LeftoverCheck(resident))
        if isinstance(load.work, Purpose) and not load.is_running:
            load.work = LeftoverCheck(resident, load.work is Purpose.DEMAND)
            load.estimate = load.kind = 0

    def check_failed_file(self, key: Key, priority: float, asker: Hashable, stamp: Stamp) -> Load:
        """Queue the check of a file that failed, for a client that asks for its cell again."""
        return self._queue_for(key, 0, priority, asker, FailedFileCheck(stamp))

    def _queue_for(
        self, key: Key, estimate: int, priority: float, asker: Hashable, work: Work, kind: int = 0
    ) -> Load:
        """Return the load of a key, moved forward if it is queued; if there is none, queue this ``work``."""
        load = self.by_key.get(key)
        if load is None:
            self._numbers += 1
            load = self.by_key[key] = Load(key, estimate, priority, self._numbers, work, asker, kind)
        if not load.is_running:
            load.priority = min(load.priority, priority)
            self.queue.push(load, priority, asker)
        return load

    def is_promised(self, key: Key) -> bool:
        """Whether a load of a key is on its way, and not merely a check of the file that failed."""
        load = self.by_key.get(key)
        return load is not None and not isinstance(load.work, FailedFileCheck)

    def start(self, load: Load, attempt: Attempt, link_bytes: int = 0) -> bool:
        """Reserve the bytes of the chosen load; it runs from now on.  Return False if they do not fit.

        ``link_bytes``: what it fetches over the link.
        """
        if not self._ledger.reserve(load.estimate):
            return False
        self.queue.start(load)
        load.attempt, load.reserved = attempt, load.estimate
        if self._link is not None and link_bytes:
            cause: Cause = "ahead" if load.is_ahead else "demand"
            self._link.begin(load, link_bytes, attempt.started_s, cause)
        return True

    def grow(self, load: Load, nbytes: int) -> bool:
        """Raise a running load's reservation to ``nbytes``; return False if that does not fit."""
        extra = max(0, nbytes - load.reserved)
        fits = self._ledger.reserve(extra)
        load.reserved += extra if fits else 0
        return fits

    def defer(self, load: Load) -> None:
        """Take a load that cannot start yet out of the queue, until `requeue`."""
        self.queue.discard(load)

    def requeue(self, load: Load) -> None:
        """Put a running load back (its worker died before it began, or the data read is outdated)."""
        self._take_back(load)
        self.queue.push(load, load.priority, load.asker)

    def _take_back(self, load: Load) -> None:
        self._ledger.reserved_bytes -= load.reserved
        load.reserved = 0
        if load.attempt is not None:
            self.queue.end(load, load.attempt.spent_s)
            load.attempt = None
            if self._link is not None:
                self._link.end(load)

    def finish(self, load: Load, failure: Failure | None = None) -> None:
        """End a load; a ``failure`` stays until a load of the key succeeds or it is cleared."""
        self._take_back(load)
        self.queue.discard(load)
        if self.by_key.get(load.key) is load:
            del self.by_key[load.key]
            self.forget_failure(load.key)
            if failure is not None:
                self._remember(load.key, failure)

    def failure(self, key: Key, code: str, message: str, stamp: Stamp | None, now_s: float) -> Failure:
        """Return why a load failed; the back-off doubles if the previous failure had the same reason."""
        old = self.failures.get(key)
        if code in SPACE_CODES:
            delay_s = BUDGET_RETRY_S
        else:
            delay_s = min(2 * old.delay_s, LAST_RETRY_S) if old and old.code == code else FIRST_RETRY_S
        return Failure(code, message, stamp, now_s + delay_s, delay_s)

    def _remember(self, key: Key, failure: Failure) -> None:
        self.failures[key] = failure
        keys = self._keys_failed.setdefault(failure.code, OrderedDict())
        keys[key] = None
        if len(keys) > MAX_FAILURES:
            self.forget_failure(next(iter(keys)))

    @property
    def unloadable(self) -> int:
        """Number of keys that could not be loaded when last tried, though there was memory and a source."""
        return len(self._keys_failed.get("load_failed", ()))

    def cancel(self, key: Key) -> None:
        """Drop a queued load and a remembered failure of a key (its cell left the map)."""
        self.forget_failure(key)
        load = self.by_key.get(key)
        if load is not None and not load.is_running:
            self.queue.discard(load)
            del self.by_key[key]

    def forget_refusals(self) -> None:
        """Forget failures for lack of memory: there may be room now."""
        for code in SPACE_CODES:
            for key in [*self._keys_failed.get(code, ())]:
                self.forget_failure(key)

    def forget_failures(self) -> None:
        """Forget all other failures: their common cause has passed."""
        for key in [key for key, failure in self.failures.items() if failure.code not in SPACE_CODES]:
            self.forget_failure(key)

    def forget_failure(self, key: Key) -> None:
        """Forget why the last load of a key failed, if it did."""
        failure = self.failures.pop(key, None)
        if failure is not None:
            self._keys_failed[failure.code].pop(key, None)
