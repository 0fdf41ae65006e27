# SPDX-License-Identifier: Apache-2.0
"""Cells that were answered with a moment ago: to map one takes as long as to send it, and others ask, too."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Iterable
from typing import Final

from shmmap import Cell

__all__ = ["RecentCells"]

_MOST_BYTES: Final = 64 << 20
_KEPT_S: Final = 2.0


class RecentCells:
    """At most 64 MiB of cells, kept until nobody has asked for two seconds: then the daemon may free them."""

    def __init__(self) -> None:
        self._cells: OrderedDict[tuple[str, int], Cell] = OrderedDict()  # the newest last
        self._bytes = 0
        self._until_s = 0.0

    def __len__(self) -> int:
        return len(self._cells)

    def kept(self, cells: Iterable[Cell]) -> list[Cell]:
        """Keep these cells; returns them, those that were kept before with the arrays that they have made."""
        found = []
        for cell in cells:
            key = cell.id, cell.version
            one = self._cells.get(key)
            if one is None:
                one = self._cells[key] = cell
                self._bytes += cell.nbytes
            else:
                self._cells.move_to_end(key)
            found.append(one)
        while self._bytes > _MOST_BYTES:
            self._bytes -= self._cells.popitem(last=False)[1].nbytes
        self._until_s = time.monotonic() + _KEPT_S
        return found

    def let_go(self) -> bool:
        """Let go of all, if it is time to; returns whether it was."""
        if not self._cells or time.monotonic() < self._until_s:
            return False
        self._cells.clear()
        self._bytes = 0
        return True
