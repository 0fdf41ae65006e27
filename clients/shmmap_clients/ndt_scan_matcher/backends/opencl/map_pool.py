# SPDX-License-Identifier: Apache-2.0
"""The maps on a device: one buffer of fixed size that holds the map in use and the next one beside it.

Each cell is copied once, when it first appears; maps share the cells that they have in common.  What is new
and lies side by side goes in one write.  No map ever takes memory that was not there from the beginning:
where the next one does not fit beside the one in use, it is laid out when that is given up.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from operator import itemgetter
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device
from shmmap_clients.ndt_scan_matcher.backends.opencl.errors import DeviceMemory, device_errors
from shmmap_clients.ndt_scan_matcher.backends.opencl.free_list import ALIGNMENT, FreeList, rounded
from shmmap_clients.ndt_scan_matcher.backends.opencl.placed_map import MapTables, PlacedMap, map_tables
from shmmap_clients.ndt_scan_matcher.backends.opencl.pool_memory import in_large_pages
from shmmap_clients.ndt_scan_matcher.backends.opencl.waiting import Waiting
from shmmap_clients.ndt_scan_matcher.backends.uploads import UploadStatistics
from shmmap_clients.ndt_scan_matcher.map.voxel_cell import VoxelCell
from shmmap_clients.ndt_scan_matcher.map.voxel_map import TABLE_COLUMNS, Covariance, VoxelMap

__all__ = ["MapPool"]

_STRETCH_BYTES: Final = 1 << 22  # staged in one piece at most

_Key = tuple[int, str]
_Part = tuple[int, int, tuple[NDArray[Any], ...]]  # offset, bytes, and the arrays that lie there


class _Block(NamedTuple):
    offset: int
    nbytes: int
    owner: object  # keeps the id of what the block is a copy of from being used again


class _Plan(NamedTuple):
    """What is known of a map before it has a place: its tables and its cells' inverse covariances."""

    tables: MapTables
    inverses: list[NDArray[np.float64]]


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
        # of each cell one block for each kind of covariance; the first one has its means and lattice, too
        self._blocks: dict[_Key, _Block] = {}
        self._means_at: dict[int, int] = {}
        self._placed: dict[tuple[int, Covariance], PlacedMap] = {}
        self._current: VoxelMap | None = None
        self._latest: VoxelMap | None = None
        self._lock = threading.Lock()
        self._waiting = Waiting(device.info.name)
        with device_errors(device.info.name, f"allocate {capacity / 1e6:.0f} MB for maps"):
            self._staging: NDArray[np.uint8] | None = None
            if device.is_processor:
                # it reads this process's memory: how that is paged is ours to choose, and nothing is staged
                flags, memory = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR, in_large_pages(capacity)
                self.buffer = cl.Buffer(context, flags, hostbuf=memory)
            else:
                self.buffer = cl.Buffer(context, cl.mem_flags.READ_ONLY, capacity)
                self._staging = in_large_pages(min(capacity, _STRETCH_BYTES))
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
        plan = self._plan(voxel_map, covariance)
        with self._lock:
            if (id(voxel_map), covariance) not in self._placed:
                self._latest = voxel_map
                self._forget()
                self._place(voxel_map, covariance, plan)

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
        plan = self._plan(voxel_map, covariance)
        with self._lock:
            self._forget()
            placed = self._place(voxel_map, covariance, plan)
            if placed is None:
                # there is room, but in pieces, or the next map has it: begin with an empty pool
                self.statistics.laid_out_anew += 1
                self._latest = None
                self._placed.clear()
                self._blocks.clear()
                self._means_at.clear()
                self._free = FreeList(self._free.capacity)
                placed = self._place(voxel_map, covariance, plan)
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
        self._give([key for key in self._blocks if key not in needed and key[0] not in cells])
        for cell in self._means_at.keys() - cells:
            del self._means_at[cell]

    def _plan(self, voxel_map: VoxelMap, covariance: Covariance) -> _Plan:
        """Return what takes time, without where cells lie: that is filled in when they have a place."""
        table = np.zeros((len(voxel_map.cells), TABLE_COLUMNS), np.int64)
        table[:, 3:] = voxel_map.boxes
        # lattices are written with i fastest
        table[:, 7] = 1
        table[:, 8] = table[:, 11]
        table[:, 9] = table[:, 11] * table[:, 12]
        inverses = [voxel_map.inverses(key, covariance) for key in voxel_map.cells]
        return _Plan(map_tables(voxel_map, table), inverses)

    def _place(self, voxel_map: VoxelMap, covariance: Covariance, plan: _Plan) -> PlacedMap | None:
        """Find room and write; None, and nothing has changed, where there is no room."""
        blocks, means_at, real = self._blocks, self._means_at, self._real
        keys: list[_Key] = []
        sizes: list[int] = []
        owners: list[object] = []
        contents: list[tuple[NDArray[Any], ...]] = []
        fresh: list[tuple[int, int]] = []  # which of these have means, too, and after how many bytes
        # a map may have a cell twice, under two keys
        cells = dict(zip(voxel_map.cells.values(), plan.inverses, strict=True))
        for cell, inverse in cells.items():
            key = (id(cell), covariance)
            if key in blocks:
                continue
            inverses = np.ascontiguousarray(inverse, real)
            nbytes = inverses.nbytes
            if key[0] in means_at:
                contents.append((inverses,))
            else:
                fresh.append((len(keys), nbytes))
                means = np.ascontiguousarray(self._means(cell), real)
                lattice = np.ascontiguousarray(cell.lattice.T, np.int32)
                nbytes += means.nbytes + lattice.nbytes
                contents.append((inverses, means, lattice))
            keys.append(key)
            sizes.append(nbytes)
            owners.append(cell)
        tables = plan.tables.arrays
        starts = np.cumsum([0, *(rounded(table.nbytes) for table in tables)]).tolist()
        keys.append((id(voxel_map), f"tables {covariance}"))
        sizes.append(starts[-1])
        owners.append(voxel_map)
        offsets = self._free.take_all(sizes)
        if offsets is None:
            return None
        blocks.update(zip(keys, map(_Block, offsets, sizes, owners), strict=True))
        means_at.update((keys[number][0], offsets[number] + after) for number, after in fresh)
        table_at, origins_at, start_at, cell_at = (offsets[-1] + start for start in starts[:4])
        places = (table_at, origins_at, start_at, cell_at)
        try:
            self._address(tables[0], voxel_map, covariance)
            parts: list[_Part] = list(zip(offsets, sizes, contents, strict=False))  # all but the tables
            parts += [(at, table.nbytes, (table,)) for at, table in zip(places, tables, strict=True)]
            self._write(parts)
        except BaseException:
            # what may not have been written is no copy of anything
            for number, _ in fresh:
                del means_at[keys[number][0]]
            self._give(keys)
            raise
        placed = PlacedMap(voxel_map, places, plan.tables.lead, plan.tables.squares)
        self._placed[(id(voxel_map), covariance)] = placed
        return placed

    def _give(self, keys: Iterable[_Key]) -> None:
        for key in keys:
            block = self._blocks.pop(key)
            self._free.give(block.offset, block.nbytes)

    def _address(self, table: NDArray[np.int64], voxel_map: VoxelMap, covariance: Covariance) -> None:
        """Fill in where cells lie: their inverse covariances, their means, and after these their lattices."""
        blocks, means_at = self._blocks, self._means_at
        cells = [id(cell) for cell in voxel_map.cells.values()]
        table[:, 1] = [means_at[cell] for cell in cells]
        table[:, 0] = table[:, 1] + 3 * self._real.itemsize * table[:, 10]
        table[:, 2] = [blocks[(cell, covariance)].offset for cell in cells]

    def _means(self, cell: VoxelCell) -> NDArray[np.float64]:
        if self._device.double:
            return cell.mean
        # relative to the lattice's corner, which is exact where the kernel computes it
        return cell.mean + (cell.origin - cell.lattice_origin * cell.leaf)

    def _write(self, parts: list[_Part]) -> None:
        """Write arrays to their places: what lies side by side, together."""
        import pyopencl as cl

        queue = self._queue
        with device_errors(self._device.info.name, "write a map"):
            for stretch in _stretches(parts, self.capacity if self._staging is None else _STRETCH_BYTES):
                first, last = stretch[0][0], stretch[-1][0] + stretch[-1][1]
                if self._staging is None:
                    flags = cl.map_flags.WRITE_INVALIDATE_REGION
                    memory: Any  # an array whose base is to be released
                    memory, mapped = cl.enqueue_map_buffer(
                        queue,
                        self.buffer,
                        flags,
                        first,
                        (last - first,),
                        np.dtype(np.uint8),
                        is_blocking=False,
                    )
                    queue.flush()
                    self._waiting.until(mapped)
                    _fill(memory, first, stretch)
                    written = memory.base.release(queue)
                else:
                    # one piece of memory for all; a cell that is larger than that has one of its own
                    large = last - first > len(self._staging)
                    there = np.empty(last - first, np.uint8) if large else self._staging[: last - first]
                    _fill(there, first, stretch)
                    written = cl.enqueue_copy(queue, self.buffer, there, dst_offset=first, is_blocking=False)
                queue.flush()
                self._waiting.until(written)
                self.statistics.writes += 1
                self.statistics.written_bytes += last - first


def _fill(there: NDArray[np.uint8], first: int, stretch: list[_Part]) -> None:
    """Put arrays where they belong, in memory that stands for the pool from its byte ``first`` on."""
    memory = there.data  # numpy would take three times as long for so many small pieces
    for offset, _, arrays in stretch:
        at = offset - first
        for array in arrays:
            if array.size:
                memory[at : at + array.nbytes] = array.data.cast("B")
                at += array.nbytes


def _stretches(parts: list[_Part], most: int) -> list[list[_Part]]:
    """Group what lies side by side, but for the roundings, into pieces that are staged at once."""
    found: list[list[_Part]] = []
    begin = end = -1
    for part in sorted(parts, key=itemgetter(0)):
        offset, nbytes, _ = part
        if not nbytes:
            continue
        if offset == end and offset + nbytes - begin <= most:
            found[-1].append(part)
        else:
            found.append([part])
            begin = offset
        end = offset + -(-nbytes // ALIGNMENT) * ALIGNMENT
    return found
