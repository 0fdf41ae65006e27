# SPDX-License-Identifier: Apache-2.0
"""The serving loop: a single thread, which never waits for a disk.

Requests are served first.  Then follow the descriptors of loaders and the kernel, deadlines, one background
task, memory to free and loads to hand out, step by step.  Files are read and layers computed elsewhere
(`shmmap.daemon.loading.worker_main`).  A turn lasts from one poll of the descriptors to the next; messages
that clients send in between wait for the next turn.  Each turn is measured; work other than requests ends the
turn after a moment, and continues in a later turn (`shmmap.daemon.turns`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

from shmmap.daemon.cache.holders import Survey
from shmmap.daemon.events.cell_events import CellEvents
from shmmap.daemon.events.log import EventLog
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.dispatch import Defects, Dispatch
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.telemetry.sampler import IDLE_BEAT_S
from shmmap.daemon.transport.inbox import Inbox
from shmmap.daemon.turns import BURST_S, LONG_TURN_NS, TURN_NS, WatchedDescriptors
from shmmap.protocol.events import LongTurn
from shmmap.statistics.writer import StatisticsWriter

CLIENTS: Final = "clients"
LONG_TURN_EVENT_S: Final = 1.0


class BackgroundTask(Protocol):
    """Work with its own schedule, done in bounded steps."""

    @property
    def next_s(self) -> float:
        """Time when a step is due; infinity for never, any time in the past for at once."""

    def run_step(self, now_s: float) -> None:
        """Run the step that is due."""


@dataclass(eq=False, slots=True)
class ServingLoop:
    """Serves one map until it is stopped.

    Parameters
    ----------
    tasks
        Background tasks, each with its kind of turn: each round runs a step of one task, the one that has
        been due for longest.
    """

    watched: WatchedDescriptors
    inbox: Inbox
    dispatch: Dispatch
    operators: OperatorRequests
    cells: CellRequests
    cell_events: CellEvents
    survey: Survey
    scheduler: Scheduler
    tasks: deque[tuple[str, BackgroundTask]]
    statistics: StatisticsWriter
    defects: Defects
    event_log: EventLog
    stopping: bool = False
    _answer_at_end: bool = True
    _turn_began_ns: int = field(default_factory=time.thread_time_ns)
    _longest_s: float = 0.0
    _longest_kind: str = "statistics"
    _event_s: float = float("-inf")
    _ready: dict[int, None] = field(default_factory=dict)  # ready descriptors that are not clients'
    _round: Iterator[None] | None = None
    _burst_s: float = BURST_S  # time left for requests before the round continues

    def stop(self, *, answer: bool = True) -> None:
        """Leave the loop after this turn; without ``answer``, waiting requests are left to the next run."""
        self.stopping = True
        self._answer_at_end = answer

    def run(self) -> None:
        """Serve until `stop`."""
        self._turn_began_ns = time.thread_time_ns()
        while not self.stopping:
            self.turn()

    def answer_waiting(self) -> None:
        """Answer requests that still wait, unless they are left to the next run."""
        if self._answer_at_end:
            self.cells.answer_all()
            while not self.survey.idle:
                self.survey.step()

    def turn(self) -> None:
        """Poll, then serve a request or continue all other work; clients come first."""
        for fd in self._poll(self._poll_timeout_s()):
            if self.watched.kinds.get(fd) == CLIENTS:
                self._call(fd)
            else:
                self._ready[fd] = None
        if self._burst_s > 0:
            self._serve_next()
            if len(self.inbox) and self._burst_s > 0:
                return
        self._round = self._round or self._other_work()
        for _step in self._round:
            if time.thread_time_ns() - self._turn_began_ns > TURN_NS:
                self._burst_s = TURN_NS * 1e-9
                return
        self._round, self._burst_s = None, BURST_S

    def _poll_timeout_s(self) -> float:
        """Return how long the loop may sleep if nothing arrives."""
        if len(self.inbox) or self._ready or self._round is not None:
            return 0
        until_s = min(
            self.scheduler.next_event_s(),
            self.cells.next_s(),
            self.operators.stop_by_s,
            *(task.next_s for _kind, task in self.tasks),
        )
        return min(max(0.0, until_s - time.monotonic()), IDLE_BEAT_S)

    def _poll(self, timeout_s: float) -> list[int]:
        """End a turn, wait for descriptors, and begin the next turn."""
        now_ns = time.thread_time_ns()
        took_ns = now_ns - self._turn_began_ns
        self._turn_began_ns = now_ns
        self.statistics.add_turn(self._longest_kind, took_ns)
        if took_ns > LONG_TURN_NS and (now_s := time.monotonic()) >= self._event_s + LONG_TURN_EVENT_S:
            self._event_s = now_s
            self.event_log.publish(LongTurn, self._longest_kind, took_ns)
        self._longest_s, self._longest_kind = 0.0, "statistics"
        return self.watched.poll(timeout_s)

    def _serve_next(self) -> None:
        """Serve a step of the next item in the inbox, if there is one."""
        if (item := self.inbox.take()) is None:
            return
        begin_s = time.monotonic()
        if item.is_new:
            item.work = self.dispatch.handle(item)
            self._guarded("requests", item.run_step)
        else:
            self._guarded("answers", item.run_step)
        self._guarded("memory", self.cell_events.flush)
        took_s = time.monotonic() - begin_s
        self._burst_s -= took_s
        self.inbox.served(item, took_s)
        if item.is_request and item.is_done:
            self.statistics.add_duration("request", int(took_s * 1e9))

    def _other_work(self) -> Iterator[None]:
        """Run a round of all work except requests, step by step."""
        for fd in list(self._ready):
            yield
            self._ready.pop(fd, None)
            self._call(fd)
            self._guarded("answers", self.cells.answer_due, time.monotonic())
        yield
        self._do_what_is_due(time.monotonic())
        yield
        self._guarded("memory", self.scheduler.free, time.monotonic())
        end_s = time.monotonic() + BURST_S
        while True:
            yield
            self._guarded("memory", self.scheduler.pump, time.monotonic())
            while self.cell_events.pending:
                yield
                self._guarded("memory", self.cell_events.flush_one)
            if not self.scheduler.unfinished or time.monotonic() >= end_s:
                break

    def _do_what_is_due(self, now_s: float) -> None:
        """Handle deadlines, and run the next step of a background task."""
        self._guarded("loaders", self.scheduler.lost.end_overdue, now_s)
        self._guarded("answers", self.cells.answer_due, now_s)
        for _ in range(len(self.tasks)):
            kind, task = self.tasks[0]
            self.tasks.rotate(-1)
            if task.next_s <= now_s:
                self._guarded(kind, task.run_step, now_s)
                break
        if now_s >= self.operators.stop_by_s:
            self.stop()

    def _call(self, fd: int) -> None:
        callback = self.watched.callbacks.get(fd)
        if callback is not None:  # another callback may have removed it
            self._guarded(self.watched.kinds[fd], callback)

    def _guarded(self, kind: str, call: Callable[..., object], *arguments: object) -> None:
        """Call a function whose failure must not end the daemon, unless it fails repeatedly."""
        begin_s = time.monotonic()
        try:
            call(*arguments)
        except Exception:  # a defect: one client's trouble must not affect all clients
            if self.defects.record():
                raise
        took_s = time.monotonic() - begin_s
        if took_s > self._longest_s:
            self._longest_s, self._longest_kind = took_s, kind
