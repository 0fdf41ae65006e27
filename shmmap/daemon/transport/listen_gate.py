# SPDX-License-Identifier: Apache-2.0
"""One connection at a time, and none when descriptors run short.

libzmq accepts connections in a thread of its own, as fast as they come, and *aborts the process* when
``accept`` fails for lack of a descriptor (4.3.5, ``ipc_listener.cpp``: EMFILE is not among the errors
it forgives).  So the listening socket is disarmed in libzmq's own epoll set and armed for exactly
one ``accept`` (EPOLLONESHOT) whenever somebody wants in and a descriptor is to spare.  The kernel
queues the others meanwhile; nothing they do costs the daemon anything.

What ``epoll_ctl`` needs besides the descriptors, libzmq's own pointer, is read from
``/proc/self/fdinfo``.  Where that cannot be read there is no gate, and the log says so.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import re
import resource
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shmmap.daemon.transport.own_sockets import listens, looked_at, open_descriptors, target
from shmmap.logfmt import log

__all__ = ["ListenGate"]

_WATCHED: Final = re.compile(r"^tfd:\s*(\d+) events:\s*[0-9a-f]+ data:\s*([0-9a-f]+)", re.MULTILINE)
LEAST_RESERVE: Final = 48
"""Descriptors kept for the daemon's own work: loaders, segments it looks at, the map."""
PATIENCE_S: Final = 1.0
COUNT_SHARE: Final = 0.05
"""Part of the loop's time that counting descriptors may take."""


class _Event(ctypes.Structure):
    """``struct epoll_event``, packed on x86-64 alone."""

    if platform.machine() == "x86_64":
        _pack_ = 1
    _fields_ = (("events", ctypes.c_uint32), ("data", ctypes.c_uint64))


class ListenGate:
    """Guards every unix socket of this process that listens and that libzmq watches.

    Parameters
    ----------
    watch, unwatch
        Have a callback called from the serving loop while a descriptor is readable, and no longer.

    Attributes
    ----------
    short
        Whether somebody wants in and there is no descriptor to spare.
    """

    def __init__(
        self, watch: Callable[[int, Callable[[], None]], None], unwatch: Callable[[int], None]
    ) -> None:
        self._watch = watch
        self._unwatch = unwatch
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._entries: dict[int, tuple[int, int]] = {}  # listening descriptor: epoll's, libzmq's pointer
        self._room = 0
        self._count_again_s = 0.0
        self.short = False

    def close_behind(self) -> None:
        """Take over whatever listens now; call it once everything is bound.

        libzmq's thread begins to watch a socket a moment after it was bound, and nothing tells when.
        """
        listening = {fd for fd in open_descriptors() if listens(fd)}
        deadline_s = time.monotonic() + PATIENCE_S
        while not self._find(listening) and time.monotonic() < deadline_s:
            time.sleep(0.001)
        if not listening <= self._entries.keys():
            log.warning("connections not limited", reason="/proc/self/fdinfo does not tell of them")
        for fd in self._entries:
            self._arm(fd, 0)
            self._watch(fd, lambda fd=fd: self._knock(fd))  # type: ignore[misc]

    def _find(self, listening: set[int]) -> bool:
        """Look for listening sockets in all epoll sets; True when each was found."""
        for fd in open_descriptors():
            if target(fd) == "anon_inode:[eventpoll]":
                with contextlib.suppress(OSError):
                    text = Path(f"/proc/self/fdinfo/{fd}").read_text()
                    found = {int(watched): int(data, 16) for watched, data in _WATCHED.findall(text)}
                    self._entries.update({one: (fd, found[one]) for one in listening & found.keys()})
        return listening <= self._entries.keys()

    @property
    def paths(self) -> frozenset[str]:
        """Where it listens."""
        return frozenset(_path(fd) for fd in self._entries)

    def release(self) -> None:
        """Let libzmq have its sockets back, before it closes them."""
        for fd in self._entries:
            if not self.short:
                self._unwatch(fd)
        self._entries.clear()

    def _arm(self, fd: int, events: int) -> None:
        epoll, data = self._entries[fd]
        event = _Event(events, data)
        if self._libc.epoll_ctl(epoll, 3, fd, ctypes.byref(event)):  # EPOLL_CTL_MOD
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))

    def _knock(self, fd: int) -> None:
        """Somebody wants in."""
        if self._room <= 0:
            self._count(time.monotonic())
        if self._room > 0:
            self._room -= 1
            self._arm(fd, select.EPOLLIN | select.EPOLLONESHOT)
        else:
            self._shut()

    def _shut(self) -> None:
        """Stop hearing who knocks until there is room again."""
        self.short = True
        for fd in self._entries:
            self._unwatch(fd)

    def look_again(self, now_s: float) -> None:
        """Open again if descriptors came free; called now and then."""
        if self.short:
            self._count(now_s)
            if self._room > 0:
                self.short = False
                for fd in self._entries:
                    self._watch(fd, lambda fd=fd: self._knock(fd))  # type: ignore[misc]

    def _count(self, now_s: float) -> None:
        """Count open descriptors, if that was not done just now.

        Descriptors armed for and not yet accepted count twice for a moment: the gate errs by being
        shut.
        """
        if now_s < self._count_again_s:
            return
        used = len(open_descriptors())
        took_s = time.monotonic() - now_s
        self._count_again_s = now_s + max(0.0, took_s) / COUNT_SHARE
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        # a session takes a second descriptor, the one that tells when its process ends
        self._room = (limit - used - max(LEAST_RESERVE, limit // 16)) // 2


def _path(fd: int) -> str:
    with looked_at(fd) as view:
        return str(view.getsockname())
