# SPDX-License-Identifier: Apache-2.0
"""Workers that died, could not start or took too long: only the cell that each worked on fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from shmmap.daemon.host.memory import memory_limit_bytes, out_of_memory_kills
from shmmap.daemon.loading.loads import Load, Loads
from shmmap.daemon.loading.room import Room
from shmmap.daemon.loading.worker_pool import Work, Worker, WorkerPool
from shmmap.installed import RESTART, is_replaced
from shmmap.logfmt import log
from shmmap.quantities import format_bytes
from shmmap.segment.version import Stamp
from shmmap.statistics.writer import StatisticsWriter

KILLED: Final = "signal SIGKILL"
OUT_OF_MEMORY: Final = "out of memory"
START_ATTEMPTS: Final = 3
"""Consecutive failed starts of loaders before loads fail instead of waiting."""

LOSSES_ALLOWED: Final = 3
"""How often a load may lose its loader because the parent ended: the load itself may be the cause."""


@dataclass(eq=False, slots=True)
class LostWorkers:
    """Replaces lost workers, and requeues the jobs that they had not begun.

    Parameters
    ----------
    jobs
        Loads that workers are doing, by job number.
    fail
        Called with a load, a code, a message, the state of the file that failed, and the time.
    """

    pool: WorkerPool
    jobs: dict[int, Load]
    loads: Loads
    room: Room
    statistics: StatisticsWriter
    fail: Callable[[Load, str, str, Stamp | None, float], None]
    oom_kills: int = field(default_factory=out_of_memory_kills)

    def ended(self, worker: Worker, how: str, now_s: float) -> None:
        """Handle the end of a worker; ``how`` is a text for people, and empty if its parent ended."""
        self.statistics.add("worker_crashes")
        if not worker.ready:
            self._could_not_start(worker, how, now_s)
        elif how == KILLED:
            self._replace(worker, "load_failed", self._why_killed(), now_s)
        elif how:
            self._replace(worker, "load_failed", f"the loader died of it ({how})", now_s)
        else:
            self._vanished(worker, now_s)

    def _why_killed(self) -> str:
        """Return why a loader was killed, so that a file is not blamed for a lack of memory."""
        before, self.oom_kills = self.oom_kills, out_of_memory_kills()
        limit = memory_limit_bytes()
        allowed = f" (the control group allows {format_bytes(limit)})" if limit else ""
        if self.oom_kills > before:
            return f"{OUT_OF_MEMORY}: the kernel killed the loader{allowed}"
        return f"the loader was killed ({KILLED}): by a person or a program"

    def end_overdue(self, now_s: float) -> None:
        """Kill workers whose load, or whose start, takes too long."""
        self.pool.make_places(now_s)
        for worker in self.pool.overdue(now_s):
            if worker.ready:
                self.statistics.add("loads_timed_out")
                self._replace(worker, "load_timeout", "loading took longer than allowed", now_s)
            else:
                self.pool.parent.end("its parent was not ready in time")
                self.ended(worker, "", now_s)

    def _could_not_start(self, worker: Worker, how: str, now_s: float) -> None:
        self.pool.failed_starts += 1
        self.pool.parent.poll()
        how = RESTART if is_replaced() else how or self.pool.parent.why_not or "its parent has ended"
        log.error("loader could not start", reason=how)
        give_up = how == RESTART or self.pool.failed_starts >= START_ATTEMPTS
        for job, load in self._unfinished(worker):
            if give_up:
                self.fail(load, "load_failed", f"{job.source.name}: no loader can start: {how}", None, now_s)
            else:
                self.loads.requeue(load)

    def _vanished(self, worker: Worker, now_s: float) -> None:
        """Replace a worker whose parent ended: no job is blamed, unless this happens repeatedly."""
        at_work = worker.at_work or next(iter(worker.queue), 0)
        for job, load in self._unfinished(worker):
            load.losses += job.number == at_work
            if load.losses < LOSSES_ALLOWED:
                self.loads.requeue(load)
            else:
                self.fail(load, "load_failed", f"{job.source.name}: its loaders vanish", None, now_s)

    def _replace(self, worker: Worker, code: str, why: str, now_s: float) -> None:
        """Remove a worker that had begun: its current job fails."""
        spent_s, at_work = now_s - worker.since_s, worker.at_work
        if worker.queue and not at_work:
            log.error("loader replaced", reason=why)
            self._vanished(worker, now_s)
            return
        for job, load in self._unfinished(worker):
            if job.number != at_work:
                self.loads.requeue(load)
                continue
            log.error("loader replaced", path=job.source.name, reason=why)
            sources: tuple[Stamp, ...] = ()
            if (attempt := load.attempt) is not None:
                attempt.spent_s = attempt.took_s = spent_s
                sources = attempt.sources
            # after a timeout the file is not accessed again: its file system may be what hangs
            blamed = code == "load_failed" and not why.startswith(OUT_OF_MEMORY)
            known = sources[0] if blamed and sources else None
            self.fail(load, code, f"{job.source.name}: {why}", known, now_s)

    def _unfinished(self, worker: Worker) -> Iterator[tuple[Work, Load]]:
        """Remove a worker; yield its unfinished jobs and their loads."""
        for job in self.pool.remove(worker):
            self.room.forget(job.number)
            load = self.jobs.pop(job.number, None)
            if load is not None:  # else another loader has reported the end of this job
                yield job, load
