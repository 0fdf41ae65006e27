# SPDX-License-Identifier: Apache-2.0
"""Asks, in a thread, whether an origin elsewhere has another version, and whether it is back in reach."""

from __future__ import annotations

import contextlib
import math
import os
import random
import threading
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from shmmap.errors import Offline, ShmmapError
from shmmap.logfmt import log

__all__ = ["LinkNews", "OriginLink"]

PROBE_S: Final = 1.0
"""How often an origin that is out of reach is asked."""
JITTER: Final = 0.2
"""Of the time between two questions: a fleet must not ask all at once."""
LONG_TRUST_S: Final = 32.0
"""Most time that an origin which answers is not doubted for single things that cannot be fetched."""
END_S: Final = 0.5


class LinkNews(NamedTuple):
    """What was found since the last time: another version is there; the origin answers again."""

    changed: bool
    back: bool


class OriginLink:
    """One origin, as it answers.

    Parameters
    ----------
    ask
        Asks it whether there is another version than the one that was taken last; raises `Offline`.
    poll_s
        How often, seconds; 0: only to find out whether it answers again.

    Attributes
    ----------
    fd
        Readable when there are news: call `take` then.
    """

    def __init__(self, ask: Callable[[], bool], poll_s: float) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._ask = ask
        self._poll_s = poll_s
        self._condition = threading.Condition()
        self._is_out = self._is_doubted = self._has_failed = False
        self._answered_s = -math.inf
        self._trust_s = PROBE_S
        self._changed = self._back = False
        self._closed = self._now = False
        self._thread: threading.Thread | None = None
        if poll_s:
            self._start()

    @property
    def is_out(self) -> bool:
        """Whether it did not answer when it was last asked for anything."""
        return self._is_out

    @property
    def is_doubted(self) -> bool:
        """Whether it may be out of reach, or is: it is being asked."""
        return self._is_out or self._is_doubted

    def doubt(self) -> None:
        """Something could not be fetched: find out whether anything can.  May be called in any thread.

        Where it just has answered, that one thing is what cannot be fetched: it is asked again later.
        """
        with self._condition:
            if self.is_doubted or self._closed:
                return
            self._is_doubted = True
            if time.monotonic() >= self._answered_s + self._trust_s:
                self._is_out = True
                os.eventfd_write(self.fd, 1)
            self._start()
            self._condition.notify()

    def ask_now(self) -> None:
        """Ask without waiting for the next time."""
        with self._condition:
            self._now = True
            self._start()
            self._condition.notify()

    def take(self) -> LinkNews:
        """Return what was found since the last time."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        with self._condition:
            news = LinkNews(self._changed, self._back)
            self._changed = self._back = False
        return news

    def _start(self) -> None:
        if self._thread is None:
            thread = threading.Thread(target=self._run, name="origin", daemon=True)
            with contextlib.suppress(RuntimeError):  # as many threads as there may be: at the next doubt
                thread.start()
                self._thread = thread

    def _run(self) -> None:
        asked_s = -math.inf if self._is_out else time.monotonic()
        while True:
            wait_s = self._poll_s * random.uniform(1 - JITTER, 1 + JITTER)  # noqa: S311  no secret
            with self._condition:
                while not self._closed:
                    due_s, now_s = self._due_s(asked_s, wait_s), time.monotonic()
                    if now_s >= due_s or self._now:
                        break
                    self._condition.wait(min(due_s - now_s, threading.TIMEOUT_MAX))
                if self._closed:
                    return
                self._now = False
            asked_s = time.monotonic()
            self._look()

    def _due_s(self, asked_s: float, wait_s: float) -> float:
        if self._is_out:
            return asked_s + PROBE_S
        if self._is_doubted:
            return self._answered_s + self._trust_s
        return asked_s + (wait_s or math.inf)

    def _look(self) -> None:
        reason = ""
        try:
            changed, answers = self._ask(), True
        except Offline as error:
            changed, answers, reason = False, False, error.message
        except ShmmapError as error:
            log.error("the map's origin names no usable version", reason=error)
            changed, answers = False, True
        except Exception:  # noqa: BLE001  else it would never be asked again
            log.exception("the map's origin cannot be asked", cause="a defect in shmmap")
            changed, answers, reason = False, False, "a defect in shmmap"
        with self._condition:
            if answers:
                self._note_answer(time.monotonic())
            elif not self._has_failed:
                log.warning("the map's origin is out of reach", reason=reason)
            self._has_failed = self._is_out = not answers
            self._is_doubted = False
            self._changed = self._changed or changed
            os.eventfd_write(self.fd, 1)

    def _note_answer(self, now_s: float) -> None:
        self._back = self._back or self.is_doubted
        if self._has_failed:
            log.info("the map's origin answers again")
        if self._has_failed or now_s > self._answered_s + LONG_TRUST_S:
            self._trust_s = PROBE_S
        elif self.is_doubted:  # it answers, and yet something cannot be fetched
            self._trust_s = min(2 * self._trust_s, LONG_TRUST_S)
        self._answered_s = now_s

    def close(self) -> bool:
        """End the thread; False if it still waits for the origin."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(END_S)
        return self._thread is None or not self._thread.is_alive()
