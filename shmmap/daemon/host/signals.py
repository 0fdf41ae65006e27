# SPDX-License-Identifier: Apache-2.0
"""Signals: their meanings, and their handling while the daemon starts and while it serves."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
from collections.abc import Iterator
from typing import Final

from shmmap.logfmt import log

STOP_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)
KEEP_SIGNAL: Final = signal.SIGUSR1
"""Ends the daemon and leaves the segments to the next run, see `shmmap.daemon.main`."""
RELOAD_SIGNAL: Final = signal.SIGHUP
_libc: Final = ctypes.CDLL(None)  # loaded early: the call must be quick when signals pile up
_ALL: Final = (*STOP_SIGNALS, KEEP_SIGNAL, RELOAD_SIGNAL)


def _belongs_to_terminal() -> bool:
    """Whether a terminal started this process, and neither nohup nor a service manager detached it."""
    if os.getpid() == 1 or "NOTIFY_SOCKET" in os.environ:
        return False
    if os.environ.get("SYSTEMD_EXEC_PID") == str(os.getpid()):
        return False
    return os.isatty(0) and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN


class StartSignals:
    """Signal handling during the start: a stop raises at once, a reload is kept until the daemon serves.

    Signal masks are not enough: they apply to one thread, and libraries have their own threads.

    Attributes
    ----------
    hangup_stops : bool
        Whether SIGHUP means that the daemon's terminal was closed, and stops the daemon.
    """

    def __init__(self) -> None:
        self.hangup_stops = _belongs_to_terminal()
        self.reload_wanted = False
        self.keep = False
        self._held = False
        self._stop = False
        for number in _ALL:
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: object) -> None:
        del frame
        self.keep |= number == KEEP_SIGNAL
        if number == RELOAD_SIGNAL and not self.hangup_stops:
            self.reload_wanted = True
            return
        if not self._stop:
            log.info("stopping", signal=signal.Signals(number).name, during="start")
        self._stop = True
        if not self._held:
            raise SystemExit(0)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Delay a stop while a name is created that nothing would remove yet."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        self.raise_if_stopped()

    def raise_if_stopped(self) -> None:
        """Raise if a stop has arrived that was delayed, or that Python ignored."""
        if self._stop:
            raise SystemExit(0)


class ServingSignals:
    """Signal handling while the daemon serves: the loop reads signals from a descriptor, handlers do nothing.

    Attributes
    ----------
    fd
        Readable when a signal has arrived: call `take` then.
    """

    def __init__(self) -> None:
        self._ours, self._theirs = socket.socketpair()
        self._ours.setblocking(False)
        self._theirs.setblocking(False)
        self.fd = self._ours.fileno()
        for number in _ALL:
            signal.signal(number, lambda *_: None)
        self._before = signal.set_wakeup_fd(self._theirs.fileno(), warn_on_full_buffer=False)

    def take(self) -> list[signal.Signals]:
        """Return the signals since the last call, the announcement of a restart first.

        Of signals pending together, the kernel runs the last one's handler first, so signals read together
        with the announcement were sent after it.
        """
        try:
            numbers = self._ours.recv(64)
        except BlockingIOError:
            return []
        return [signal.Signals(number) for number in sorted(numbers, key=lambda n: n != KEEP_SIGNAL)]

    def close(self) -> None:
        """Stop reading signals."""
        signal.set_wakeup_fd(self._before)
        self._ours.close()
        self._theirs.close()


def ignore_signals() -> None:
    """Ignore the signals that stop the daemon: from here on it exits by itself."""
    numbers = (*STOP_SIGNALS, KEEP_SIGNAL)
    # in the kernel first: Python complains of a signal that arrives while its handler changes
    for number in numbers:
        _libc.signal(number, 1)  # SIG_IGN
    for number in numbers:
        signal.signal(number, signal.SIG_IGN)
