# SPDX-License-Identifier: Apache-2.0
"""Loads from the queue to their end: room is made, a worker is given the job, its word is heard.

Whatever becomes of a load, only its own cell is concerned: a worker that dies or takes too long is
replaced, and the jobs behind the one it died of go back into the queue.

A segment of an earlier life of the daemon is checked by a worker before it is handed out, as a load
that costs no memory; when it is not what it should be, the cell is loaded like any other.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Final, Protocol

from shmmap.daemon.cache.ledger import Failure, Key, Load, Residency, Resident
from shmmap.daemon.cache.reclaimer import Outcome, Reclaimer
from shmmap.daemon.loading import worker_messages
from shmmap.daemon.loading.worker_pool import RESTART, Worker, WorkerPool
from shmmap.failpoints import step
from shmmap.segment.layout import SourceStamp
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["SPACE_CODES", "Loading", "Shelf"]

_log = logging.getLogger(__name__)

FIRST_RETRY_S: Final = 1.0
LAST_RETRY_S: Final = 30.0
BUDGET_RETRY_S: Final = 0.1
START_ATTEMPTS: Final = 3
"""After this many loaders in a row that could not start, loads fail instead of waiting."""
SPACE_CODES: Final = frozenset({"over_budget", "no_space"})


class Shelf(Protocol):
    """Where loads come from and go to: the store."""

    def job(self, load: Load, number: int) -> worker_messages.Job | worker_messages.Check | None:
        """What a worker has to do for a load; None if its cell left the map."""

    def publish(self, load: Load, done: worker_messages.Done, fd: int, now_s: float) -> None:
        """Take a finished segment; the descriptor is closed afterwards."""

    def accept(self, load: Load, resident: Resident) -> bool:
        """Hand out a checked segment from now on; False if it has left service meanwhile."""

    def reject(self, resident: Resident, why: str, now_s: float) -> None:
        """Take a segment that is not what it should be out of service."""

    def estimate_of(self, key: Key) -> int:
        """Bytes to reserve before loading a key."""

    def failed(self, key: Key, failure: Failure, now_s: float) -> None:
        """Hear that a load ended without a segment."""


class Loading:
    """Carries out the loads that the books queue.

    Parameters
    ----------
    on_settled
        Called with a key when its load ended, in whichever way.

    Attributes
    ----------
    pool
        The workers.
    hungry : dict
        Per job number, the worker that waits for more room, and how many bytes it needs in all.
    """

    def __init__(
        self,
        shelf: Shelf,
        books: Residency,
        reclaimer: Reclaimer,
        pool: WorkerPool,
        statistics: StatisticsWriter,
        on_settled: Callable[[Key], None],
    ) -> None:
        self._shelf = shelf
        self.books = books
        self.reclaimer = reclaimer
        self.pool = pool
        self._statistics = statistics
        self._on_settled = on_settled
        self._jobs: dict[int, Load] = {}
        self._job_numbers = 0
        self.hungry: dict[int, tuple[Worker, int]] = {}

    def may_retry(self, key: Key, failure: Failure, now_s: float) -> bool:
        """Whether asking again can help: the back-off is over, or the file has changed."""
        if now_s >= failure.retry_at_s:
            return True
        if failure.code in SPACE_CODES or failure.stamp is None:
            return False
        return _stamp_of(key.cell_id) not in (failure.stamp, None)

    def pump(self, now_s: float) -> None:
        """Free what is due, hand queued loads to workers as far as memory and workers allow."""
        if self.books.zombies and self.reclaimer.sweep(now_s):
            self.books.clear_failures(SPACE_CODES)
        self._feed_hungry(now_s)
        while self.pool.has_room:
            load = self.books.next_queued()
            if load is None:
                return
            job = self._shelf.job(load, self._job_numbers + 1)
            if job is None:
                self.abandon(load)
                continue
            shortage = self.books.shortage(load.estimate)
            if load.estimate and shortage > 0:
                if self._make_room(load, shortage, now_s):
                    continue
                return
            self.books.start(load, now_s)
            self._job_numbers += 1
            if not self.pool.submit(job, now_s):
                self.books.requeue(load)
                return
            self._jobs[job.number] = load
            if isinstance(job, worker_messages.Job):
                self._statistics.add("loads_started")

    def _make_room(self, load: Load, shortage: int, now_s: float) -> bool:
        """Whether the load was given up (True) or room is on its way (False)."""
        if load.estimate + self.books.overhead_bytes > self.books.budget_bytes:
            message = f"the cell needs {load.estimate} bytes, the whole budget is {self.books.budget_bytes}"
            self.fail(load, "over_budget", message, None, now_s)
            return True
        if self.reclaimer.free(shortage, now_s) is Outcome.PENDING or self._may_give_back():
            return False
        message = f"{load.estimate} bytes do not fit: the budget of {self.books.budget_bytes} bytes is in use"
        self.fail(load, "over_budget", message, None, now_s)
        return True

    def _may_give_back(self) -> bool:
        """Whether a load runs that will end by itself: it may need less than is reserved for it.

        Loads that wait for room do not end by themselves, nor do those that come after them in the
        same loader's queue.
        """
        return any(worker.queue and next(iter(worker.queue)) not in self.hungry for worker in self.pool)

    def hear(self, now_s: float) -> None:
        """The kernel reports that segments were closed."""
        if self.reclaimer.hear(now_s):
            self.books.clear_failures(SPACE_CODES)

    def next_event_s(self) -> float:
        """When `pump` has something to do although nothing arrives; infinity for never."""
        return min(self.reclaimer.next_sweep_s(), self.reclaimer.wake_s, self.pool.next_deadline_s())

    # --- what workers say -----------------------------------------------------------------------

    def on_worker(self, worker: Worker, now_s: float) -> bool:
        """Handle one message of a worker; False when there is none left now."""
        try:
            received = self.pool.receive(worker)
        except EOFError:
            self._on_worker_end(worker, now_s)
            return False
        if received is None:
            return False
        message, fd = received
        if fd >= 0 and not isinstance(message, worker_messages.Segment):
            os.close(fd)
        if isinstance(message, worker_messages.Ready):
            worker.ready = True
            worker.head_since_s = now_s
            self.pool.failed_starts = 0
            return True
        if isinstance(message, worker_messages.Segment):
            step("daemon.received")
            if worker.segment_fd >= 0:
                os.close(worker.segment_fd)
            worker.segment_fd = fd
            return True
        if isinstance(message, worker_messages.Need):
            self.hungry[message.number] = (worker, message.bytes)
            self._feed_hungry(now_s)
            return True
        self.pool.finished(worker, message.number, now_s)
        self.hungry.pop(message.number, None)
        load = self._jobs.pop(message.number, None)
        fd, worker.segment_fd = worker.segment_fd, -1
        if isinstance(message, worker_messages.Checked):
            if load is not None:
                self._checked(load, message.wrong, now_s)
        elif isinstance(message, worker_messages.Failed):
            if fd >= 0:
                os.close(fd)
            if load is not None:
                self.fail(load, message.code, message.message, message.stamp, now_s)
        elif fd >= 0:
            try:
                if load is not None:
                    self._shelf.publish(load, message, fd, now_s)
            finally:
                os.close(fd)
        elif load is not None:  # this process had no descriptor left to receive it
            self.fail(load, "load_failed", "the finished segment did not arrive", None, now_s)
        return True

    def _checked(self, load: Load, wrong: str, now_s: float) -> None:
        """An adopted segment was compared with its checksums, or could not be."""
        resident, load.adopted = load.adopted, None
        if resident is not None and not wrong and self._shelf.accept(load, resident):
            self._on_settled(load.key)
            return
        if resident is not None and wrong:
            self._shelf.reject(resident, wrong, now_s)
        if load.wanted:
            load.estimate = self._shelf.estimate_of(load.key)
            self.books.requeue(load)
        else:
            self.abandon(load)

    def _feed_hungry(self, now_s: float) -> None:
        """Grant, hold or refuse the extra bytes that workers asked for."""
        for number, (worker, nbytes) in list(self.hungry.items()):
            load = self._jobs.get(number)
            if load is None:
                del self.hungry[number]
            elif self.books.grow(load, nbytes):
                del self.hungry[number]
                self.pool.answer(worker, worker_messages.Grant(number))
            else:
                shortage = self.books.shortage(nbytes - load.reserved)
                hopeless = nbytes + self.books.overhead_bytes > self.books.budget_bytes
                outcome = Outcome.IMPOSSIBLE if hopeless else self.reclaimer.free(shortage, now_s)
                if hopeless or (outcome is Outcome.IMPOSSIBLE and not self._may_give_back()):
                    del self.hungry[number]
                    self.pool.answer(worker, worker_messages.Refuse(number))

    def _on_worker_end(self, worker: Worker, now_s: float) -> None:
        unfinished, how = self.pool.remove(worker)
        self._statistics.add("worker_crashes")
        if not worker.ready:
            self.pool.failed_starts += 1
            _log.error("a loader could not start: %s", how)
        at_fault = worker.ready or how == RESTART or self.pool.failed_starts >= START_ATTEMPTS
        for position, job in enumerate(unfinished):
            self.hungry.pop(job.number, None)
            load = self._jobs.pop(job.number, None)
            if load is None:
                continue
            if at_fault and not worker.ready:
                self.fail(load, "load_failed", f"{job.path}: no loader can start: {how}", None, now_s)
            elif at_fault and position == 0:
                _log.error("loader died while it read %s: %s", job.path, how)
                message = f"{job.path}: the loader died of it ({how})"
                self.fail(load, "load_failed", message, _stamp_of(job.path), now_s)
            else:
                self.books.requeue(load)

    def end_overdue(self, now_s: float) -> None:
        """Kill workers whose load took too long; only the cell they worked on fails."""
        for worker in self.pool.overdue(now_s):
            if not worker.ready:
                self._on_worker_end(worker, now_s)
                continue
            number, job = next(iter(worker.queue.items()))
            load = self._jobs.pop(number, None)
            worker.queue.pop(number)
            unfinished, _how = self.pool.remove(worker)
            self.hungry.pop(number, None)
            self._statistics.add("loads_timed_out")
            _log.error("loading %s took too long, its loader was ended", job.path)
            if load is not None:
                self.fail(load, "load_timeout", f"{job.path}: loading took longer than allowed", None, now_s)
            for other in unfinished:
                self.hungry.pop(other.number, None)
                waiting = self._jobs.pop(other.number, None)
                if waiting is not None:
                    self.books.requeue(waiting)

    def fail(
        self, load: Load, code: str, message: str, stamp: tuple[int, int, int] | None, now_s: float
    ) -> None:
        """The load ended without a segment; the back-off doubles when it failed the same way before."""
        if load.adopted is not None:
            self._checked(load, message, now_s)
            return
        old = self.books.slot(load.key).failure
        if code in SPACE_CODES:
            delay_s = BUDGET_RETRY_S
            self._statistics.add("refused_over_budget")
        else:
            delay_s = min(2 * old.delay_s, LAST_RETRY_S) if old and old.code == code else FIRST_RETRY_S
            self._statistics.add("loads_failed")
            _log.warning("cannot load %s: %s: %s", load.key.cell_id, code, message)
        if self._shelf.job(load, 0) is None:
            self.abandon(load)
            return
        failure = Failure(code, message, stamp, now_s + delay_s, delay_s)
        self.books.failed(load, failure)
        self._shelf.failed(load.key, failure, now_s)
        self._on_settled(load.key)

    def abandon(self, load: Load) -> None:
        """The cell left the map: nobody asks for this any more, so nothing is remembered of it."""
        self.books.failed(load, None)
        self._on_settled(load.key)


def _stamp_of(path: str) -> SourceStamp | None:
    """What a file is now; None where it cannot be looked at."""
    try:
        return SourceStamp.of(os.stat(path))
    except OSError:
        return None
