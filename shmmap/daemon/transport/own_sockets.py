# SPDX-License-Identifier: Apache-2.0
"""This process's own descriptors, those that a library opened included: which there are, a look at one."""

from __future__ import annotations

import contextlib
import fcntl
import os
import resource
import socket
from collections.abc import Iterator
from typing import Final

__all__ = ["listens", "looked_at", "open_descriptors", "target"]

_DIRECTORY: Final = "/proc/self/fd"


def open_descriptors() -> list[int]:
    """Numbers of the open descriptors, also when none is left to read their directory with."""
    try:
        return [int(name) for name in os.listdir(_DIRECTORY)]
    except OSError:
        return [fd for fd in range(resource.getrlimit(resource.RLIMIT_NOFILE)[0]) if _is_open(fd)]


def _is_open(fd: int) -> bool:
    try:
        fcntl.fcntl(fd, fcntl.F_GETFD)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def looked_at(fd: int) -> Iterator[socket.socket]:
    """Give a socket object on a duplicate of ``fd``; whoever owns it may close it meanwhile.

    Raises
    ------
    OSError
        It is closed, or no socket.
    """
    twin = os.dup(fd)
    try:
        view = socket.socket(fileno=twin)
    except OSError:
        os.close(twin)
        raise
    with view:
        yield view


def target(fd: int) -> str:
    """Return what a descriptor refers to, as the kernel writes it; empty for a closed one."""
    try:
        return os.readlink(f"{_DIRECTORY}/{fd}")
    except OSError:
        return ""


def listens(fd: int) -> bool:
    """Whether this is a Unix socket that accepts connections."""
    if not target(fd).startswith("socket:"):
        return False
    try:
        with looked_at(fd) as view:
            return view.family == socket.AF_UNIX and bool(
                view.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            )
    except OSError:
        return False
