# SPDX-License-Identifier: Apache-2.0
"""Workers that answer requests with data of the daemon, each in its own thread, with turns of clients.

A ROS client waits without bound. So requests are kept while the daemon is away, and answered when it is back,
unless the client has left. A request that takes long, or fails while others succeed, is put behind those of
other clients, and dropped after some attempts. A request that the daemon refuses is logged and gets an empty
answer. One whose answer is too large gets none, because the client would take an empty answer for a result.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Final

from shmmap import BadRequest, DaemonUnreachable, ShmmapError, StaleHandle
from shmmap.errors import Busy, LiveInterrupted, NoSession
from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.service_server import Listening, Request

__all__ = [
    "MAX_PER_CLIENT",
    "MAX_WAITING",
    "StillLoading",
    "TooLarge",
    "WaitingRequests",
    "Worker",
    "no_followup",
]

MAX_PER_CLIENT: Final = 4
"""Largest number of waiting requests of one client; rclcpp nodes send one at a time."""
MAX_WAITING: Final = 1024
LATER: Final = (DaemonUnreachable, NoSession, Busy, LiveInterrupted, StaleHandle)
"""Temporary errors, after which a request is tried again."""
_AGAIN_S: Final = 0.2
_MAX_FAILED: Final = 5
"""Failed attempts at one request, while the daemon answers others, before it is dropped."""
Answer = tuple[Content, Callable[[], None]]


class WaitingRequests:
    """Fair queue for one thread; each round has one request of each waiting client."""

    def __init__(self) -> None:
        self._queue: OrderedDict[int, tuple[int, Request]] = OrderedDict()  # with the round, by number
        self._of: dict[str, list[int]] = {}  # numbers by client, oldest first
        self._next = self._round = 0

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, request: Request) -> bool:
        """Append a request; return False if the queue is full.  Drop a client's oldest above its limit."""
        mine = self._of.get(request.requester.name, ())
        if len(mine) >= MAX_PER_CLIENT:
            self._forget(mine[0])
        if len(self._queue) >= MAX_WAITING:
            return False
        last = self._queue[mine[-1]][0] + 1 if mine else self._round
        self._append(max(last, self._round), request)
        return True

    def requeue(self, request: Request) -> None:
        """Put back a request that could not be answered yet, behind every other client."""
        self._append(self._round + 1, request)

    def get(self) -> Request:
        """Take the next request; the queue must not be empty."""
        number = min(self._queue, key=lambda one: (self._queue[one][0], one))
        self._round = self._queue[number][0]
        return self._forget(number)

    def _append(self, turn: int, request: Request) -> None:
        self._next += 1
        self._queue[self._next] = turn, request
        self._of.setdefault(request.requester.name, []).append(self._next)

    def _forget(self, number: int) -> Request:
        _, request = self._queue.pop(number)
        name = request.requester.name
        self._of[name].remove(number)
        if not self._of[name]:
            del self._of[name]
        return request


def no_followup() -> None:
    """Do nothing after an answer has been sent."""


class StillLoading(Exception):
    """Cells are still being loaded: other clients' requests come first."""


class TooLarge(BadRequest):
    """The requested data do not fit into one answer."""


class Worker(ABC):
    """Thread that answers requests and runs a periodic task.

    Parameters
    ----------
    listening
        Source of requests, for this worker only.
    stop
        Set when the program ends.
    every_s
        Interval of calls of `tick`, seconds.
    log
        Called with a line about each problem and its end.
    """

    def __init__(
        self, listening: Listening, stop: threading.Event, every_s: float, log: Callable[[str], None]
    ) -> None:
        self.listening = listening
        self._waiting = WaitingRequests()
        self._stop = stop
        self._every_s = every_s
        self._log = log
        self._away = ""
        self._answered = 0

    @abstractmethod
    def answer(self, message: Any, request: Request) -> Answer:
        """Return a reply, and a function to call once the reply has been sent."""

    @abstractmethod
    def empty(self, message: Any) -> Content:
        """Return the empty reply."""

    @abstractmethod
    def tick(self) -> None:
        """Run the periodic task."""

    def run(self) -> None:
        """Work until the program ends."""
        next_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            if now_s >= next_s:
                self._guarded_tick()
                next_s = time.monotonic() + self._every_s
            if not self._waiting:
                self.listening.wait(next_s - time.monotonic())
            for one in self.listening.take():
                if not self._waiting.put(one):
                    self._log(f"{one.server.name}: too many requests wait: one is dropped")
            if self._waiting:
                self._serve(self._waiting.get())

    def _serve(self, request: Request) -> None:
        server = request.server
        if request.was_requeued and server.gone(request):
            return
        request.begun_s = request.begun_s or time.monotonic()
        try:
            content, done = self.answer(request.message, request)
            self._back()
        except StillLoading:
            self._back()
            self._try_again(request)
            return
        except LATER as error:
            self._gone(error)
            if self._has_failed(request):
                self._log(f"{server.name}: not answered after {request.failed} tries: {error}")
                return
            request.begun_s = 0.0  # restart the timeout of cells when the daemon is back
            self._try_again(request)
            self._stop.wait(_AGAIN_S)
            return
        except TooLarge as error:
            self._log(f"{server.name}: not answered: {error}")
            return
        except (ShmmapError, ValueError) as error:
            self._log(f"{server.name}: answered with nothing: {error}")
            content, done = self.empty(request.message), no_followup
        if server.present(request):
            why = server.reply(content)
            if why:
                self._log(f"{server.name}: an answer of {len(content)} bytes was not sent: {why}")
            else:
                done()

    def _try_again(self, request: Request) -> None:
        request.was_requeued = True
        self._waiting.requeue(request)

    def _has_failed(self, request: Request) -> bool:
        """Return whether the request fails by itself, not because the daemon is away."""
        if self._answered > request.answers:
            request.answers = self._answered
            request.failed += 1
        return request.failed >= _MAX_FAILED

    def _guarded_tick(self) -> None:
        try:
            self.tick()
            self._back()
        except LATER as error:
            self._gone(error)
        except ShmmapError as error:
            self._log(str(error))

    def _gone(self, error: ShmmapError) -> None:
        if not self._away:
            self._away = error.message
            self._log(f"requests wait: {error.message}")

    def _back(self) -> None:
        self._answered += 1
        if self._away:
            self._away = ""
            self._log("requests are answered again")
