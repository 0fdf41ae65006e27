# SPDX-License-Identifier: Apache-2.0
"""What answers requests that need the daemon: in a thread of its own, and clients take turns.

A ROS client waits for ever. So while the daemon is away a request is kept, and answered when it is back,
unless the client has gone meanwhile. One that takes long, or fails while others succeed, waits behind those
of other clients, and is given up after some tries. What the daemon refuses is answered with nothing, and
logged; what is too large is not answered at all, because an answer without cells would be taken for one.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Final

from shmmap import BadRequest, Busy, DaemonUnreachable, LiveInterrupted, NoSession, ShmmapError, StaleHandle
from shmmap_clients.ros_bridge.cdr import Content
from shmmap_clients.ros_bridge.listening import Listening
from shmmap_clients.ros_bridge.service_server import Request, Tries
from shmmap_clients.ros_bridge.waiting import WaitingRequests

__all__ = ["StillLoading", "TooLarge", "Worker"]

LATER: Final = (DaemonUnreachable, NoSession, Busy, LiveInterrupted, StaleHandle)
"""What passes by itself."""
_AGAIN_S: Final = 0.2
_MOST_FAILED: Final = 5
"""Tries of one request that fail while the daemon answers others."""

Answer = tuple[Content, Callable[[], None]]


class StillLoading(Exception):
    """Cells are still being loaded: others' requests come first."""


class TooLarge(BadRequest):
    """No answer can hold what was asked for."""


class Worker(ABC):
    """Answers requests and does what comes up regularly.

    Parameters
    ----------
    listening
        Where requests come; to nobody else.
    stop
        Set when the program ends.
    every_s
        How often `tick` is called.
    log
        Told what goes wrong, and when it is right again.
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
        """Return a reply, and what to call when it was sent."""

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
        if tries.again and server.gone(request):
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
            content, done = self.empty(request.message), _nothing
        if server.present(request):
            why = server.reply(content)
            if why:
                self._log(f"{server.name}: an answer of {len(content)} bytes was not sent: {why}")
            else:
                done()

    def _try_again(self, request: Request) -> None:
        request.tries.again = True
        self._waiting.again(request)

    def _has_failed(self, tries: Tries) -> bool:
        """Whether it is this request that fails, and not the daemon that is away."""
        if self._answered > tries.answers:
            tries.answers = self._answered
            tries.failed += 1
        return tries.failed >= _MOST_FAILED

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


def _nothing() -> None:
    """Nothing has to be remembered of an answer that has nothing."""
