# SPDX-License-Identifier: Apache-2.0
"""What systemd hears from the daemon: ready, reloading, one status line, and that it still turns.

The watchdog is fed from the serving loop and from nowhere else, so that a loop that hangs is
noticed.  While a reload runs the service is "reloading": systemd wants RELOADING=1 together with
MONOTONIC_USEC (newer versions fail the reload without it) and READY=1 when it is over.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import socket
import time
from collections.abc import Callable, Mapping
from typing import Final

__all__ = ["ServiceManager", "notify", "status_line", "watchdog_interval_s"]

STATUS_EVERY_S: Final = 2.0
"""Each status line wakes whoever listens to the service manager: not at every beat."""


def notify(*lines: str) -> None:
    """Send ``KEY=value`` lines to ``NOTIFY_SOCKET`` (sd_notify(3)), if there is one.

    A line break inside a value (a path may have one) becomes a blank: it would start another line.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
    ):
        text = "\n".join(line.replace("\n", " ") for line in lines)
        channel.sendto(text.encode(errors="replace"), re.sub("^@", "\0", address))


def watchdog_interval_s(environ: Mapping[str, str]) -> float:
    """Seconds between two signs of life; infinite where nobody waits for them.

    A third of ``WATCHDOG_USEC``: sd_watchdog_enabled(3) recommends half of it at most, and one may
    be late.
    """
    text, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not text.isdigit() or int(text) <= 0 or (pid and pid != str(os.getpid())):
        return math.inf
    return int(text) * 1e-6 / 3


def status_line(
    *, resident: int, cells: int, used_bytes: int, budget_bytes: int, clients: int, failed: int
) -> str:
    """Return what ``systemctl status`` shows: ``"212 of 4096 cells, 3.1 of 6.0 GiB, 5 clients"``."""
    unit, name = (1 << 30, "GiB") if budget_bytes >= 1 << 30 else (1 << 20, "MiB")
    line = (
        f"{resident} of {cells} cells, {used_bytes / unit:.1f} of {budget_bytes / unit:.1f} {name},"
        f" {clients} client{'' if clients == 1 else 's'}"
    )
    return f"{line}, {failed} failed load{'' if failed == 1 else 's'}" if failed else line


class ServiceManager:
    """Speaks to the service manager; says nothing where there is none.

    Parameters
    ----------
    environ
        Of this process: ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` count.
    tell
        Sends lines ``KEY=value``.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ, tell: Callable[..., None] = notify) -> None:
        self._tell = tell
        self._feed_every_s = watchdog_interval_s(environ)
        self._feed_at_s = 0.0 if math.isfinite(self._feed_every_s) else math.inf
        self._status = ""
        self._status_s = -math.inf
        self._reloads = 0

    def ready(self, status: str) -> None:
        """Serving starts."""
        self._tell("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def beat(self, now_s: float, status: Callable[[], str]) -> None:
        """Called from the serving loop a few times a second."""
        if now_s >= self._feed_at_s:
            self._feed_at_s = now_s + self._feed_every_s
            self._tell("WATCHDOG=1")
        if not self._reloads and now_s - self._status_s >= STATUS_EVERY_S:
            self._status_s = now_s
            line = status()
            if line != self._status:
                self._status = line
                self._tell(f"STATUS={line}")

    def reloading(self) -> None:
        """The map is being read again; each call is followed by one of `reloaded`."""
        self._reloads += 1
        now_us = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        self._tell("RELOADING=1", f"MONOTONIC_USEC={now_us}", "STATUS=reading the map again")

    def reloaded(self, outcome: str) -> None:
        """The map was read again, or could not be; ready once no other reload runs."""
        self._reloads -= 1
        self._status = ""
        if not self._reloads:
            self._tell("READY=1", f"STATUS={outcome}")

    def stopping(self, why: str) -> None:
        """Serving ends."""
        self._tell("STOPPING=1", f"STATUS={why}")

    def failed(self, message: str) -> None:
        """Serving cannot start; the message stays visible in ``systemctl status``."""
        self._tell(f"STATUS={message}")
