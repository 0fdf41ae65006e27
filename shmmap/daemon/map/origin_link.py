# SPDX-License-Identifier: Apache-2.0
"""Polls a remote origin in a thread: whether it has another version, and whether it is reachable again."""

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

PROBE_S: Final = 1.0
"""Interval of polling an origin that is unreachable."""
JITTER: Final = 0.2
"""Random part of the polling interval: the vehicles of a fleet must not poll simultaneously."""
LONG_TRUST_S: Final = 32.0
"""Longest delay of a poll after a failed fetch, for an origin that keeps answering."""


class LinkNews(NamedTuple):
    """Results since the last call: another version exists; the origin answers again."""

    changed: bool
    back: bool


class OriginLink:
    """Link to one origin, and whether it answers.

    Parameters
    ----------
    ask
        Polls the origin: whether its version differs from the last one taken; raises `Offline`.
    poll_s
        Polling interval, seconds; 0: poll only to find out whether the origin answers again.

    Attributes
    ----------
    fd
        Readable when there are results: call `take` then.
    is_out : bool
        Whether the origin failed to answer the last poll or fetch.
    """

    def __init__(self, ask: Callable[[], bool], poll_s: float) -> None:
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._ask = ask
        self._poll_s = poll_s
        self._condition = threading.Condition()
        self.is_out = self._is_doubted = self._has_failed = False
        self._answered_s = -math.inf
        self._trust_s = PROBE_S
        self._changed = self._back = False
        self._closed = self._now = False
        self._thread: threading.Thread | None = None
        if poll_s:
            self._start()

    @property
    def is_doubted(self) -> bool:
        """Whether the origin is or may be unreachable, so that it is being polled."""
        return self.is_out or self._is_doubted

    @property
    def is_lost(self) -> bool:
        """Whether the thread that polls has ended although it should run, or could not be started."""
        thread = self._thread
        return not self._closed and (bool(self._poll_s) if thread is None else not thread.is_alive())

    def restart(self) -> None:
        """Start the thread again; until it has polled, the origin counts as unreachable."""
        with self._condition:
            self._thread = None
            self.is_out = True
            os.eventfd_write(self.fd, 1)
            self._start()

    def doubt(self) -> None:
        """Note a failed fetch, and poll whether the origin answers.  May be called in any thread.

        If the origin has just answered, only that object cannot be fetched, and the poll is delayed.
        """
        with self._condition:
            if self.is_doubted or self._closed:
                return
            self._is_doubted = True
            if time.monotonic() >= self._answered_s + self._trust_s:
                self.is_out = True
                os.eventfd_write(self.fd, 1)
            self._start()
            self._condition.notify()

    def ask_now(self) -> None:
        """Poll without waiting for the interval."""
        with self._condition:
            self._now = True
            self._start()
            self._condition.notify()

    def take(self) -> LinkNews:
        """Return the results since the last call."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.fd)
        with self._condition:
            news = LinkNews(self._changed, self._back)
            self._changed = self._back = False
        return news

    def _start(self) -> None:
        if self._thread is None:
            thread = threading.Thread(target=self._run, name="origin", daemon=True)
            with contextlib.suppress(RuntimeError):  # limit of threads reached: start at the next doubt
                thread.start()
                self._thread = thread

    def _run(self) -> None:
        asked_s = -math.inf if self.is_out else time.monotonic()
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
        if self.is_out:
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
        except BaseException:  # noqa: BLE001  also panics of libraries: else the origin would not be polled again
            log.exception("the map's origin cannot be asked", cause="a defect in shmmap")
            changed, answers, reason = False, False, "a defect in shmmap"
        with self._condition:
            if answers:
                self._note_answer(time.monotonic())
            elif not self._has_failed:
                log.warning("the map's origin is out of reach", reason=reason)
            self._has_failed = self.is_out = not answers
            self._is_doubted = False
            self._changed = self._changed or changed
            os.eventfd_write(self.fd, 1)

    def _note_answer(self, now_s: float) -> None:
        self._back = self._back or self.is_doubted
        if self._has_failed:
            log.info("the map's origin answers again")
        if self._has_failed or now_s > self._answered_s + LONG_TRUST_S:
            self._trust_s = PROBE_S
        elif self.is_doubted:  # the origin answers, and yet an object cannot be fetched
            self._trust_s = min(2 * self._trust_s, LONG_TRUST_S)
        self._answered_s = now_s

    def close(self) -> list[threading.Thread]:
        """Have the thread end, and return it, if there is one; it may still wait for the origin."""
        with self._condition:
            self._closed = True
            self._condition.notify()
        return [] if self._thread is None else [self._thread]
