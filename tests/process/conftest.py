# SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests with real daemons: each isolated, each judged from outside when it ends."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.daemon_process import DaemonProcess, open_files
from tests.support.divided_map import DividedMap, make_map
from tests.support.raw_client import RawClient

DaemonFactory = Callable[..., DaemonProcess]


@pytest.fixture
def daemon(request: pytest.FixtureRequest) -> Iterator[DaemonFactory]:
    """Start daemons: ``daemon(map_path, *flags, environment=..., shm_dir=..., start=True)``.

    At the end of the test each one still running gets SIGTERM and must exit 0 and leave no name, no
    socket, no process, no temporary file (one that the test killed and did not start again is
    judged by its processes alone); and this process must have no more open files than before.
    """
    before = open_files()
    started: list[DaemonProcess] = []

    def factory(map_path: Path | str, *flags: str, start: bool = True, **options: Any) -> DaemonProcess:
        one = DaemonProcess(map_path, *flags, **options)
        started.append(one)
        return one.start() if start else one

    yield factory
    problems: list[str] = []
    for one in reversed(started):  # a later one may live in an earlier one's directory
        try:
            if one.process is not None:
                code = one.stop()
                if code != 0:
                    problems.append(f"the daemon's exit code is {code}")
            problems += one.leftovers()
            if problems:
                problems.append(one.log)
        finally:
            one.dispose()
    gc.collect()
    problems += [
        f"descriptor {fd} -> {target}"
        for fd, target in open_files().items()
        if fd not in before and not target.startswith("/dev/null")
    ]
    if problems:
        pytest.fail("left behind:\n" + "\n".join(problems))


@pytest.fixture
def connect(daemon: DaemonFactory) -> Iterator[Callable[..., RawClient]]:
    """Open raw sessions, ``connect(daemon, timeout=..., name=...)``; closed at the end of the test."""
    opened: list[RawClient] = []

    def factory(to: DaemonProcess, **options: Any) -> RawClient:
        client = RawClient(to.endpoint, **options)
        opened.append(client)
        return client

    yield factory
    for client in opened:
        client.close()


@pytest.fixture
def divided_map(tmp_path: Path) -> DividedMap:
    """Return a map of 6 x 6 cells of 20 m, 500 points each, about the origin."""
    return make_map(tmp_path / "map")
