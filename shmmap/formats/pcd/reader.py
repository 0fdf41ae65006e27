# SPDX-License-Identifier: Apache-2.0
"""Read a PCD file directly into columns, block by block, in bounded memory.

The first column is ``xyz``, (N, 3); every other field follows as a column of its own, with its own dtype.
Points whose x, y or z is not finite are left out and counted.  Reading also yields the bounds of the points
and the XXH3-128 digest of the whole file.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import Bounds, ColumnSpec
from shmmap.formats.pcd.body import (
    ascii_blocks,
    check_sizes,
    compressed_blocks,
    decompress,
    field_arrays,
    record_blocks,
)
from shmmap.formats.pcd.fields import AXES
from shmmap.formats.pcd.header import HEADER_LIMIT_BYTES, PcdHeader, parse_header
from shmmap.formats.source_file import FileReader, refusal

Block = tuple[NDArray[Any], ...]

_DATA_LINE: Final = re.compile(rb"^[ \t]*DATA(?=\s)[^\n]*\n", re.MULTILINE | re.IGNORECASE)
_TAIL_READ_BYTES: Final = 1 << 18


class PcdReader(FileReader):
    """A PCD file, opened and its header checked; `blocks` reads the points.

    Parameters
    ----------
    keep_non_finite
        Keep points whose x, y or z is NaN or infinite.
    block_points
        Upper limit of rows per block; blocks of wide points are smaller.

    Attributes
    ----------
    header
        The checked `PcdHeader`.
    columns
        What `blocks` yields, in order.  ``xyz`` has the file's own type, float32 or float64; mixed and
        integer coordinates become the smaller of the two that holds every value (8 and 16-bit integers
        float32, wider ones float64).
    kept, dropped
        Points yielded and left out so far.
    digest
        XXH3-128 of the whole file (16 bytes, canonical order); empty until `blocks` is exhausted.

    Raises
    ------
    MapDataError
        From the constructor and from `blocks`, with a cause from `shmmap.formats.source_file`.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        keep_non_finite: bool = False,
        block_points: int = 1 << 16,
    ) -> None:
        super().__init__(path)
        self._keep = keep_non_finite
        self._block_points = block_points
        self._table = self.header.table
        self._bounds = Bounds()
        self._warnings: list[str] = []
        self.columns: tuple[ColumnSpec, ...] = self._table.columns
        self.kept = 0
        self.dropped = 0
        self.digest = b""

    def _read_header(self) -> None:
        head = self._source.head(_DATA_LINE, HEADER_LIMIT_BYTES)
        self.header: PcdHeader = parse_header(head, path=self.path, file_bytes=self._source.size)
        self._head = head[: self.header.data_offset]

    @property
    def record(self) -> np.dtype[np.void]:
        """Type of one point in a ``binary`` file: every field by its unique name, padding skipped."""
        return self._table.record

    def read_records(self, first: int, records: NDArray[np.void]) -> None:
        """Fill ``records``, of type `record`, with the points of a ``binary`` file from ``first`` on."""
        offset = self.header.data_offset + first * self.record.itemsize
        self._source.read_at(records.view(np.uint8), offset)

    @property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(min_xyz, max_xyz) of the finite points read so far, metres, map frame; NaN if there are none."""
        return self._bounds.result()

    @property
    def extremes(self) -> tuple[list[float], list[float]]:
        """Bounds as plain numbers, which is faster; +inf and -inf if there is no finite point."""
        return self._bounds.low, self._bounds.high

    @property
    def warnings(self) -> tuple[str, ...]:
        """Oddities of the header and of the data read so far."""
        return (*self.header.warnings, *self._warnings)

    def blocks(self) -> Iterator[Block]:
        """Yield the points, one C-contiguous array per column, all with the same number of rows.

        The arrays are reused, so a caller that keeps one must copy it.  Another call reads the file again
        from its start.
        """
        header, source = self.header, self._source
        self.kept = self.dropped = 0
        self.digest = b""
        self._bounds = Bounds()
        self._warnings.clear()
        source.start(self._head)
        if header.encoding == "binary":
            raw = record_blocks(source, header.points, self._table, self.record, self._block_points)
        elif header.encoding == "ascii":
            raw = ascii_blocks(source, header, self._block_points, self._warnings)
        else:
            raw = compressed_blocks(source, header, self._block_points)
        for block, axes in raw:
            mask = self._bounds.add(block[0], axes)
            if mask is None or self._keep:
                kept = block
            else:
                kept = tuple(column[mask] for column in block)
                self.dropped += len(mask) - len(kept[0])
            if len(kept[0]):
                self.kept += len(kept[0])
                yield kept
        left = source.left
        if left and header.encoding != "ascii":
            self._warnings.append(f"{left} bytes after the last point ignored")
        while source.left:
            source.read(min(source.left, _TAIL_READ_BYTES))
        self.digest = source.digest()

    def named_blocks(self, start: int) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns of the points from ``start`` on, of all that `blocks` yields."""
        return self._table.named(self.blocks(), start)


def expanded_blocks(
    reader: PcdReader, scratch_dir: str, block_points: int, start: int
) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the columns of the points from ``start`` on, including points that are not finite.

    Parameters
    ----------
    reader
        An open ``binary_compressed`` file.
    scratch_dir
        Directory for an unnamed temporary file, as large as the decompressed points.

    Raises
    ------
    MapDataError
        ``bad_lzf``, ``truncated`` or ``coordinate_range``.
    OSError
        The disk is full.
    """
    header = reader.header
    if start >= header.points:
        return
    size = os.fstat(reader.fileno()).st_size
    head = os.pread(reader.fileno(), 8, header.data_offset)
    body = header.data_offset + 8
    if len(head) < 8:
        raise refusal("truncated", "the file ends before its data", path=reader.path, offset=size)
    compressed_bytes, output_bytes = (int(part) for part in np.frombuffer(head, "<u4"))
    padded = check_sizes(header, compressed_bytes, output_bytes, left=size - body, path=reader.path)
    with tempfile.TemporaryFile(dir=scratch_dir) as file:
        os.posix_fallocate(file.fileno(), 0, output_bytes)  # a full disk raises an error, not SIGBUS
        data = np.memmap(file, np.uint8, mode="r+", shape=(output_bytes,))
        packed = np.memmap(reader.path, np.uint8, mode="r", offset=body, shape=(compressed_bytes,))
        decompress(packed, data, header, reader.path)
        del packed
        fields = field_arrays(data, header, padded=padded)
        for at in range(start, header.points, block_points):
            stop = min(at + block_points, header.points)
            block = {"xyz": np.empty((stop - at, 3), header.table.xyz_dtype)}
            for axis, name in enumerate(AXES):
                values = np.array(fields[name][at:stop])
                header.table.put_axis(block["xyz"], axis, values, reader.path)
            for spec in reader.columns[1:]:
                block[spec.name] = np.array(fields[spec.name][at:stop])
            yield block
