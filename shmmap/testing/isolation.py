# SPDX-License-Identifier: Apache-2.0
"""Daemons for one test: started as it wants them, and judged from outside when it is over."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from shmmap.errors import InternalError
from shmmap.testing.daemon_process import DaemonProcess
from shmmap.testing.process_watch import open_files

__all__ = ["isolated_daemons"]

_Daemon = TypeVar("_Daemon", bound=DaemonProcess)


@contextlib.contextmanager
def isolated_daemons(kind: type[_Daemon]) -> Iterator[Callable[..., _Daemon]]:
    """Hand out daemons, ``make(map_path, *options, environment=..., shm_dir=..., start=True)``.

    At the end each one still running gets SIGTERM and must exit 0 and leave no name, no socket, no
    process, no temporary file (one that was killed and not started again is judged by its processes
    alone); and this process must have no more open files than before.

    Parameters
    ----------
    kind
        `DaemonProcess`, or a class made of it.

    Raises
    ------
    InternalError
        At the end: something was left behind; the message names it and holds the daemon's log.
    """
    before = open_files()
    started: list[_Daemon] = []

    def make(map_path: str | os.PathLike[str], *options: str, start: bool = True, **more: Any) -> _Daemon:
        one = kind(map_path, *options, **more)
        started.append(one)
        return one.start() if start else one

    try:
        yield make
    finally:
        problems: list[str] = []
        for one in reversed(started):  # a later one may live in an earlier one's directory
            problems += _end(one)
    gc.collect()
    problems += [
        f"descriptor {fd} -> {target}"
        for fd, target in open_files().items()
        if fd not in before and not target.startswith("/dev/null")
    ]
    if problems:
        raise InternalError("left behind:\n" + "\n".join(problems))


def _end(one: DaemonProcess) -> list[str]:
    """Stop a daemon and remove all it had; returns what it should not have left."""
    problems = []
    try:
        if one.process is not None and (code := one.stop()) != 0:
            problems.append(f"the daemon's exit code is {code}")
        problems += one.leftovers()
        return [*problems, one.log] if problems else []
    finally:
        one.dispose()
