# SPDX-License-Identifier: Apache-2.0
"""Which cells have points outside their box: moved, or the map's metadata is another map's."""

from __future__ import annotations

from collections import deque
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.logfmt import log

__all__ = ["MisplacedCells"]

COUNTER: Final = "cells_outside_box"


class MisplacedCells:
    """Logs each such cell once a state, and counts them."""

    def __init__(self, cache: CellCache) -> None:
        self._cache = cache
        self._versions: dict[str, int] = {}  # of the cell, when it was loaded
        self._to_check: deque[str] = deque()

    def note(self, cell_id: str, index: int, outside: int) -> None:
        """Note what a loaded or adopted segment says of its cell's points."""
        if not outside:
            if self._versions.pop(cell_id, 0):
                self._count()
            return
        version = self._cache.catalogue.version(index)
        if self._versions.get(cell_id) != version:
            self._versions[cell_id] = version
            self._count()
            log.warning(
                "points outside the cell's box", cell=cell_id, points=outside,
                box=self._cache.catalogue.box(index), hint="was the cell moved, and its metadata not?",
            )  # fmt: skip

    def map_changed(self) -> None:
        """Have cells looked at again by `check_some`: they may have changed, or left the map."""
        self._to_check = deque(self._versions)

    def check_some(self, most: int) -> None:
        """Forget those of some cells that are not what they were."""
        for _ in range(min(most, len(self._to_check))):
            cell_id = self._to_check.popleft()
            index = self._cache.catalogue.find(cell_id)
            if index is None or self._cache.catalogue.version(index) != self._versions.get(cell_id):
                self._versions.pop(cell_id, None)
                self._count()

    def _count(self) -> None:
        self._cache.statistics.set(COUNTER, len(self._versions))
