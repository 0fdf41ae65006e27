# SPDX-License-Identifier: Apache-2.0
"""Interface to the service manager (systemd): reports to it, and the socket that it passes.

Only the serving loop feeds the watchdog, so that a loop that hangs is noticed.  During a reload the service
is "reloading": systemd expects RELOADING=1 with MONOTONIC_USEC (newer versions fail the reload without it),
and READY=1 at the end.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from typing import Final, NamedTuple

from shmmap.errors import ConfigError

STATUS_EVERY_S: Final = 2.0
"""Minimum time between status lines: each one wakes programs that listen to the service manager."""

_MAX_PENDING: Final = 8  # changes of state; the newest say all


def notify(*lines: str) -> bool:
    """Send ``KEY=value`` lines to ``NOTIFY_SOCKET`` (sd_notify(3)), if it is set.

    A line break in a value (a path may contain one) becomes a blank, since it would start another line.

    Returns
    -------
    bool
        False if the service manager has so much unread that sending would block: it may hang, the daemon
        may not.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return True
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
    try:
        with socket.socket(socket.AF_UNIX, kind) as channel:
            text = "\n".join(line.replace("\n", " ") for line in lines)
            channel.sendto(text.encode(errors="replace"), re.sub("^@", "\0", address))
    except BlockingIOError:
        return False
    except OSError:
        pass  # there is no such service manager
    return True


def watchdog_interval_s(environ: Mapping[str, str]) -> float:
    """Return the seconds between two watchdog messages; infinity if the service manager expects none.

    A third of ``WATCHDOG_USEC``: sd_watchdog_enabled(3) recommends at most half of it, and one message may be
    late.
    """
    text, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
    if not text.isdigit() or int(text) <= 0 or (pid and pid != str(os.getpid())):
        return math.inf
    return int(text) * 1e-6 / 3


def status_line(
    *, resident: int, cells: int, used_bytes: int, budget_bytes: int, clients: int, failed: int
) -> str:
    """Return the text for ``systemctl status``: ``"212 of 4096 cells, 3.1 of 6.0 GiB, 5 clients"``."""
    unit, name = (1 << 30, "GiB") if budget_bytes >= 1 << 30 else (1 << 20, "MiB")
    line = (
        f"{resident} of {cells} cells, {used_bytes / unit:.1f} of {budget_bytes / unit:.1f} {name},"
        f" {clients} client{'' if clients == 1 else 's'}"
    )
    return f"{line}, {failed} failed load{'' if failed == 1 else 's'}" if failed else line


