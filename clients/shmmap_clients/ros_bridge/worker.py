# SPDX-License-Identifier: Apache-2.0
"""Workers that answer requests which need the daemon: each in a thread of its own, and clients take turns.

A ROS client waits without bound. So while the daemon is away a request is kept, and answered when it is back,
unless the client has gone meanwhile. One that takes long, or fails while others succeed, waits behind those
of other clients, and is given up after some tries. What the daemon refuses is answered with nothing, and
logged; what is too large is not answered at all, because an answer without cells would be taken for one.
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
from shmmap_clients.ros_bridge.service_server import Listening, Request, Tries

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
"""Of one client: rclcpp nodes have one under way."""
MAX_WAITING: Final = 1024
LATER: Final = (DaemonUnreachable, NoSession, Busy, LiveInterrupted, StaleHandle)
"""Errors that pass by themselves."""
_AGAIN_S: Final = 0.2
_MAX_FAILED: Final = 5
"""Tries of one request that fail while the daemon answers others."""
Answer = tuple[Content, Callable[[], None]]


class WaitingRequests:
    """A queue, for one thread.  Each round has one request of each client that waits."""

    def __init__(self) -> None:
        self._queue: OrderedDict[int, tuple[int, Request]] = OrderedDict()  # by number, with the round
        self._of: dict[str, list[int]] = {}  # numbers by client, the oldest first
        self._next = self._round = 0

    def __len__(self) -> int:
        return len(self._queue)

    def put(self, request: Request) -> bool:
        """Append a request; False if there are too many.  Of one client's the oldest then makes room."""
        mine = self._of.get(request.requester.name, ())
        if len(mine) >= MAX_PER_CLIENT:
            self._forget(mine[0])
        if len(self._queue) >= MAX_WAITING:
            return False
        last = self._queue[mine[-1]][0] + 1 if mine else self._round
        self._append(max(last, self._round), request)
        return True

    def requeue(self, request: Request) -> None:
        """Put back what could not be answered yet: every other client comes first."""
        self._append(self._round + 1, request)

    def get(self) -> Request:
        """Take the request whose turn it is; there has to be one."""
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
    """Do nothing after an answer was sent."""


class StillLoading(Exception):
    """Cells are still being loaded: others' requests come first."""


class TooLarge(BadRequest):
    """No answer can hold what was asked for."""


class Worker(ABC):
    """Answers requests and does what comes up regularly.

    Parameters
    ----------
    listening
        Where requests come, for this worker only.
    stop
        Set when the program ends.
    every_s
        How often `tick` is called.
    log
        Takes a line about what goes wrong, and when it is right again.
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
        """Return the reply that has nothing."""

    @abstractmethod
    def tick(self) -> None:
        """Do what comes up regularly."""

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
        server, tries = request.server, request.tries
        if tries.was_requeued and server.gone(request):
            return
        tries.begun_s = tries.begun_s or time.monotonic()
        try:
            content, done = self.answer(request.message, request)
            self._back()
        except StillLoading:
            self._back()
            self._try_again(request)
            return
        except LATER as error:
            self._gone(error)
            if self._has_failed(tries):
                self._log(f"{server.name}: not answered after {tries.failed} tries: {error}")
                return
            tries.begun_s = 0.0  # cells have all their time when the daemon is back
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
        request.tries.was_requeued = True
        self._waiting.requeue(request)

    def _has_failed(self, tries: Tries) -> bool:
        """Whether it is this request that fails, and not the daemon that is away."""
        if self._answered > tries.answers:
            tries.answers = self._answered
            tries.failed += 1
        return tries.failed >= _MAX_FAILED

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
