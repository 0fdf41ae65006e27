# SPDX-License-Identifier: Apache-2.0
"""The daemon's parts without its socket, as fixtures."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.divided_map import DividedMap, make_map
from tests.unit.daemon.inner_daemon import InnerDaemon
from tests.unit.daemon.whole_daemon import WholeDaemon


@pytest.fixture
def small_map(tmp_path: Path) -> DividedMap:
    """Return a map of 4 x 4 cells of 20 m, 60 points each, about the origin."""
    return make_map(tmp_path / "map", columns=4, rows=4, points=60)


@pytest.fixture
def short_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """End each step of work on many things after the first of them."""
    monkeypatch.setattr("shmmap.daemon.turns.STEP_S", 0.0)


@pytest.fixture
def inner(tmp_path: Path) -> Iterator[Callable[..., InnerDaemon]]:
    """Make daemons without a socket: ``inner(map_path, budget_bytes=..., ...)``; closed at the end."""
    made: list[InnerDaemon] = []

    def factory(map_path: Path | str, **options: Any) -> InnerDaemon:
        made.append(InnerDaemon(str(map_path), cache_dir=str(tmp_path / "cache"), **options))
        return made[-1]

    yield factory
    for one in made:
        one.close()


@pytest.fixture
def whole() -> Iterator[Callable[..., WholeDaemon]]:
    """Make a daemon with its sockets: ``whole(map_path, origin=..., ...)``; closed at the end."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as scratch:
        made: list[WholeDaemon] = []

        def factory(map_path: Path, **options: Any) -> WholeDaemon:
            made.append(WholeDaemon(map_path, scratch, **options))
            return made[-1]

        yield factory
        for one in made:
            one.close()
