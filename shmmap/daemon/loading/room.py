# SPDX-License-Identifier: Apache-2.0
"""Memory for loads when it is short: it is freed, promised or refused."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from shmmap.daemon.cache.evictor import Evictor, Freeing
from shmmap.daemon.cache.ledger import Ledger
from shmmap.daemon.cache.lost_segments import LostSegments
from shmmap.daemon.cache.reclaimer import Reclaimer
from shmmap.daemon.loading.loads import Load, Loads, Purpose
from shmmap.daemon.loading.prefetcher import Prefetcher
from shmmap.daemon.loading.worker_messages import Decision, Need
from shmmap.daemon.loading.worker_pool import Worker, WorkerPool
from shmmap.daemon.records import Resident
from shmmap.daemon.turns import WatchedDescriptors
from shmmap.quantities import format_bytes

AHEAD_SHARE: Final = 32
"""Fraction of the budget (1/32) up to which memory is also freed for loads that follow the next one."""
AGAIN_S: Final = 0.05
"""Delay after which a load that waits for memory asks again even if nothing has changed: a precaution."""


@dataclass(eq=False, slots=True)
class Room:
    """Frees memory for loads, and retries refused loads when memory may be free."""

    ledger: Ledger
    evictor: Evictor
    reclaimer: Reclaimer
    lost: LostSegments
    loads: Loads
    pool: WorkerPool
    prefetcher: Prefetcher
    waited_for: bool = False  # by the next load, as far as is known
    awaiting_grant: dict[int, tuple[Worker, int]] = field(default_factory=dict)  # by job number
    _waited_at: tuple[int, ...] = ()
    _waited_until_s: float = 0.0

    def watch(self, watched: WatchedDescriptors, clock: Callable[[], float]) -> None:
        """Register for the kernel's reports of events that may free memory."""
        for fd, collect in (
            (self.reclaimer.closer.fd, self.reclaimer.collect),
            (self.reclaimer.pins.fd, lambda: self.reclaimer.on_closes(clock())),
            (self.lost.fd, lambda: self.lost.retire_vanished(clock())),
        ):
            if fd >= 0:
                watched.watch(fd, partial(self.on_report, collect), "memory")

    def on_report(self, collect: Callable[[], object]) -> None:
        """Collect a report of the kernel: if memory may be free, loads that were refused may fit now."""
        if collect():
            self.loads.forget_refusals()

    def release(self, residents: Iterable[Resident], now_s: float) -> None:
        """Release segments that a client has dropped: loads refused for lack of memory may fit now."""
        self.reclaimer.release(residents, now_s)
        self.loads.forget_refusals()

    def why_not(self, load: Load, shortage: int, behind: int, now_s: float) -> str:
        """Free memory for a load; return why that is impossible, or nothing if it is under way.

        Evicted memory is free a moment later.  At the same time more is evicted, for the loads of ``behind``
        bytes that come next: else each of them would have to wait for its own eviction.
        """
        ledger = self.ledger
        if load.work is Purpose.WISH:
            has_room = self.prefetcher.make_room(load, shortage, now_s)
            return "" if has_room else "it will be needed later than others"
        if load.work is Purpose.SPARE:
            return "no memory is free"
        if not ledger.fits_at_all(load.estimate):
            needed, budget = format_bytes(load.estimate), format_bytes(ledger.budget_bytes)
            return f"the cell needs {needed}, the whole budget is {budget}"
        more = min(behind, ledger.budget_bytes // AHEAD_SHARE)
        if self._may_come(shortage + more, now_s) or (more and self._may_come(shortage, now_s)):
            return ""
        return f"the budget of {format_bytes(ledger.budget_bytes)} is in use"

    def wait(self, running: int, now_s: float) -> None:
        """Make the next load wait for memory, while ``running`` loads are running."""
        self.waited_for = True
        self._waited_at, self._waited_until_s = self._state(running), now_s + AGAIN_S

    def still_waited_for(self, running: int, now_s: float) -> bool:
        """Whether nothing has changed since a load began to wait; otherwise it should try again."""
        self.waited_for = now_s < self._waited_until_s and self._waited_at == self._state(running)
        return self.waited_for

    def wake(self) -> None:
        """Let the next load try again: it is time to.  That time is over then, even if none waits."""
        self.evictor.wake_s, self.waited_for = math.inf, False

    def _state(self, running: int) -> tuple[int, ...]:
        """Return a value that differs whenever memory may be free, or another load is next."""
        ledger = self.ledger
        return (
            ledger.shortage(0),
            ledger.coming_bytes,
            ledger.evictable.changes,
            self.loads.queue.changes,
            running,
        )

    def ask(self, worker: Worker, message: Need) -> None:
        """Note that a worker needs more than was reserved for it; it waits for `grant`."""
        self.awaiting_grant[message.number] = (worker, message.bytes)

    def forget(self, number: int) -> None:
        """Forget the request of a job that has ended."""
        self.awaiting_grant.pop(number, None)

    def grant(self, jobs: Mapping[int, Load], now_s: float) -> None:
        """Grant, defer or refuse the extra bytes that workers asked for; ``jobs`` are loads by job number."""
        ledger = self.ledger
        for number, (worker, nbytes) in list(self.awaiting_grant.items()):
            load = jobs.get(number)
            if load is not None:
                granted = self.loads.grow(load, nbytes)
                if not granted and ledger.fits_at_all(nbytes):
                    shortage = ledger.shortage(nbytes - load.reserved)
                    if not self.why_not(load, shortage, 0, now_s):
                        continue
                self.pool.answer(worker, Decision(granted))
            del self.awaiting_grant[number]

    def _may_come(self, shortage: int, now_s: float) -> bool:
        """Free memory; return whether ``shortage`` bytes are, or may become, free.

        A running load may use less than is reserved for it.  Loads that wait for memory do not end by
        themselves, nor do the loads queued after them in the same loader.
        """
        return self.evictor.free(shortage, now_s) is not Freeing.NO_MORE or any(
            worker.queue and self.awaiting_grant.keys().isdisjoint(worker.queue) for worker in self.pool
        )
