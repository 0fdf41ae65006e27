# SPDX-License-Identifier: Apache-2.0
"""The serving loop: one thread, and nothing in it that waits for a disk.

Clients are heard and served first.  Then come loaders, the kernel and others that have something to say,
memory to free and loads to hand out: one of these, and if that took its time, whoever has asked meanwhile.
Files are read and layers built elsewhere (`shmmap.daemon.loading.worker_main`).  A turn goes from one look at
the descriptors to the next; whoever has just sent something waits for it: each is measured, none may be long.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

from shmmap.daemon.cache.holders import Survey
from shmmap.daemon.events.cell_events import CellEvents
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.host.defects import Defects
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.dispatch import Dispatch
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.telemetry.sampler import BEAT_S
from shmmap.daemon.transport.inbox import Inbox, Turn
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.protocol.events import LongTurn
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["Chore", "ServingLoop"]

CLIENTS: Final = "clients"
SERVE_S: Final = 0.002
"""How long requests are served before the loop looks at everything else."""
ENOUGH_NS: Final = 50_000
"""Processor time after which a turn begins no other work."""
LOADS_A_TURN: Final = 16
LONG_TURN_NS: Final = 10_000_000
"""Processor time of a turn that is worth an event."""
TOLD_S: Final = 1.0


class Chore(Protocol):
    """Work that has its own time and is done in bounded parts."""

    @property
    def next_s(self) -> float:
        """When a part of it is due; infinity for never, any time that is over for at once."""

    def turn(self, now_s: float) -> None:
        """Do the part that is due."""


@dataclass(eq=False, slots=True)
class ServingLoop:
    """Serves one map until told to stop.

    Parameters
    ----------
    chores
        By the kind of turn that each makes: a turn does a part of one of them, of those that are due the one
        that had none for the longest time.
    """

    watched: WatchedDescriptors
    inbox: Inbox
    dispatch: Dispatch
    operators: OperatorRequests
    cells: CellRequests
    cell_events: CellEvents
    survey: Survey
    scheduler: Scheduler
    chores: deque[tuple[str, Chore]]
    statistics: StatisticsWriter
    defects: Defects
    event_log: EventLog
    stopping: bool = False
    _answer_at_end: bool = True
    _turn_began_ns: int = field(default_factory=time.thread_time_ns)
    _most_s: float = 0.0
    _most_of_it: str = "statistics"
    _told_s: float = float("-inf")
    _others: dict[int, None] = field(default_factory=dict)  # that have something to say and are no clients

    def stop(self, *, answer: bool = True) -> None:
        """Leave the loop after this turn; without ``answer`` those who wait are left to the next life."""
        self.stopping = True
        self._answer_at_end = answer

    def run(self) -> None:
        """Serve until `stop`; then answer those who still wait."""
        self._turn_began_ns = time.thread_time_ns()
        while not self.stopping:
            self._turn(self._poll(self._patience_s()))

    def answer_waiting(self) -> None:
        """Answer those who still wait, unless they are left to the next life."""
        if self._answer_at_end:
            self.cells.answer_all()
            while not self.survey.idle:
                self.survey.step()

    def _patience_s(self) -> float:
        """How long nothing has to be done if nothing comes."""
        if len(self.inbox) or self._others:
            return 0
        until_s = min(
            self.scheduler.next_event_s(),
            self.cells.next_deadline_s(),
            *(chore.next_s for _kind, chore in self.chores),
        )
        return min(max(0.0, until_s - time.monotonic()), BEAT_S)

    def _poll(self, timeout_s: float) -> list[int]:
        """End a turn, wait, and begin the next one."""
        now_ns = time.thread_time_ns()
        took_ns = now_ns - self._turn_began_ns
        self._turn_began_ns = now_ns
        self.statistics.add_turn(self._most_of_it, took_ns)
        if took_ns > LONG_TURN_NS and (now_s := time.monotonic()) >= self._told_s + TOLD_S:
            self._told_s = now_s
            self.event_log.publish(LongTurn, self._most_of_it, took_ns)
        self._most_s, self._most_of_it = 0.0, "statistics"
        return self.watched.poll(timeout_s)

    def _turn(self, ready: list[int]) -> None:
        self._hear(ready)
        self._serve()
        for fd in list(self._others):
            self._breathe()
            self._others.pop(fd, None)
            self._call(fd)
            self._guarded("answers", self.cells.answer_finished)
        self._breathe()
        self._look_after_the_rest(time.monotonic())
        self._breathe()
        self._guarded("memory", self.scheduler.free, time.monotonic())
        for _ in range(LOADS_A_TURN):
            self._breathe()
            self._guarded("memory", self.scheduler.pump, time.monotonic())
            while self.cell_events.pending:
                self._breathe()
                self._guarded("memory", self.cell_events.flush_one)
            if not self.scheduler.unfinished:
                break

    def _breathe(self) -> None:
        """If this turn has taken its time, begin another one: hear who has come, serve some, go on."""
        if time.thread_time_ns() - self._turn_began_ns > ENOUGH_NS:
            self._hear(self._poll(0))
            self._serve(ENOUGH_NS * 1e-9)

    def _guarded(self, kind: str, call: Callable[..., object], *arguments: object) -> None:
        """Call what must not end the daemon if it fails, unless that happens again and again."""
        begin_s = time.monotonic()
        try:
            call(*arguments)
        except Exception:  # a defect: one client's trouble must not be everybody's
            if self.defects.met():
                raise
        took_s = time.monotonic() - begin_s
        if took_s > self._most_s:
            self._most_s, self._most_of_it = took_s, kind

    def _hear(self, ready: list[int]) -> None:
        """Hear the clients; loaders, the kernel and others are heard when requests have been served."""
        for fd in ready:
            if self.watched.kinds.get(fd) == CLIENTS:
                self._call(fd)
            else:
                self._others[fd] = None

    def _call(self, fd: int) -> None:
        callback = self.watched.callbacks.get(fd)
        if callback is not None:  # another one's may have ended it
            self._guarded(self.watched.kinds[fd], callback)

    def _serve(self, seconds: float = SERVE_S) -> None:
        """Serve those whose turn it is, for a bounded time; between any two of them hear who has come."""
        start_s = time.monotonic()
        end_s = start_s + seconds
        while start_s < end_s and (turn := self.inbox.take()) is not None:
            start_s = self._serve_one(turn, start_s)
            if len(self.inbox):
                self._hear(self._poll(0))

    def _serve_one(self, turn: Turn, start_s: float) -> float:
        """Serve whose turn it is; returns when that was done."""
        if turn.over:
            turn.work = self.dispatch.handle(turn)
            self._guarded("requests", turn.go_on)
        else:
            self._guarded("answers", turn.go_on)
        self._guarded("memory", self.cell_events.flush)
        now_s = time.monotonic()
        self.inbox.served(turn, now_s - start_s)
        if turn.asked and turn.over:
            self.statistics.add_duration("request", int((now_s - start_s) * 1e9))
        return now_s

    def _look_after_the_rest(self, now_s: float) -> None:
        """What has its own time: deadlines, and the next part of a chore."""
        self._guarded("loaders", self.scheduler.lost.end_overdue, now_s)
        self._guarded("answers", self.cells.answer_overdue, now_s)
        for _ in range(len(self.chores)):
            kind, chore = self.chores[0]
            self.chores.rotate(-1)
            if chore.next_s <= now_s:
                self._guarded(kind, chore.turn, now_s)
                break
        if now_s >= self.operators.stop_by_s:
            self.stop()
