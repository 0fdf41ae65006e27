# SPDX-License-Identifier: Apache-2.0
"""More time for a start that takes long: the files of ten million cells are looked at for minutes.

systemd ends a service that is not ready after ``TimeoutStartSec``, and starts it again: it would never be
ready.  ``EXTEND_TIMEOUT_USEC`` (sd_notify(3)) asks for more.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final

__all__ = ["MoreTime"]

EVERY_S: Final = 20.0
MORE_S: Final = 60.0
MOST_S: Final = 3600.0
"""Whoever takes longer hangs; to be started again may help."""


class MoreTime:
    """While its ``with`` block runs, a thread asks the service manager for more time.

    Parameters
    ----------
    tell
        Sends lines ``KEY=value``.
    what
        What takes so long, for the status line.
    every_s
        How often.
    """

    def __init__(self, tell: Callable[..., None], what: str, every_s: float = EVERY_S) -> None:
        self._tell = tell
        self._what = what
        self._every_s = every_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask, name="more time", daemon=True)

    def __enter__(self) -> MoreTime:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        try:
            self._thread.start()  # signals are for who reads the map: a stop must interrupt that
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def _ask(self) -> None:
        end_s = time.monotonic() + MOST_S
        while not self._over.wait(self._every_s) and time.monotonic() < end_s:
            self._tell(f"STATUS={self._what}", f"EXTEND_TIMEOUT_USEC={int(MORE_S * 1e6)}")
