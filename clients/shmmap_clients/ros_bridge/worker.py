# SPDX-License-Identifier: Apache-2.0
"""Workers that answer requests with data of the daemon, each in its own thread, with turns of clients.

A ROS client waits without bound, and takes an empty answer for a result.  So requests are kept while the
daemon is away or their cells are loading, and tried again after its next event, unless the client has left.
Meanwhile other requests are answered.  A request that the daemon refuses is logged and gets an empty answer.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, Final

from shmmap import ShmmapError
from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.messages import ready_made
from shmmap_clients.ros_bridge.service_server import Listening, Request
from shmmap_clients.ros_cells import LATER, StillLoading

MAX_PER_CLIENT: Final = 4
"""Largest number of waiting requests of one client; rclcpp nodes send one at a time."""
MAX_WAITING: Final = 1024
_AGAIN_S: Final = 0.2
_PAUSES: Final = 2.0
"""Pause after attempts in vain, as a multiple of their time: other requests come first."""


class WaitingRequests:
    """Fair queue for one thread: clients take turns; one that waits comes behind all others."""

    def __init__(self) -> None:
        self._of: OrderedDict[str, deque[Request]] = OrderedDict()  # by client, the next one first

    def __len__(self) -> int:
        return sum(map(len, self._of.values()))

    def put(self, request: Request) -> bool:
        """Append a request; return False if the queue is full.  Drop a client's oldest above its limit."""
        mine = self._of.setdefault(request.requester.name, deque())
        if len(mine) >= MAX_PER_CLIENT:
            mine.popleft()
        elif len(self) >= MAX_WAITING:
            return False
        mine.append(request)
        return True

    def put_back(self, request: Request) -> None:
        """Put back a request that was taken before those of its client that wait; drop it above the limit."""
        mine = self._of.setdefault(request.requester.name, deque())
        if len(mine) < MAX_PER_CLIENT:
            mine.appendleft(request)

    def get(self) -> Request:
        """Take the next request; the queue must not be empty."""
        name, mine = self._of.popitem(last=False)
        request = mine.popleft()
        if mine:
            self._of[name] = mine
        return request


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
        self._later: list[Request] = []  # tried in vain, the oldest first
        self._again_s = self._pause_s = 0.0
        self._stop = stop
        self._every_s = every_s
        self._log = log
        self._away = ""

    @abstractmethod
    def answer(self, message: Any, request: Request) -> Content:
        """Return a reply."""

    @abstractmethod
    def empty(self, message: Any) -> Content:
        """Return the empty reply."""

    @abstractmethod
    def tick(self) -> None:
        """Run the periodic task."""

    def notify(self) -> None:
        """Try requests again that wait for the daemon; any thread may call this."""
        self._again_s = min(self._again_s, self._pause_s)
        self.listening.wake()

    def run(self) -> None:
        """Work until the program ends."""
        next_s = 0.0
        while not self._stop.is_set():
            if time.monotonic() >= next_s:
                self._guarded_tick()
                next_s = time.monotonic() + self._every_s
            if not self._waiting:
                until_s = min(next_s, self._again_s) if self._later else next_s
                self.listening.wait(until_s - time.monotonic())
            for one in self.listening.take():
                if not self._waiting.put(one):
                    self._log(f"{one.server.name}: too many requests wait: one is dropped")
            if self._later and time.monotonic() >= self._again_s:
                for one in reversed(self._later):
                    self._waiting.put_back(one)
                self._later.clear()
            if self._waiting:
                self._serve(self._waiting.get())

    def _serve(self, request: Request) -> None:
        server = request.server
        if request.was_tried and server.gone(request):
            return
        began_s = time.monotonic()
        request.begun_s = request.begun_s or began_s
        try:
            content = self.answer(request.message, request)
            self._back()
        except StillLoading as why:
            self._back()
            if str(why) and not request.is_logged:
                self._log(f"{server.name}: a request waits: {why}")
                request.is_logged = True
            self._try_later(request, began_s)
            return
        except LATER as error:
            self._gone(error)
            request.begun_s = 0.0  # restart the timeout of cells when the daemon is back
            self._try_later(request, time.monotonic())
            return
        except (ShmmapError, ValueError) as error:
            self._log(f"{server.name}: answered with nothing: {error}")
            content = self.empty(request.message)
        if server.present(request) and (why_not := server.reply(ready_made(server.kind.reply, content))):
            self._log(f"{server.name}: an answer of {len(content)} bytes was not sent: {why_not}")

    def _try_later(self, request: Request, began_s: float) -> None:
        request.was_tried, now_s = True, time.monotonic()
        self._pause_s = max(self._pause_s, now_s) + _PAUSES * (now_s - began_s)
        if not self._later:
            self._again_s = self._pause_s + _AGAIN_S
        self._later.append(request)

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
        if self._away:
            self._away = ""
            self._log("requests are answered again")