class ServiceManager:
    """Reports to the service manager, if there is one.

    Parameters
    ----------
    environ
        Environment of this process: ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are used.
    send
        Sends ``KEY=value`` lines; returns False where that would block.

    Attributes
    ----------
    starts_again : bool
        Whether this process is a service of systemd's, which starts it again after a failure.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ, send: Callable[..., bool] = notify) -> None:
        self._send = send
        self._feed_every_s = watchdog_interval_s(environ)
        self._feed_at_s = 0.0 if math.isfinite(self._feed_every_s) else math.inf
        self._status = ""
        self._status_s = -math.inf
        self._reloads = 0
        self._pending: deque[tuple[str, ...]] = deque(maxlen=_MAX_PENDING)
        self.starts_again = bool(environ.get("NOTIFY_SOCKET")) and bool(environ.get("INVOCATION_ID"))

    def ready(self, status: str) -> None:
        """Report that serving starts."""
        self._report("READY=1", f"STATUS={status}", f"MAINPID={os.getpid()}")

    def beat(self, now_s: float, status: Callable[[], str]) -> None:
        """Feed the watchdog and send a new status line; the serving loop calls it a few times a second."""
        if not self._report():
            return
        if now_s >= self._feed_at_s and self._send("WATCHDOG=1"):
            self._feed_at_s = now_s + self._feed_every_s
        if not self._reloads and now_s - self._status_s >= STATUS_EVERY_S:
            self._status_s = now_s
            line = status()
            if line != self._status and self._send(f"STATUS={line}"):
                self._status = line

    def _report(self, *lines: str) -> bool:
        """Send a change of state after those that could not be sent; return whether none is left."""
        if lines:
            self._pending.append(lines)
        while self._pending and self._send(*self._pending[0]):
            self._pending.popleft()
        return not self._pending

    def reloading(self) -> None:
        """Report that a reload has begun; each call is followed by one of `reloaded`."""
        self._reloads += 1
        now_us = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        self._report("RELOADING=1", f"MONOTONIC_USEC={now_us}", "STATUS=reading the map again")

    def reloaded(self, outcome: str) -> None:
        """Report that a reload has ended, successful or not; ready once no other reload runs."""
        self._reloads -= 1
        self._status = ""
        if not self._reloads:
            self._report("READY=1", f"STATUS={outcome}")

    def stopping(self, why: str) -> None:
        """Report that the daemon stops serving."""
        self._report("STOPPING=1", f"STATUS={why}")

    def failed(self, message: str) -> None:
        """Report that the daemon cannot start; the message stays visible in ``systemctl status``."""
        self._send(f"STATUS={message}")


EXTEND_EVERY_S: Final = 20.0
EXTEND_S: Final = 60.0
MAX_START_S: Final = 3600.0
"""Limit of a start: a longer one counts as hanging, and another start may help."""


@contextlib.contextmanager
def asking_for_time(send: Callable[..., bool], what: str, every_s: float = EXTEND_EVERY_S) -> Iterator[None]:
    """Have a thread ask the service manager for more time during the ``with`` block.

    systemd ends a service that is not ready after ``TimeoutStartSec``, and starts it again.  A daemon that
    checks the files of ten million cells, which takes minutes, would never be ready.  ``EXTEND_TIMEOUT_USEC``
    (sd_notify(3)) requests more time.

    Parameters
    ----------
    send
        Sends ``KEY=value`` lines.
    what
        The slow activity, for the status line.
    every_s
        Interval of the requests, seconds.
    """
    over = threading.Event()

    def ask() -> None:
        end_s = time.monotonic() + MAX_START_S
        while not over.wait(every_s) and time.monotonic() < end_s:
            send(f"STATUS={what}", f"EXTEND_TIMEOUT_USEC={int(EXTEND_S * 1e6)}")

    thread = threading.Thread(target=ask, name="more time", daemon=True)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        thread.start()  # signals are for the thread that reads the map: a stop must interrupt it
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield
    finally:
        over.set()
        thread.join()


FIRST_FD: Final = 3  # SD_LISTEN_FDS_START


class ActivatedSocket(NamedTuple):
    """A listening socket and its path."""

    fd: int
    path: str


def take_activated_socket(
    environ: MutableMapping[str, str] = os.environ, *, first_fd: int = FIRST_FD
) -> ActivatedSocket | None:
    """Take over the socket that the service manager passed (sd_listen_fds(3)); None when it passed none.

    The socket outlives the daemon, so clients that connect while it starts or restarts only wait.  Its file,
    owner and mode belong to the service manager, so the daemon never removes it.  The variables are removed,
    so that loaders do not take the socket for theirs.

    Parameters
    ----------
    environ
        Environment; ``LISTEN_PID`` and ``LISTEN_FDS`` are used.
    first_fd
        Number of the first passed descriptor.

    Raises
    ------
    ConfigError
        More than one socket was passed, or the socket is not a listening unix stream socket.
    """
    pid, count = environ.pop("LISTEN_PID", ""), environ.pop("LISTEN_FDS", "")
    environ.pop("LISTEN_FDNAMES", None)
    if pid != str(os.getpid()) or not count.isdigit() or int(count) == 0:
        return None
    for fd in range(first_fd, first_fd + int(count)):
        os.set_inheritable(fd, False)
    if int(count) != 1:
        raise _unusable(f"{count} sockets were passed, one is needed")
    try:
        with socket.socket(fileno=os.dup(first_fd)) as view:
            listens = view.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            kind, family, path = view.type, view.family, view.getsockname()
    except OSError as error:
        raise _unusable(f"descriptor {first_fd} is no socket: {error.strerror}") from error
    if family != socket.AF_UNIX or kind != socket.SOCK_STREAM or not listens:
        raise _unusable("the socket that was passed is no listening unix stream socket")
    if not isinstance(path, str) or not path.startswith("/"):
        raise _unusable(f"the socket that was passed has no path, but {path!r}")
    os.set_blocking(first_fd, False)  # a client may give up between the poll and the accept
    return ActivatedSocket(first_fd, path)


def _unusable(what: str) -> ConfigError:
    return ConfigError(
        f"socket activation: {what}",
        key="endpoint",
        hint="the .socket unit needs exactly one ListenStream= with a path",
    )
