# SPDX-License-Identifier: Apache-2.0
"""The serving loop: one thread, and nothing in it that waits for a disk.

Requests come first; between them the loop hears its clients and loaders, and frees memory.  Files are read
and layers built elsewhere (`shmmap.daemon.loading.worker_main`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.host.defects import Defects
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.dispatch import Dispatch
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.telemetry.sampler import BEAT_S, Sampler
from shmmap.daemon.transport.inbox import Inbox
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["ServingLoop"]

SERVE_S: Final = 0.002
"""How long requests are served before the loop looks at everything else."""


@dataclass(eq=False, slots=True)
class ServingLoop:
    """Serves one map until told to stop."""

    watched: WatchedDescriptors
    inbox: Inbox
    dispatch: Dispatch
    operators: OperatorRequests
    cells: CellRequests
    cache: CellCache
    scheduler: Scheduler
    sampler: Sampler
    statistics: StatisticsWriter
    defects: Defects
    stopping: bool = False
    _answer_at_end: bool = True

    def stop(self, *, answer: bool = True) -> None:
        """Leave the loop after this turn; without ``answer`` those who wait are left to the next life."""
        self.stopping = True
        self._answer_at_end = answer

    def run(self) -> None:
        """Serve until `stop`; then answer those who still wait."""
        while not self.stopping:
            self._turn(self.watched.poll(self._patience_s()))

    def answer_waiting(self) -> None:
        """Answer those who still wait, unless they are left to the next life."""
        if self._answer_at_end:
            self.cells.answer_all()
            while not self.cache.survey.idle:
                self.cache.survey.step()

    def _patience_s(self) -> float:
        """How long nothing has to be done if nothing comes."""
        if len(self.inbox):
            return 0
        until_s = min(
            self.scheduler.next_event_s(),
            self.cells.next_deadline_s(),
            self.sampler.next_s,
            self.cache.survey.next_step_s,
        )
        return min(max(0.0, until_s - time.monotonic()), BEAT_S)

    def _turn(self, ready: list[int]) -> None:
        self._hear(ready)
        self._guarded(self._serve)
        self._look_after_the_rest(time.monotonic())
        self._guarded(self.scheduler.pump, time.monotonic())
        self._guarded(self.cache.tell_all)

    def _guarded(self, call: Callable[..., object], *arguments: object) -> None:
        """Call what must not end the daemon if it fails, unless that happens again and again."""
        try:
            call(*arguments)
        except Exception:  # a defect: one client's trouble must not be everybody's
            if self.defects.met():
                raise

    def _hear(self, ready: list[int]) -> None:
        for fd in ready:
            callback = self.watched.callbacks.get(fd)
            if callback is not None:  # another one's may have ended it
                self._guarded(callback)

    def _serve(self) -> None:
        """Serve those whose turn it is, for a bounded time; between any two of them hear who has come."""
        start_s = time.monotonic()
        end_s = start_s + SERVE_S
        while start_s < end_s and (turn := self.inbox.take()) is not None:
            if turn.over:
                turn.work = self.dispatch.handle(turn)
            self._guarded(turn.go_on)
            self._guarded(self.cache.tell_all)
            now_s = time.monotonic()
            self.inbox.served(turn, now_s - start_s)
            if turn.asked and turn.over:
                self.statistics.add_duration("request", int((now_s - start_s) * 1e9))
            start_s = now_s
            if len(self.inbox):
                self._hear(self.watched.poll(0))

    def _look_after_the_rest(self, now_s: float) -> None:
        """What has its own time: deadlines, surveys, statistics."""
        self._guarded(self.scheduler.lost.end_overdue, now_s)
        self._guarded(self.cells.answer_overdue, now_s)
        self._guarded(self.cache.survey.turn, now_s)
        self._guarded(self.sampler.turn, now_s)
        if now_s >= self.operators.stop_by_s:
            self.stop()
