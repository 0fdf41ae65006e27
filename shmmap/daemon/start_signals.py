# SPDX-License-Identifier: Apache-2.0
"""Signals that arrive while the daemon starts."""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import Iterator
from typing import Final

__all__ = ["STOP_SIGNALS", "StartSignals", "ignore_signals"]

_log = logging.getLogger(__name__)

STOP_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)


class StartSignals:
    """Signals while the daemon starts: stop means unwinding at once, a reload waits until it serves.

    Masks would not do: they are a thread's, and libraries have threads of their own.
    """

    def __init__(self) -> None:
        self.reload_wanted = False
        self._held = False
        self._stop = False
        for number in STOP_SIGNALS:
            signal.signal(number, self._on_stop)
        signal.signal(signal.SIGHUP, self._on_reload)

    def _on_reload(self, number: int, frame: object) -> None:
        del number, frame
        self.reload_wanted = True

    def _on_stop(self, number: int, frame: object) -> None:
        del frame
        if not self._stop:
            _log.info("stopping on %s, before serving", signal.Signals(number).name)
        self._stop = True
        if not self._held:
            raise SystemExit(0)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep a stop for later while something takes a name and has nobody yet to take it away."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        if self._stop:
            raise SystemExit(0)


def ignore_signals() -> None:
    """From here on nothing stops the process but its own end."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
