# SPDX-License-Identifier: Apache-2.0
"""Fixtures for the client in C++: compiled on the spot where there is a compiler."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmmap.testing.fixtures import judged_daemons
from tests.support.cpp_client import CppClient, compiled
from tests.support.daemon_process import DaemonProcess
from tests.support.divided_map import DividedMap, make_map

DaemonFactory = Callable[..., DaemonProcess]


@pytest.fixture(scope="session")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled client."""
    if shutil.which("g++") is None:
        pytest.skip("g++ is missing")
    return compiled(tmp_path_factory.mktemp("cpp"))


@pytest.fixture
def daemon() -> Iterator[DaemonFactory]:
    """Start daemons, each judged from outside when it ends."""
    yield from judged_daemons(DaemonProcess)


@pytest.fixture
def client(
    program: Path, daemon: DaemonFactory
) -> Iterator[CppClient]:  # it ends before its daemon is judged
    """Return a client that is not connected yet; nothing in it may leak or go wrong."""
    one = CppClient(program)
    yield one
    assert one.close() == 0


@pytest.fixture
def divided_map(tmp_path: Path) -> DividedMap:
    """Return a map of 6 x 6 cells of 20 m, 500 points each, about the origin."""
    return make_map(tmp_path / "map")
