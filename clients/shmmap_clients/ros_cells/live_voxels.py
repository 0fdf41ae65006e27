# SPDX-License-Identifier: Apache-2.0
"""Voxels of a live map as nodes of ROS 2 take them: all of a kind, and the map seen from above.

Rolling-Bonxai planned a service for voxels in memory and one for saved chunks; ``bonxai_msgs`` has the types.
Both programs use the same indices of voxels: ``floor(position / resolution)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.live import LiveMap
from shmmap_clients.rolling_map.live_map import all_voxels

SEARCHES: Final[Mapping[str, tuple[str, str]]] = {
    "get_occupied_voxels": ("occupied", "memory"),
    "get_free_voxels": ("free", "memory"),
    "get_saved_occupied_voxels": ("occupied", "disk"),
    "get_saved_free_voxels": ("free", "disk"),
}
"""Kind of voxels and place of the search, by the last part of the service's name."""
UNKNOWN: Final = -1
MAX_CELLS: Final = 1 << 26
"""Largest `Grid`: 67 million cells, as 819 m of 0.1 m each way."""


@dataclass(frozen=True, slots=True, eq=False)
class VoxelList:
    """All voxels of a kind.

    Attributes
    ----------
    indices
        (N, 3) int32.
    active
        Number of known voxels.  For ``disk`` all chunks count, those in memory with their state there.
    ratio
        occupied / (occupied + free).
    memory_mb
        Size of the map in memory, or of its files, MiB.
    """

    indices: NDArray[np.int32]
    active: int
    ratio: float
    memory_mb: float

    @property
    def bounds(self) -> tuple[list[int], list[int]]:
        """Lowest and highest indices; zeros without voxels."""
        if not len(self.indices):
            return [0, 0, 0], [0, 0, 0]
        return self.indices.min(axis=0).tolist(), self.indices.max(axis=0).tolist()


def list_voxels(live: LiveMap, kind: str, scope: str) -> VoxelList:
    """List all voxels of a kind, in memory or on disk.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or has no memory for a list.
    """
    rows = live.chunks(saved=scope == "disk")
    occupied, free = (sum(getattr(row, name) for row in rows) for name in ("occupied", "free"))
    status = live.status()
    indices = np.floor(all_voxels(live, kind, scope) / live.resolution).astype(np.int32)
    taken = status.file_bytes if scope == "disk" else status.bytes
    ratio = occupied / (occupied + free) if occupied + free else 0.0
    return VoxelList(indices, sum(row.active for row in rows), ratio, taken / 2**20)


class LostChunks:
    """Report of chunks of which something that was saved is lost.

    Parameters
    ----------
    log
        Called with a line about each, once.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._known: frozenset[str] = frozenset()

    def any_of(self, live: LiveMap) -> bool:
        """Return whether something is lost; log what is new."""
        lost = frozenset(f"{key.text}: {reason}" for key, reason in live.lost().items())
        if new := lost - self._known:
            self._log(f"live map {live.name} has lost something of chunks: {'; '.join(sorted(new))}")
        self._known = lost
        return bool(lost)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A live map from above, as ``nav_msgs/OccupancyGrid`` has it.

    Attributes
    ----------
    values
        (height, width) int8, from low to high y and x: 100 where a voxel of the column is occupied, else 0
        where one is free, else -1.
    x, y
        Corner with the lowest coordinates, metres, map frame.
    resolution
        Edge of a cell, metres.
    """

    values: NDArray[np.int8]
    x: float
    y: float
    resolution: float


def projected(live: LiveMap, lowest: float, highest: float) -> Grid | None:
    """Return the map in memory from above, of the voxels with centres between two heights.

    Parameters
    ----------
    lowest, highest
        Metres, map frame.

    Returns
    -------
    The grid; None if it would have more than `MAX_CELLS` cells.

    Raises
    ------
    ShmmapError
        The daemon does not answer, or has no memory for a list.
    """
    columns = []
    for kind in ("free", "occupied"):
        xyz = all_voxels(live, kind)
        inside = (xyz[:, 2] >= lowest) & (xyz[:, 2] <= highest)
        columns.append(np.floor(xyz[inside, :2] / live.resolution).astype(np.int64))
    both = np.concatenate(columns)
    low, high = (both.min(axis=0), both.max(axis=0)) if len(both) else (np.zeros(2, int), np.full(2, -1))
    width, height = (high - low + 1).tolist()
    if width * height > MAX_CELLS:
        return None
    values = np.full((height, width), UNKNOWN, np.int8)
    for cells, value in zip(columns, (0, 100), strict=True):
        x, y = (cells - low).T
        values[y, x] = value
    x, y = (low * live.resolution).tolist()
    return Grid(values, x, y, live.resolution)
