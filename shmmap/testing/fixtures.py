# SPDX-License-Identifier: Apache-2.0
"""Fixtures for pytest, which has to be installed; in the `conftest.py` of one's own tests::

    pytest_plugins = ["shmmap.testing.fixtures"]

and in a test::

    def test_my_program(shmmap_daemon, tmp_path):
        daemon = shmmap_daemon(map_path, "--budget", "64M")
        with shmmap.connect(daemon.endpoint) as client:
            ...

The test fails where the daemon leaves anything behind, or the test itself an open file.
"""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import pytest

from shmmap.errors import InternalError
from shmmap.testing.daemon_process import DaemonProcess
from shmmap.testing.process_watch import open_files

__all__ = ["isolated_daemons", "judged_daemons", "shmmap_daemon"]

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


_Daemon = TypeVar("_Daemon", bound=DaemonProcess)


@pytest.fixture
def shmmap_daemon() -> Iterator[Callable[..., DaemonProcess]]:
    """Start daemons, ``shmmap_daemon(map_path, *options)``, see `isolated_daemons`."""
    yield from judged_daemons(DaemonProcess)


def judged_daemons(kind: type[_Daemon]) -> Iterator[Callable[..., _Daemon]]:
    """Do the work of `shmmap_daemon`, for a fixture with another class of daemons."""
    try:
        with isolated_daemons(kind) as make:
            yield make
    except InternalError as error:
        pytest.fail(str(error), pytrace=False)
