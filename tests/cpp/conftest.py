# SPDX-License-Identifier: Apache-2.0
"""Fixtures for the client in C++."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.testing.fixtures import judged_daemons
from tests.support.cpp_client import CppProgram
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map

DaemonFactory = Callable[..., DaemonProcess]


@pytest.fixture
def daemon() -> Iterator[DaemonFactory]:
    """Start daemons, each judged from outside when it ends."""
    yield from judged_daemons(DaemonProcess)


@pytest.fixture
def divided_map(tmp_path: Path) -> DividedMap:
    """Return a map of 6 x 6 cells of 20 m, 500 points each, about the origin."""
    return make_map(tmp_path / "map")


@pytest.fixture
def program(cpp_program: Path) -> Iterator[CppProgram]:
    """Return a process that has not connected; nothing in it may leak or go wrong."""
    one = CppProgram(cpp_program)
    yield one
    assert one.close() == 0
