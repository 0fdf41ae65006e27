# SPDX-License-Identifier: Apache-2.0
"""Memory of maps for a device: read in place, or copied to one of two alternating buffers.

A map *in place* requires a device that can read any address of the process (fine-grained system SVM).
Nothing is copied to the device: the kernel uses the same table of cells as the compiled backend.

Other devices have two buffers of fixed size.  One holds the map in use, and the next map is written to the
other one meanwhile.  No memory is allocated later.
"""

from __future__ import annotations

import contextlib
import mmap
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher.backends.backend import DeviceMemory, UploadStatistics, device_errors
from shmmap_clients.ndt_scan_matcher.backends.opencl.devices import Device, Waiting
from shmmap_clients.ndt_scan_matcher.map.voxel_map import TABLE_COLUMNS, Covariance, VoxelCell, VoxelMap

_ALIGNMENT: Final = 64
_LARGE_PAGE: Final = 2 << 20
_SQUARE_SHIFT: Final = 3  # as in the kernel: 8 x 8 columns


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMap:
    """A map with one kind of covariance, as the kernel finds it.

    Attributes
    ----------
    buffer
        Buffer passed to the kernel.
    places
        Positions of four arrays: table of cells, their origins, start of each square's cells, and those
        cells.  Offsets into the buffer, or addresses where maps are read in place.
    lead
        Columns of the lattice between the first square's corner and the map's box, in i and j.
    squares
        Number of squares in a row along j.
    memory
        Objects that own the memory at these addresses, unless something else keeps it.
    """

    buffer: Any
    places: tuple[int, ...]
    lead: tuple[int, int]
    squares: int
    memory: object = None


