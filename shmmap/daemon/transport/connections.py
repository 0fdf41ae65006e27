# SPDX-License-Identifier: Apache-2.0
"""The connections themselves, which libzmq hides: whose they are, what queues on them, ending one.

A connection is a descriptor of this process whose name is the request socket's.  The kernel says who
is at the other end (SO_PEERCRED), how much of what was sent has not been read there (SIOCOUTQ), and
how much has come here that libzmq has not taken yet (FIONREAD).  Descriptor numbers are used again,
so every look goes through a duplicate: what was looked at is what is ended.
"""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import termios
from collections import Counter
from collections.abc import Callable, Collection
from typing import Final, TypeVar

from shmmap.daemon.transport.own_sockets import looked_at, open_descriptors

__all__ = ["Census", "end_connection", "unread_bytes"]

T = TypeVar("T")

LOOKS_AT_ONCE: Final = 64
"""Descriptors looked at per step: about half a millisecond."""
_CREDENTIALS: Final = struct.Struct("iII")  # struct ucred: pid, uid, gid


def end_connection(fd: int, pid: int, paths: Collection[str]) -> bool:
    """End a connection, if it still is one of that process; libzmq then forgets it by itself."""

    def end(view: socket.socket) -> bool:
        view.shutdown(socket.SHUT_RDWR)
        return True

    return bool(_of_connection(fd, paths, pid, end))


def unread_bytes(fd: int, pid: int, paths: Collection[str]) -> int | None:
    """Bytes in the kernel that the process has not read; None if this is no connection of it."""
    return _of_connection(fd, paths, pid, lambda view: _queued(view, termios.TIOCOUTQ))


def _of_connection(fd: int, paths: Collection[str], pid: int, look: Callable[[socket.socket], T]) -> T | None:
    try:
        with looked_at(fd) as view:
            return look(view) if _peer_pid(view, paths) == pid else None
    except OSError:
        return None  # it is closed already


def _peer_pid(view: socket.socket, paths: Collection[str]) -> int | None:
    """Process at the other end, 0 where it is not visible; None if this is no connection of ours."""
    if view.family != socket.AF_UNIX or view.getsockname() not in paths:
        return None
    if view.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
        return None
    credentials = view.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[0])


def _queued(view: socket.socket, request: int) -> int:
    return int(struct.unpack("i", fcntl.ioctl(view.fileno(), request, bytes(4)))[0])


class Census:
    """Counts connections by process, bit by bit.

    Parameters
    ----------
    paths
        Where the daemon listens.

    Attributes
    ----------
    connections : dict
        Per process (0: not visible), the descriptors of its connections.
    arriving : Counter
        Per process, bytes that had come and were not taken yet.
    """

    def __init__(self, paths: Collection[str]) -> None:
        self._paths = paths
        self._left = open_descriptors()
        self.connections: dict[int, list[int]] = {}
        self.arriving: Counter[int] = Counter()

    def step(self) -> bool:
        """Look at some descriptors; True when all have been looked at."""
        for fd in self._left[:LOOKS_AT_ONCE]:
            self._look(fd)
        del self._left[:LOOKS_AT_ONCE]
        return not self._left

    def _look(self, fd: int) -> None:
        # a descriptor that is no socket, or closed by now, is none of ours
        with contextlib.suppress(OSError), looked_at(fd) as view:
            pid = _peer_pid(view, self._paths)
            if pid is not None:
                self.connections.setdefault(pid, []).append(fd)
                self.arriving[pid] += _queued(view, termios.FIONREAD)
