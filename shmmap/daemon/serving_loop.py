# SPDX-License-Identifier: Apache-2.0
"""The serving loop: one thread, one ROUTER socket, nothing in it that waits for a disk.

Requests come first; between them the loop hears its loaders, watches its clients' processes and
frees memory.  Files are read and layers built elsewhere (`shmmap.daemon.loading.worker_main`).
"""

from __future__ import annotations

import time
from typing import Final

import zmq

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.dispatch import Dispatch
from shmmap.daemon.requests.operators.operator_requests import OperatorRequests
from shmmap.daemon.telemetry.sampler import BEAT_S, Sampler
from shmmap.daemon.transport.crowd_control import CrowdControl
from shmmap.daemon.transport.inbox import Inbox
from shmmap.daemon.transport.watched_descriptors import WatchedDescriptors
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["ServingLoop"]

SERVE_S: Final = 0.002
"""How long requests are served before the loop looks at everything else."""


class ServingLoop:
    """Serves one map until told to stop.

    Parameters
    ----------
    socket
        Bound ROUTER socket; closed by the caller.
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        watched: WatchedDescriptors,
        inbox: Inbox,
        dispatch: Dispatch,
        operators: OperatorRequests,
        cells: CellRequests,
        cache: CellCache,
        scheduler: Scheduler,
        crowd: CrowdControl,
        sampler: Sampler,
        statistics: StatisticsWriter,
    ) -> None:
        self._socket = socket
        self._watched = watched
        self._inbox = inbox
        self._dispatch = dispatch
        self._operators = operators
        self._cells = cells
        self._cache = cache
        self._scheduler = scheduler
        self._crowd = crowd
        self._sampler = sampler
        self._statistics = statistics
        self._answer_at_end = True
        self.stopping = False
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        self._poller.register(watched.fd, zmq.POLLIN)

    def stop(self, *, answer: bool = True) -> None:
        """Leave the loop after this turn; without ``answer`` those who wait are left to the next life."""
        self.stopping = True
        self._answer_at_end = answer

    def run(self) -> None:
        """Serve until `stop`; then answer those who still wait."""
        while not self.stopping:
            self._turn(self._poller.poll(self._patience_ms()))

    def answer_waiting(self) -> None:
        """Answer those who still wait, unless they are left to the next life."""
        if self._answer_at_end:
            self._cells.answer_all(time.monotonic())
            while not self._cache.survey.idle:
                self._cache.survey.step()

    def _patience_ms(self) -> int:
        """How long nothing has to be done if nothing comes."""
        if len(self._inbox) or not self._crowd.idle:
            return 0
        until_s = min(
            self._scheduler.next_event_s(),
            self._cells.next_deadline_s(),
            self._sampler.next_s,
            self._cache.survey.next_step_s,
        )
        wait_s = min(max(0.0, until_s - time.monotonic()), BEAT_S)
        return -int(-wait_s * 1000 // 1)

    def _turn(self, ready: list[tuple[object, int]]) -> None:
        for source, _events in ready:
            if source is not self._socket:
                for fd, _mask in self._watched.poll(0):
                    callback = self._watched.callbacks.get(fd)
                    if callback is not None:
                        callback()
        self._cache.tell_all()
        self._serve()
        self._look_after_the_rest(time.monotonic())
        self._scheduler.pump(time.monotonic())
        self._cache.tell_all()

    def _serve(self) -> None:
        """Hear everybody, serve those whose turn it is; for a bounded time."""
        start_s = time.monotonic()
        end_s = start_s + SERVE_S
        more = True
        while start_s < end_s:
            more = more and self._inbox.hear()
            heard = self._inbox.take()
            if heard is None:
                if not more:
                    return
                continue
            self._dispatch.handle(heard)
            now_s = time.monotonic()
            self._inbox.served(heard, now_s - start_s)
            self._statistics.add_duration("request", int((now_s - start_s) * 1e9))
            start_s, more = now_s, True

    def _look_after_the_rest(self, now_s: float) -> None:
        """What has its own time: deadlines, surveys, overload, statistics."""
        self._scheduler.lost.end_overdue(now_s)
        self._cells.answer_overdue(now_s)
        self._cache.survey.turn(now_s)
        self._crowd.step()
        self._sampler.turn(now_s)
        if now_s >= self._operators.stop_by_s:
            self.stop()
