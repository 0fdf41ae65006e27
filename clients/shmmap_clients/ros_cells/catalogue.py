# SPDX-License-Identifier: Apache-2.0
"""The map's cells under the names that they have in ROS, and the cells of recent answers.

A name is ``<id>@<version>``, the version as 16 hexadecimal digits.  Autoware's requests name the cells that a
node has, but no versions, and its nodes take names as they come.  So a changed cell has another name: the
next answer to each node removes the old name, and has the cell under the new one.  Nothing is remembered
about nodes, so that this also holds over restarts of all programs.
"""

from __future__ import annotations

import re
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import Cell, CellInfo, Client

_NAME: Final = re.compile(r"(.*)@([0-9a-f]{16})", re.DOTALL)
_MAX_RECENT_BYTES: Final = 64 << 20
_KEPT_S: Final = 2.0


def cell_name(cell_id: str, version: int) -> str:
    """Return the name of a cell at a version: ``<id>@<16 hexadecimal digits>``."""
    return f"{cell_id}@{version:016x}"


def split_name(text: str) -> tuple[str, int | None]:
    """Return id and version of a name; a text without a version is an id, and its version None.

    The version stands after the last ``@``: a path may have one, too, but it ends with the file's suffix.
    """
    found = _NAME.fullmatch(text)
    return (found[1], int(found[2], 16)) if found else (text, None)


class Catalogue:
    """Cells by id, of one map version.  Several threads may use it, each with a client of its own.

    Attributes
    ----------
    cells : dict
        `shmmap.CellInfo` by id, in the order of ids; replaced, never changed.
    versions : dict
        Version of each cell's points by id.
    map_version : int or None
        Version of the map; None before the first `refresh`.
    """

    def __init__(self) -> None:
        self.cells: dict[str, CellInfo] = {}
        self.versions: dict[str, int] = {}
        self.map_version: int | None = None
        self._boxes = np.empty((0, 4))
        self._lock = threading.Lock()

    def refresh(self, client: Client) -> None:
        """Fetch the changes of the map.

        Raises
        ------
        DaemonUnreachable
            The daemon does not answer.
        """
        with self._lock:
            listing = client.metadata(since=self.map_version)
            if listing.map_version == self.map_version:
                return
            changed = {cell.id: cell for cell in listing}
            cells = {**self.cells, **changed} if listing.since_known else changed
            for gone in listing.removed if listing.since_known else ():
                cells.pop(gone, None)
            self.cells = dict(sorted(cells.items()))
            self.versions = {cell.id: cell.version for cell in self.cells.values()}
            self._boxes = np.array([cell.box for cell in self.cells.values()], np.float64).reshape(-1, 4)
            self.map_version = listing.map_version

    def boxes(self) -> NDArray[np.float64]:
        """Return all boxes, (N, 4) min_x min_y max_x max_y, metres, in the order of ids."""
        return self._boxes

    def names(self, *, plain_ids: bool = False) -> list[str]:
        """Return the names of all cells, in the order of ids; with ``plain_ids`` the ids themselves."""
        return (
            list(self.cells) if plain_ids else [cell_name(one.id, one.version) for one in self.cells.values()]
        )


class RecentCells:
    """Cache of the cells of recent answers, at most 64 MiB.  Several threads may use it.

    Mapping a cell takes as long as sending it, and other clients often request the same one.  After two
    seconds without a request, all cells are dropped, so that the daemon may evict them.
    """

    def __init__(self) -> None:
        self._cells: OrderedDict[tuple[str, int], Cell] = OrderedDict()  # newest last
        self._bytes = 0
        self._until_s = 0.0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._cells)

    def kept(self, cells: Iterable[Cell]) -> list[Cell]:
        """Keep these cells and return them; cells kept before are returned as the same objects."""
        found = []
        with self._lock:
            for cell in cells:
                key = cell.id, cell.version
                one = self._cells.get(key)
                if one is None:
                    one = self._cells[key] = cell
                    self._bytes += cell.nbytes
                else:
                    self._cells.move_to_end(key)
                found.append(one)
            while self._bytes > _MAX_RECENT_BYTES:
                self._bytes -= self._cells.popitem(last=False)[1].nbytes
            self._until_s = time.monotonic() + _KEPT_S
        return found

    def release_idle(self) -> bool:
        """Release all cells after two seconds without a request; return whether this was the case.

        Call `shmmap.Client.release` of each client then, which reports it to the daemon.
        """
        with self._lock:
            if not self._cells or time.monotonic() < self._until_s:
                return False
            self._cells.clear()
            self._bytes = 0
            return True
