# SPDX-License-Identifier: Apache-2.0
"""Waiting for processes without asking again and again, and finding those that somebody started."""

from __future__ import annotations

import contextlib
import os
import select
from collections.abc import Sequence
from pathlib import Path

__all__ = ["open_files", "processes_marked", "wait_ended", "wait_readable"]


def wait_readable(fds: Sequence[int], timeout_s: float) -> list[int]:
    """Wait until one of the descriptors is readable; returns those that are, none after ``timeout_s``."""
    poller = select.poll()
    for fd in fds:
        poller.register(fd, select.POLLIN)
    return [fd for fd, _ in poller.poll(max(0.0, timeout_s) * 1000)]


def wait_ended(pid: int, timeout_s: float = 30.0) -> bool:
    """Wait until a process has ended; True if it has."""
    try:
        fd = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(wait_readable([fd], timeout_s))
    finally:
        os.close(fd)


def processes_marked(mark: str, variable: str = "SHMMAP_TEST_RUN") -> list[int]:
    """Ids of the living processes that were started with ``variable=mark`` in their environment."""
    wanted = f"{variable}={mark}".encode()
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                if wanted in Path(f"/proc/{entry}/environ").read_bytes().split(b"\0"):
                    found.append(int(entry))
            except OSError:  # gone by now, or somebody else's
                continue
    return found


def open_files() -> dict[int, str]:
    """Descriptors of this process and what they refer to."""
    found = {}
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # the one that lists the directory
            found[int(entry)] = os.readlink(f"/proc/self/fd/{entry}")
    return found
