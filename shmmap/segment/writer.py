# SPDX-License-Identifier: Apache-2.0
"""Write a segment into a file descriptor: columns in blocks of rows, or a finished table of arrays.

All data is written by ``pwrite``: that is twice as fast as filling a fresh mapping, and a full file system is
an error (ENOSPC) instead of SIGBUS.  The header is written last, so that an incomplete segment is never
valid.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.failpoints import step
from shmmap.segment.header import pack_header
from shmmap.segment.layout import (
    Column,
    Lattice,
    SegmentHeader,
    SourceStamp,
    header_size,
    plan_arrays,
    plan_columns,
)

PIECE_BYTES: Final = 1 << 16
"""Bytes per write, about 30 us: between writes other work may run on this processor.  Otherwise a client just
woken by its reply would wait until the loader on the same processor blocks."""


def write_all(fd: int, data: memoryview, offset: int) -> None:
    """Write all of ``data`` at ``offset``, continuing after short writes."""
    while data:
        written = os.pwrite(fd, data[:PIECE_BYTES], offset)
        data = data[written:]
        offset += written
        os.sched_yield()


class SegmentWriter:
    """Streams columns into a segment of known row count.

    Parameters
    ----------
    specs
        The columns, in the order `append` numbers them.
    rows
        Exact number of rows of every column.
    cell_id, layer, box, frame_id
        The cell, layer, box and frame that the segment contains.

    Attributes
    ----------
    total_bytes
        Size of the finished segment, to be reserved before `start`.
    """

    def __init__(
        self,
        specs: Sequence[ColumnSpec],
        rows: int,
        *,
        cell_id: str,
        layer: str,
        box: tuple[float, float, float, float],
        frame_id: str = "map",
    ) -> None:
        self._header_bytes = header_size(len(specs), cell_id, layer, frame_id)
        self._columns, self.total_bytes = plan_columns(specs, rows, self._header_bytes)
        self._hashes = [xxhash.xxh3_64() for _ in specs]
        self._at = [column.offset for column in self._columns]
        self._fd = -1
        self._header = SegmentHeader(
            cell_id=cell_id,
            layer=layer,
            columns=self._columns,
            rows=rows,
            box=box,
            header_bytes=self._header_bytes,
            total_bytes=self.total_bytes,
            frame_id=frame_id,
        )

    def start(self, fd: int) -> None:
        """Set the empty file to write into.

        Nothing is allocated here: ``pwrite`` writes every page and reports ENOSPC itself, so no page is
        missing for a reader (SIGBUS).  Allocating first would cost 4 % of a load.
        """
        os.ftruncate(fd, self.total_bytes)
        self._fd = fd

    def append(self, column: int, rows: NDArray[np.generic]) -> None:
        """Append a C-contiguous block of rows to column number ``column``."""
        step("worker.write")
        data = _bytes(rows)
        self._hashes[column].update(data)
        write_all(self._fd, data, self._at[column])
        self._at[column] += len(data)

    def finish(
        self,
        *,
        z_min: float,
        z_max: float,
        source: SourceStamp,
        source_digest: bytes,
        source_points: int,
        dropped_points: int,
        builder_version: int,
        outside_points: int = 0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> SegmentHeader:
        """Write the header, which completes the segment.

        Raises
        ------
        ValueError
            A column did not receive exactly its number of rows.
        """
        columns: list[Column] = []
        for column, end, digest in zip(self._columns, self._at, self._hashes, strict=True):
            if end != column.offset + column.nbytes:
                raise ValueError(
                    f"column {column.name!r}: {end - column.offset} of {column.nbytes} bytes written"
                )
            columns.append(msgspec.structs.replace(column, checksum=digest.intdigest()))
        header = msgspec.structs.replace(
            self._header,
            columns=tuple(columns),
            z_min=z_min,
            z_max=z_max,
            origin=origin,
            source=source,
            source_digest=source_digest,
            source_points=source_points,
            dropped_points=dropped_points,
            builder_version=builder_version,
            outside_points=outside_points,
        )
        step("worker.header")
        write_all(self._fd, memoryview(pack_header(header)), 0)
        return header


@dataclass(frozen=True, slots=True)
class SegmentOrigin:
    """The parts of a segment's header about its cell and its source file.

    ``box`` (min_x, min_y, max_x, max_y) in metres; ``source_points``, ``dropped_points`` and
    ``outside_points`` count the file's points, those left out as not finite, those outside the box.
    """

    cell_id: str
    box: tuple[float, float, float, float]
    frame_id: str
    source: SourceStamp
    source_digest: bytes
    source_points: int
    dropped_points: int
    outside_points: int = 0


def write_table(
    fd: int,
    columns: Mapping[str, NDArray[np.generic]],
    *,
    layer: str,
    rows: int,
    origin: SegmentOrigin,
    builder_version: int,
    units: Mapping[str, str],
    lattice: Lattice | None,
    z_min: float,
    z_max: float,
    reserve: Callable[[int], None] | None = None,
) -> SegmentHeader:
    """Write arrays into an empty segment file, header last.

    Parameters
    ----------
    fd
        Empty file, open for writing.
    columns
        C-contiguous little-endian arrays of up to four dimensions, in order.
    rows
        Number of rows in the header and in handles.
    reserve
        Called with the segment's size in bytes before anything is written; raises to refuse.

    Returns
    -------
    The header as written, publish block empty.

    Raises
    ------
    OSError
        ENOSPC if the file system is full.
    ValueError
        If a column does not fit the layout (name, unit, dtype).
    """
    header_bytes = header_size(len(columns), origin.cell_id, layer, origin.frame_id)
    placed, total_bytes = plan_arrays(columns, units, header_bytes)
    header = SegmentHeader(
        cell_id=origin.cell_id,
        layer=layer,
        columns=tuple(
            msgspec.structs.replace(column, checksum=xxhash.xxh3_64_intdigest(_bytes(array)))
            for column, array in zip(placed, columns.values(), strict=True)
        ),
        rows=rows,
        box=origin.box,
        header_bytes=header_bytes,
        total_bytes=total_bytes,
        z_min=z_min,
        z_max=z_max,
        source_points=origin.source_points,
        dropped_points=origin.dropped_points,
        outside_points=origin.outside_points,
        source=origin.source,
        source_digest=origin.source_digest,
        builder_version=builder_version,
        frame_id=origin.frame_id,
        lattice=lattice,
    )
    page = pack_header(header)
    if reserve is not None:
        reserve(total_bytes)
    os.ftruncate(fd, total_bytes)
    for column, array in zip(placed, columns.values(), strict=True):
        write_all(fd, _bytes(array), column.offset)
    write_all(fd, memoryview(page), 0)
    return header


def _bytes(array: NDArray[np.generic]) -> memoryview:
    return array.data.cast("B") if array.size else memoryview(b"")
