# SPDX-License-Identifier: Apache-2.0
"""The daemon's side of the process that loaders are forked from (`shmmap.daemon.loading.parent_main`).

Loaders are not children of the daemon: a fork of it would copy its sockets, its map and its threads.  The
first parent is forked from the daemon before it has any of these, so that what both need is imported once; a
replacement is a new process.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
from typing import Final, TypeAlias

from shmmap.daemon.turns import WatchedDescriptors
from shmmap.errors import Replaced
from shmmap.installed import RESTART, is_replaced
from shmmap.logfmt import log
from shmmap.processes.start_child import ForkedProcess, fork_child, how_ended, receive_packet, start_child
from shmmap.version import __version__

Early: TypeAlias = tuple[ForkedProcess, socket.socket]
"""A parent without settings yet, and the channel to it."""

END_TIMEOUT_S: Final = 0.1
"""How long the loop waits for a killed parent to exit; a parent that hangs in the kernel may never do so."""
CLOSE_TIMEOUT_S: Final = 5.0
"""Timeout of the same wait when the daemon stops; long, since the machine may be busy."""


def fork_early() -> Early | None:
    """Fork the first parent from this process, so that the modules both need are imported once.

    Call it before this process has threads, locks, sockets or other state; it returns None if it is too late.
    """
    with contextlib.suppress(OSError):
        return fork_child(_run_parent)
    return None


def _run_parent(fd: int, daemon: int) -> int:
    from shmmap.daemon.loading.parent_main import main  # in the child, while the daemon continues

    for name in ("LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES", "NOTIFY_SOCKET"):
        os.environ.pop(name, None)  # these variables are for the daemon only
    return main([str(fd), str(daemon)])


class PreparedParent:
    """Forks loaders through a parent process.  If the parent ends, its loaders end too, and it is replaced.

    Parameters
    ----------
    settings
        Sent to the parent, see `shmmap.daemon.loading.parent_main.main`.
    watched
        Watches the parent's descriptor.
    early
        The first parent, if it was forked early.

    Attributes
    ----------
    why_not : str
        Why the last parent ended before it was ready; empty if it did not.
    """

    def __init__(
        self, settings: tuple[str, ...], watched: WatchedDescriptors, early: Early | None = None
    ) -> None:
        self.why_not = ""
        self._settings = settings
        self._early = early
        self._watched = watched
        self._process: subprocess.Popen[bytes] | ForkedProcess | None = None
        self._channel: socket.socket | None = None
        self._ready = False
        self._buffer = bytearray(64)

    @property
    def pid(self) -> int:
        """The parent's process id; 0 if there is none."""
        return self._process.pid if self._process is not None else 0

    def start(self) -> None:
        """Start the parent if there is none.

        Raises
        ------
        Replaced
            shmmap was replaced: a parent would be of another version than this daemon.
        OSError
            Not enough processes, memory or descriptors at present.
        """
        if self._channel is None:
            early, self._early = self._early, None
            self._process, self._channel = early or start_child(
                "shmmap.daemon.loading.parent_main", new_session=True
            )
            self._channel.setblocking(False)
            with contextlib.suppress(ConnectionError):  # the parent has ended: `poll` finds out
                self._channel.send(b"\0".join(map(os.fsencode, self._settings)))
            self._watched.watch(self._channel.fileno(), self.poll, "loaders")
            self._ready = False

    def fork(self, end: socket.socket) -> None:
        """Fork a loader whose channel is ``end``.

        Raises
        ------
        Replaced
            shmmap was replaced, and there is no parent.
        OSError
            Not enough processes, memory or descriptors at present.
        """
        self.poll()
        self.start()
        assert self._channel is not None  # noqa: S101  `start` has set it
        socket.send_fds(self._channel, [b"loader"], [end.fileno()])

    def poll(self) -> None:
        """Read whether the parent is ready or has ended; one that was ready is replaced at once."""
        while self._channel is not None:
            try:
                data, _ = receive_packet(self._channel, self._buffer)
            except BlockingIOError:
                return
            except ConnectionResetError:
                continue  # reported once, before the messages that it had sent
            if bytes(data) == __version__.encode():
                self._ready, self.why_not = True, ""
                continue
            was_ready = self._ready
            self.end(RESTART if data else "")
            if was_ready:
                with contextlib.suppress(OSError, Replaced):
                    self.start()
                    log.error("loader parent restarted")

    def close(self) -> None:
        """End the parent, and with it every loader, when the daemon stops."""
        self.end(timeout_s=CLOSE_TIMEOUT_S)

    def end(self, why: str = "", *, timeout_s: float = END_TIMEOUT_S) -> None:
        """End the parent, and with it every loader; ``why`` is a text for people, by default how it ended."""
        if self._channel is None or self._process is None:
            return
        self._watched.unwatch(self._channel.fileno())
        self._channel.close()
        self._channel = None
        self._process.kill()
        try:
            how = how_ended(self._process.wait(timeout_s))
        except subprocess.TimeoutExpired:
            how = "killed, and has not ended yet"
        if not self._ready:
            self.why_not = RESTART if is_replaced() else why or how
        self._process = None