class MapInPlace:
    """Keeps the tables of the map in use and of the next one, for a device that needs no copy.

    Parameters
    ----------
    context
        Context of the device.
    """

    used_bytes = 0  # on the device

    def __init__(self, context: Any) -> None:
        import pyopencl as cl

        self.statistics = UploadStatistics()
        # the kernel requires a buffer argument, but does not read it
        self._buffer = cl.Buffer(context, cl.mem_flags.READ_ONLY, 64)
        self._placed: dict[tuple[int, Covariance], tuple[VoxelMap, PlacedMap]] = {}
        self._current: VoxelMap | None = None
        self._lock = threading.Lock()

    def close(self) -> None:
        """Release the maps."""
        self._placed.clear()
        self._buffer.release()

    def prepare(self, voxel_map: VoxelMap, covariance: Covariance) -> None:
        """Build the tables of the next map; keep those of the map in use."""
        self._make(voxel_map, covariance)

    def use(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        """Return the placement of a map; the map used before may be dropped from now on."""
        self._current = voxel_map
        known = self._placed.get((id(voxel_map), covariance))
        return self._make(voxel_map, covariance) if known is None else known[1]

    def _make(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        with self._lock:
            known = self._placed.get((id(voxel_map), covariance))
            if known is not None:
                return known[1]
            tables, lead, squares = _tables(voxel_map, voxel_map.table(covariance))
            places = tuple(table.ctypes.data for table in tables)
            placed = PlacedMap(self._buffer, places, lead, squares, tables)
            kept = {id(voxel_map), id(self._current)}
            self._placed = {key: one for key, one in self._placed.items() if key[0] in kept}
            self._placed[(id(voxel_map), covariance)] = voxel_map, placed
            return placed


class _Half:
    """One of the two buffers, with the map in it."""

    def __init__(self, buffer: Any) -> None:
        self.buffer = buffer
        self.empty()

    def empty(self) -> None:
        """Release the map."""
        self.map: VoxelMap | None = None
        self.used_bytes = 0
        self.cells: NDArray[np.int64] = np.empty((2, 0), np.int64)  # offsets of lattices and means
        self.placed: dict[Covariance, PlacedMap] = {}


class MapBuffers:
    """Memory of one device for two maps; another thread may call `prepare` during matching.

    Parameters
    ----------
    context
        Context of the device.
    device
    map_bytes
        Size of each of the two buffers.

    Raises
    ------
    DeviceMemory
        The device has less memory.
    """

    def __init__(self, context: Any, device: Device, map_bytes: int) -> None:
        import pyopencl as cl

        self.statistics = UploadStatistics()
        self._device = device
        self._real = np.dtype(np.float64 if device.double else np.float32)
        self._map_bytes = map_bytes
        self._lock = threading.Lock()
        self._waiting = Waiting(device.info.name)
        with device_errors(device.info.name, f"allocate twice {map_bytes >> 20:,} MiB for maps"):
            flags = cl.mem_flags
            if device.is_processor:
                # the device reads this process's memory, so this process chooses the page size
                halves = [
                    cl.Buffer(
                        context, flags.READ_ONLY | flags.USE_HOST_PTR, hostbuf=in_large_pages(map_bytes)
                    )
                    for _ in range(2)
                ]
            else:
                halves = [cl.Buffer(context, flags.READ_ONLY, map_bytes) for _ in range(2)]
            # separate queue: no evaluation waits while a map is being written
            self._queue = cl.CommandQueue(context, device.handle)
        self._current, self._spare = map(_Half, halves)

    @property
    def used_bytes(self) -> int:
        """Bytes that maps take at present."""
        return self._current.used_bytes + self._spare.used_bytes

    def close(self) -> None:
        """Release the device's memory."""
        self._current.buffer.release()
        self._spare.buffer.release()

    def prepare(self, voxel_map: VoxelMap, covariance: Covariance) -> None:
        """Write a map to the buffer that is not in use; if it does not fit, `use` raises.

        Raises
        ------
        DeviceError
            The device cannot be written to.
        """
        with self._lock:
            half = self._current if self._current.map is voxel_map else self._spare
            if half.map is not voxel_map:
                half.empty()
            self._place(half, voxel_map, covariance)

    def use(self, voxel_map: VoxelMap, covariance: Covariance) -> PlacedMap:
        """Return the placement of a map; the map used before may be overwritten from now on.

        Raises
        ------
        DeviceMemory
            The map is larger than a buffer.
        """
        half = self._current
        if half.map is voxel_map and covariance in half.placed:
            return half.placed[covariance]
        with self._lock:
            if self._spare.map is voxel_map:
                self._current, self._spare = self._spare, self._current
            half = self._current
            if half.map is not voxel_map:
                half.empty()
            fits = self._place(half, voxel_map, covariance)
            if not fits and half.placed:
                # another kind of covariance occupies the space
                half.empty()
                self.statistics.laid_out_again += 1
                fits = self._place(half, voxel_map, covariance)
        if not fits:
            raise DeviceMemory(
                f"a map of {voxel_map.voxels} voxels takes more than the {self._map_bytes >> 20:,} MiB that"
                f" device {self._device.info.name!r} has for one",
                hint="VoxelMap(max_bytes=...) or --max-map-bytes leave out what is too much",
            )
        return half.placed[covariance]

    def _place(self, half: _Half, voxel_map: VoxelMap, covariance: Covariance) -> bool:
        """Write the missing parts of a map to a buffer; return False, with no change, if they do not fit."""
        if covariance in half.placed:
            return True
        real, cells = self._real, voxel_map.cells
        arrays: list[NDArray[Any]] = [
            np.ascontiguousarray(voxel_map.inverses(key, covariance), real) for key in cells
        ]
        if half.map is None:
            # lattices with i fastest
            arrays += [np.ascontiguousarray(cell.lattice.T, np.int32) for cell in cells.values()]
            arrays += [np.ascontiguousarray(self._means(cell), real) for cell in cells.values()]
        table = np.zeros((len(cells), TABLE_COLUMNS), np.int64)
        table[:, 3:] = voxel_map.boxes
        table[:, 7] = 1
        table[:, 8] = table[:, 11]
        table[:, 9] = table[:, 11] * table[:, 12]
        tables, lead, squares = _tables(voxel_map, table)
        arrays += tables
        lengths = np.array([-(-array.nbytes // _ALIGNMENT) * _ALIGNMENT for array in arrays], np.int64)
        ends: NDArray[np.int64] = half.used_bytes + np.cumsum(lengths)
        if ends[-1] > self._map_bytes:
            return False
        offsets = ends - lengths
        at_cells = offsets[len(cells) : -len(tables)].reshape(2, -1) if half.map is None else half.cells
        table[:, 0], table[:, 1] = at_cells
        table[:, 2] = offsets[: len(cells)]
        self._write(half.buffer, half.used_bytes, int(ends[-1]), offsets.tolist(), arrays)
        half.map, half.cells, half.used_bytes = voxel_map, at_cells, int(ends[-1])
        places = tuple(offsets[-len(tables) :].tolist())
        half.placed[covariance] = PlacedMap(half.buffer, places, lead, squares)
        return True

    def _means(self, cell: VoxelCell) -> NDArray[np.float64]:
        if self._device.double:
            return cell.mean
        # relative to the lattice's corner, which the kernel computes exactly
        return cell.mean + (cell.origin - cell.lattice_origin * cell.leaf)

    def _write(
        self, buffer: Any, first: int, end: int, offsets: Sequence[int], arrays: Sequence[NDArray[Any]]
    ) -> None:
        """Write arrays to their offsets, all within one range of a buffer."""
        import pyopencl as cl

        queue = self._queue
        with device_errors(self._device.info.name, "write a map"):
            there: Any  # mapped array; its base must be released
            there, mapped = cl.enqueue_map_buffer(
                queue,
                buffer,
                cl.map_flags.WRITE_INVALIDATE_REGION,
                first,
                (end - first,),
                np.dtype(np.uint8),
                is_blocking=False,
            )
            queue.flush()
            self._waiting.until(mapped)
            memory = there.data  # numpy would take three times as long for that many small pieces
            for offset, array in zip(offsets, arrays, strict=True):
                if array.size:
                    at = offset - first
                    memory[at : at + array.nbytes] = array.data.cast("B")
            written = there.base.release(queue)
            queue.flush()
            self._waiting.until(written)
        self.statistics.writes += 1
        self.statistics.written_bytes += end - first


def in_large_pages(nbytes: int) -> NDArray[np.uint8]:
    """Return memory aligned to a large page; the kernel allocates pages at first access.

    The first write of a 5 MB map causes 1300 page faults with pages of 4 KiB, which take 3 to 20 ms, but
    only three with pages of 2 MiB.

    Parameters
    ----------
    nbytes
        Size in bytes.

    Raises
    ------
    MemoryError
        The machine has less memory.
    """
    try:
        memory = mmap.mmap(-1, nbytes + _LARGE_PAGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError as error:
        raise MemoryError(f"{nbytes} bytes: {error.strerror}") from None
    with contextlib.suppress(OSError):  # a kernel without large pages: ordinary ones
        memory.madvise(mmap.MADV_HUGEPAGE)
    whole = np.frombuffer(memory, np.uint8)
    first = -whole.ctypes.data % _LARGE_PAGE
    return whole[first : first + nbytes]


def _tables(voxel_map: VoxelMap, table: NDArray[np.int64]) -> tuple[list[NDArray[Any]], tuple[int, int], int]:
    """Return the arrays of `PlacedMap.places` in their order, its ``lead`` and its ``squares``.

    The directory has an entry for each square of 8 x 8 columns instead of each column, so that little is
    written per map.  The kernel tests whether a cell really contains the column.

    Parameters
    ----------
    voxel_map
    table : (C, `TABLE_COLUMNS`) int64
        Table of the map's cells; the columns with addresses are ignored here.
    """
    first, shape = voxel_map.boxes[:, :2], voxel_map.boxes[:, 8:]
    low, squares = np.zeros(2, np.int64), 1
    start, square_cell = np.zeros(2, np.int32), np.zeros(1, np.int32)
    has = np.flatnonzero((shape > 0).all(axis=1))
    if len(has):
        begin = first[has] >> _SQUARE_SHIFT
        end = ((first[has] + shape[has] - 1) >> _SQUARE_SHIFT) + 1
        low, high = begin.min(axis=0), end.max(axis=0)
        rows, squares = (high - low).tolist()
        # pair every cell with each square from its first to its last
        across, along = (end - begin).T
        number = across * along
        cell = np.repeat(np.arange(len(has)), number)
        nth = np.arange(int(number.sum())) - np.repeat(np.cumsum(number) - number, number)
        i = begin[cell, 0] - low[0] + nth // along[cell]
        place = i * squares + begin[cell, 1] - low[1] + nth % along[cell]
        start = np.zeros(rows * squares + 1, np.int32)
        np.cumsum(np.bincount(place, minlength=rows * squares), out=start[1:])
        square_cell = has[cell[np.argsort(place, kind="stable")]].astype(np.int32)
    lead_i, lead_j = (voxel_map.box[:2] - (low << _SQUARE_SHIFT)).tolist()
    return [table, voxel_map.origins, start, square_cell], (lead_i, lead_j), squares
