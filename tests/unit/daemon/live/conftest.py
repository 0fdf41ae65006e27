# SPDX-License-Identifier: Apache-2.0
"""What tests of live maps share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from shmmap.daemon.live.chunk_memory import ChunkMemory
from shmmap.daemon.live.folder import Folder
from shmmap.daemon.live.live_map import LiveMap


@pytest.fixture(autouse=True)
def closed_maps(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every live map that a test makes is closed at its end: files stay open otherwise."""
    made: list[LiveMap] = []
    begin = LiveMap.__post_init__

    def note(one: LiveMap) -> None:
        made.append(one)
        begin(one)

    monkeypatch.setattr(LiveMap, "__post_init__", note)
    opened: dict[int, ChunkMemory | Folder] = {}
    for kind in (ChunkMemory, Folder):
        _follow(kind, opened, monkeypatch)
    yield
    for one in made:
        if hasattr(one, "_threads"):
            one.close()
    for place in list(opened.values()):
        place.close()


def _follow(kind: Any, opened: dict[int, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Note what is open of a kind."""
    begin, end = kind.__init__, kind.close

    def init(self: Any, *arguments: Any, **options: Any) -> None:
        begin(self, *arguments, **options)
        opened[id(self)] = self

    def close(self: Any) -> None:
        opened.pop(id(self), None)
        end(self)

    monkeypatch.setattr(kind, "__init__", init)
    monkeypatch.setattr(kind, "close", close)
