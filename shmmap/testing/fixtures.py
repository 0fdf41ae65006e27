# SPDX-License-Identifier: Apache-2.0
"""Fixtures for pytest, which must be installed.

In the `conftest.py` of your tests::

    pytest_plugins = ["shmmap.testing.fixtures"]

and in a test::

    def test_my_program(shmmap_daemon, tmp_path):
        daemon = shmmap_daemon(map_path, "--budget", "64M")
        with shmmap.connect(daemon.endpoint) as client:
            ...

The test fails if the daemon leaves anything behind, or if the test leaves a file open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import pytest

from shmmap.errors import InternalError
from shmmap.testing.daemon_process import DaemonProcess, isolated_daemons

__all__ = ["judged_daemons", "shmmap_daemon"]

_Daemon = TypeVar("_Daemon", bound=DaemonProcess)


@pytest.fixture
def shmmap_daemon() -> Iterator[Callable[..., DaemonProcess]]:
    """Provide ``shmmap_daemon(map_path, *options)`` to start daemons, see `isolated_daemons`."""
    yield from judged_daemons(DaemonProcess)


def judged_daemons(kind: type[_Daemon]) -> Iterator[Callable[..., _Daemon]]:
    """Implement `shmmap_daemon`, also for fixtures with another class of daemons."""
    try:
        with isolated_daemons(kind) as make:
            yield make
    except InternalError as error:
        pytest.fail(str(error), pytrace=False)
