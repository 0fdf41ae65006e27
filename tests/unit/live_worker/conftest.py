# SPDX-License-Identifier: Apache-2.0
"""What tests of live maps share."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from shmmap.live_worker.chunk_memory import ChunkMemory
from shmmap.live_worker.disk.folder import Folder
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.paged_map import PagedMap
from tests.support.served_map import Served


@pytest.fixture(autouse=True)
def closed_maps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close what a test left open: maps, their memory and their directories."""
    opened: dict[int, Any] = {}
    for kind in (PagedMap, MapDatabase, ChunkMemory, Folder):
        _follow(kind, opened, monkeypatch)
    yield
    for one in sorted(opened.values(), key=lambda one: not isinstance(one, PagedMap | MapDatabase)):
        one.close()


def _follow(kind: Any, opened: dict[int, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Note what is open of a kind."""
    begin, end = kind.__init__, kind.close

    def init(self: Any, *arguments: Any, **options: Any) -> None:
        begin(self, *arguments, **options)
        opened[id(self)] = self

    def close(self: Any, *arguments: Any) -> None:
        opened.pop(id(self), None)
        end(self, *arguments)

    monkeypatch.setattr(kind, "__init__", init)
    monkeypatch.setattr(kind, "close", close)


@pytest.fixture
def shm() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)


@pytest.fixture
def serve(shm: Path, tmp_path: Path) -> Iterator[Callable[..., Served]]:
    """Begin runs of one map, ``serve(budget_bytes, linger_s=..., ...)``; the last one is ended at the end."""
    begun: list[Served] = []

    def factory(budget_bytes: int = 10**9, **limits: Any) -> Served:
        begun.append(Served(shm, tmp_path / "map", budget_bytes, **limits))
        return begun[-1]

    yield factory
    for one in begun:
        one.end()
