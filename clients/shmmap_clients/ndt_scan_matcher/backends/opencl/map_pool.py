# SPDX-License-Identifier: Apache-2.0
"""The maps on a device: one buffer of fixed size that holds the map in use and the next one beside it.

Where the device reads shared memory in place, only the tables of a map lie here, some kilobytes.  Else each
cell is copied once, when it first appears; maps share the cells that they have in common.  What is new and
lies side by side goes in one write.  No map ever takes memory that was not there from the beginning: where
the next one does not fit beside the one in use, it is laid out when that is given up.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device
from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceMemory, device_errors
from shmmap_clients.ndt_scan_matcher.backends.opencl.free_list import ALIGNMENT, FreeList, rounded
from shmmap_clients.ndt_scan_matcher.backends.opencl.square_directory import squares_of
from shmmap_clients.ndt_scan_matcher.backends.opencl.waiting import Waiting
from shmmap_clients.ndt_scan_matcher.map.voxel_cell import VoxelCell
from shmmap_clients.ndt_scan_matcher.map.voxel_map import TABLE_COLUMNS, Covariance, VoxelMap

__all__ = ["MapPool", "PlacedMap", "UploadStatistics"]

_STRETCH_BYTES: Final = 1 << 22  # staged in one piece at most
_NOTHING: Final = np.zeros(ALIGNMENT, np.uint8)  # what lies between blocks


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMap:
    """Where a map's tables lie in the pool, as byte offsets; and how the kernel finds its way in them.

    Attributes
    ----------
    voxel_map
    offsets
        Of the table of cells, their origins, where each square's cells start, and the cells.
    lead
        Columns of the lattice between the first square's corner and the map's box, in i and j.
    squares
        In a row of j.
    """

    voxel_map: VoxelMap
    offsets: tuple[int, int, int, int]
    lead: tuple[int, int]
    squares: int


@dataclass(slots=True)
class UploadStatistics:
    """What was written to the pool: bytes, writes, and maps that did not fit beside the one in use."""

    written_bytes: int = 0
    writes: int = 0
    laid_out_anew: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    offset: int
    nbytes: int
    owner: object  # keeps the id of what the block is a copy of from being used again


@dataclass(frozen=True, slots=True, eq=False)
class _Tables:
    arrays: list[NDArray[Any]]
    lead: tuple[int, int]
    squares: int


_Key = tuple[int, str]
_Part = tuple[int, int, list[NDArray[Any]]]  # offset, bytes, and the arrays that lie there


class MapPool:
    """Memory of one device for maps; `prepare` may be called beside the thread that matches.

    Parameters
    ----------
    context
        Of the device.
    device
    capacity
        Bytes.

    Raises
    ------
    DeviceMemory
        The device has not as much.
    """

    def __init__(self, context: Any, device: Device, capacity: int) -> None:
        import pyopencl as cl

        self.statistics = UploadStatistics()
        self._device = device
        self._real = np.dtype(np.float64 if device.double else np.float32)
        self._free = FreeList(capacity)
        self._blocks: dict[_Key, _Block] = {}
        self._placed: dict[tuple[int, Covariance], PlacedMap] = {}
        self._current: VoxelMap | None = None
        self._latest: VoxelMap | None = None
        self._lock = threading.Lock()
        self._waiting = Waiting(device.info.name)
        self._staging = np.empty(min(capacity, _STRETCH_BYTES), np.uint8)
        with device_errors(device.info.name, f"allocate {capacity / 1e6:.0f} MB for maps"):
            self.buffer = cl.Buffer(context, cl.mem_flags.READ_ONLY, capacity)
            # a queue of its own: no evaluation waits for a map that is being written
            self._queue = cl.CommandQueue(context, device.handle)

    @property
    def capacity(self) -> int:
        """Bytes of the pool."""
        return self._free.capacity

    @property
    def used_bytes(self) -> int:
        """Bytes that maps take at present."""
        return self._free.capacity - self._free.free_bytes

    def close(self) -> None:
        """Give the device's memory back."""
        self.buffer.release()

    def prepare(self, voxel_map: VoxelMap, covariance: Covariance) -> None:
        """Write what is new of a map beside the one in use; where it does not fit, `use` will.

        Raises
        ------
        DeviceError
            The device cannot be written to.
        """
        tables = self._tables(voxel_map, covariance)
        with self._lock:
            if (id(voxel_map), covariance) not in self._placed:
                self._latest = voxel_map
                self._forget()
                self._place(voxel_map, covariance, tables)

    def use(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        """Return where a map lies; the one that was used before may be overwritten from now on.

        Raises
        ------
        DeviceMemory
            The map is larger than the pool.
        """
        placed = self._placed.get((id(voxel_map), covariance))
        if placed is not None and self._current is voxel_map:
            return placed
        with self._lock:
            self._current = voxel_map
            placed = self._placed.get((id(voxel_map), covariance))
        return self._lay_out(voxel_map, covariance) if placed is None else placed

    def _lay_out(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        """Place the map in use, whatever else has to go for it."""
        tables = self._tables(voxel_map, covariance)
        with self._lock:
            self._forget()
            placed = self._place(voxel_map, covariance, tables)
            if placed is None:
                # there is room, but in pieces, or the next map has it: begin with an empty pool
                self.statistics.laid_out_anew += 1
                self._latest = None
                self._placed.clear()
                self._blocks.clear()
                self._free = FreeList(self._free.capacity)
                placed = self._place(voxel_map, covariance, tables)
        if placed is None:
            raise DeviceMemory(
                f"a map of {voxel_map.voxels} voxels takes more than the {self.capacity / 1e6:.0f} MB that"
                f" device {self._device.info.name!r} has for maps",
                hint="VoxelMap(max_bytes=...) or --max-map-bytes leave out what is too much",
            )
        return placed

    def _forget(self) -> None:
        """Give back what neither the map in use nor the next one needs."""
        kept = [one for one in (self._current, self._latest) if one is not None]
        maps = {id(one) for one in kept}
        self._placed = {key: placed for key, placed in self._placed.items() if key[0] in maps}
        needed = {(at, f"tables {covariance}") for at, covariance in self._placed}
        cells = {id(cell) for one in kept for cell in one.cells.values()}
        for key in [key for key in self._blocks if key not in needed and key[0] not in cells]:
            block = self._blocks.pop(key)
            self._free.give(block.offset, block.nbytes)

    def _tables(self, voxel_map: VoxelMap, covariance: Covariance) -> _Tables:
        """Return what is small, without where cells lie: that is filled in when they have a place."""
        cells = list(voxel_map.cells.values())
        if self._device.in_place:
            table = voxel_map.table(covariance)
        else:
            table = np.array([_row(cell) for cell in cells], np.int64).reshape(-1, TABLE_COLUMNS)
            for key in voxel_map.cells:
                voxel_map.inverses(key, covariance)
        shapes = np.array([cell.lattice.shape[:2] for cell in cells], np.int64).reshape(-1, 2)
        low, squares, start, square_cell = squares_of(table[:, 3:5], shapes)
        return _Tables(
            [np.concatenate([table, shapes], axis=1), voxel_map.origins, start, square_cell],
            (int(voxel_map.box[0] - low[0]), int(voxel_map.box[1] - low[1])),
            squares,
        )

    def _place(self, voxel_map: VoxelMap, covariance: Covariance, found: _Tables) -> PlacedMap | None:
        """Find room and write; None, and nothing has changed, where there is no room."""
        tables = found.arrays
        wanted: list[tuple[_Key, int, object]] = []
        if not self._device.in_place:
            size = self._real.itemsize
            for cell in voxel_map.cells.values():
                count = len(cell.count)
                wanted.append(((id(cell), "voxels"), 3 * size * count + 4 * cell.lattice.size, cell))
                wanted.append(((id(cell), covariance), 6 * size * count, cell))
        starts = np.cumsum([0, *(rounded(table.nbytes) for table in tables)]).tolist()
        wanted.append(((id(voxel_map), f"tables {covariance}"), starts[-1], voxel_map))
        missing = [one for one in wanted if one[0] not in self._blocks]
        offsets = self._free.take_all([nbytes for _, nbytes, _ in missing])
        if offsets is None:
            return None
        new = {key: _Block(at, size, owner) for (key, size, owner), at in zip(missing, offsets, strict=True)}
        self._blocks.update(new)
        try:
            self._write(self._parts(voxel_map, covariance, tables, starts, new))
        except BaseException:
            # what may not have been written is no copy of anything
            for key, block in new.items():
                del self._blocks[key]
                self._free.give(block.offset, block.nbytes)
            raise
        base = self._blocks[(id(voxel_map), f"tables {covariance}")].offset
        table_at, origins_at, start_at, cell_at = (base + start for start in starts[:4])
        placed = PlacedMap(voxel_map, (table_at, origins_at, start_at, cell_at), found.lead, found.squares)
        self._placed[(id(voxel_map), covariance)] = placed
        return placed

    def _parts(
        self,
        voxel_map: VoxelMap,
        covariance: Covariance,
        tables: list[NDArray[Any]],
        starts: list[int],
        new: dict[_Key, _Block],
    ) -> list[_Part]:
        """Return what has to be written for new blocks."""
        if not self._device.in_place:
            tables = [self._addressed(voxel_map, covariance, tables[0]), *tables[1:]]
        names = {id(cell): name for name, cell in voxel_map.cells.items()}
        parts: list[_Part] = []
        for (at, part), block in new.items():
            if part.startswith("tables "):
                parts += [
                    (block.offset + start, table.nbytes, [table])
                    for start, table in zip(starts, tables, strict=False)
                ]
            elif part == "voxels":
                parts.append((block.offset, block.nbytes, self._voxels(voxel_map.cells[names[at]])))
            else:
                inverse = voxel_map.inverses(names[at], covariance)
                parts.append((block.offset, block.nbytes, [inverse.astype(self._real, copy=False)]))
        return parts

    def _addressed(
        self, voxel_map: VoxelMap, covariance: Covariance, table: NDArray[np.generic]
    ) -> NDArray[np.int64]:
        rows = np.array(table, np.int64)
        cells = list(voxel_map.cells.values())
        means = np.array([self._blocks[(id(cell), "voxels")].offset for cell in cells], np.int64)
        rows[:, 0] = means + 3 * self._real.itemsize * rows[:, 10]
        rows[:, 1] = means
        rows[:, 2] = [self._blocks[(id(cell), covariance)].offset for cell in cells]
        return rows

    def _voxels(self, cell: VoxelCell) -> list[NDArray[np.generic]]:
        mean: NDArray[np.floating] = cell.mean
        if not self._device.double:
            # relative to the lattice's corner, which is exact where the kernel computes it
            mean = (mean + (cell.origin - cell.lattice_origin * cell.leaf)).astype(np.float32)
        return [mean, cell.lattice.T]

    def _write(self, parts: list[_Part]) -> None:
        """Write arrays to their places: what lies side by side, together."""
        import pyopencl as cl

        with device_errors(self._device.info.name, "write a map"):
            for stretch in _stretches(parts):
                first, last = stretch[0][0], stretch[-1][0] + stretch[-1][1]
                # one piece of memory for all stretches; a cell that is larger than that has one of its own
                large = last - first > len(self._staging)
                staged = np.empty(last - first, np.uint8) if large else self._staging[: last - first]
                pieces, at = [], first
                for offset, nbytes, arrays in stretch:
                    pieces.append(_NOTHING[: offset - at])
                    pieces += [array.reshape(-1).view(np.uint8) for array in arrays]
                    at = offset + nbytes
                np.concatenate(pieces, out=staged)
                written = cl.enqueue_copy(
                    self._queue, self.buffer, staged, dst_offset=first, is_blocking=False
                )
                self._queue.flush()
                self._waiting.until(written)
                self.statistics.writes += 1
                self.statistics.written_bytes += len(staged)


def _row(cell: VoxelCell) -> list[int]:
    """Return a cell's row of the table, for a lattice that is written with i fastest, without its places."""
    ni, nj, nk = cell.lattice.shape
    return [0, 0, 0, *cell.lattice_origin.tolist(), nk, 1, ni, ni * nj, len(cell.count)]


def _stretches(parts: list[_Part]) -> list[list[_Part]]:
    """Group what lies side by side, but for the roundings, into pieces that are staged at once."""
    found: list[list[_Part]] = []
    begin = end = -1
    for part in sorted((part for part in parts if part[1]), key=lambda one: one[0]):
        offset, nbytes, _ = part
        if offset == end and offset + nbytes - begin <= _STRETCH_BYTES:
            found[-1].append(part)
        else:
            found.append([part])
            begin = offset
        end = offset + rounded(nbytes)
    return found
