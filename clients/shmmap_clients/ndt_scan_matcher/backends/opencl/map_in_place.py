# SPDX-License-Identifier: Apache-2.0
"""Maps that a device reads where they lie: cells in shared memory, their tables in this process's memory.

The device has to be able to read any address of the process (shared virtual memory of fine grain,
system-wide).
Nothing is written to it, and nothing is held twice: the table of cells is the one that the compiled backend
uses, the directory of squares some kilobytes.
"""

from __future__ import annotations

import threading
from typing import Any

from shmmap_clients.ndt_scan_matcher.backends.opencl.placed_map import PlacedMap, map_tables
from shmmap_clients.ndt_scan_matcher.backends.uploads import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_map import Covariance, VoxelMap

__all__ = ["MapInPlace"]


class MapInPlace:
    """Keeps the tables of the map in use and of the next one; as `MapPool`, for a device that needs no copy.

    Parameters
    ----------
    context
        Of the device.
    """

    def __init__(self, context: Any) -> None:
        import pyopencl as cl

        self.statistics = UploadStatistics()
        # the kernel takes a pool, and does not look at it
        self.buffer = cl.Buffer(context, cl.mem_flags.READ_ONLY, 64)
        self._placed: dict[tuple[int, Covariance], PlacedMap] = {}
        self._current: VoxelMap | None = None
        self._lock = threading.Lock()

    @property
    def capacity(self) -> int:
        """Bytes on the device: none."""
        return 0

    @property
    def used_bytes(self) -> int:
        """Bytes on the device that maps take: none."""
        return 0

    def close(self) -> None:
        """Let go of the maps."""
        self._placed.clear()
        self.buffer.release()

    def prepare(self, voxel_map: VoxelMap, covariance: Covariance) -> None:
        """Make the tables of a map beside those of the one in use."""
        self._make(voxel_map, covariance)

    def use(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        """Return where a map lies; the one that was used before may be forgotten from now on."""
        self._current = voxel_map
        placed = self._placed.get((id(voxel_map), covariance))
        return self._make(voxel_map, covariance) if placed is None else placed

    def _make(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        with self._lock:
            known = self._placed.get((id(voxel_map), covariance))
            if known is not None:
                return known
            tables = map_tables(voxel_map, voxel_map.table(covariance))
            table, origins, start, cell = (array.ctypes.data for array in tables.arrays)
            placed = PlacedMap(
                voxel_map, (table, origins, start, cell), tables.lead, tables.squares, tables.arrays
            )
            kept = {id(voxel_map), id(self._current)}
            self._placed = {key: one for key, one in self._placed.items() if key[0] in kept}
            self._placed[(id(voxel_map), covariance)] = placed
            return placed
