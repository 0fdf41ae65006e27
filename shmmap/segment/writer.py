# SPDX-License-Identifier: Apache-2.0
"""Writing a segment into a file descriptor, column by column, in blocks of rows.

Everything goes through ``pwrite``: twice as fast as filling a fresh mapping, and a full file
system is an error (ENOSPC) instead of SIGBUS.  The header is written last, so that a half-written
segment never looks like one.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.failpoints import step
from shmmap.segment.header import pack_header
from shmmap.segment.layout import Column, SegmentHeader, SourceStamp, header_size, plan_columns

__all__ = ["SegmentWriter", "write_all"]


PIECE_BYTES: Final = 1 << 16
"""Written at a time, in 30 us: in between, whoever else has work for this processor is let in.  A client that
its reply has just woken would else wait until the loader beside it has to wait for something."""


def write_all(fd: int, data: memoryview, offset: int) -> None:
    """Write all of ``data`` at ``offset``; a short write is continued where it stopped."""
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
        What the segment describes.

    Attributes
    ----------
    total_bytes
        Size of the finished segment: what must be reserved before `start`.
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
        """Take the empty file to write into.

        Nothing is allocated here: ``pwrite`` reaches every page and says ENOSPC itself, so no page is
        left for a reader to stumble over (SIGBUS), and allocating first costs 4 % of a load.
        """
        os.ftruncate(fd, self.total_bytes)
        self._fd = fd

    def append(self, column: int, rows: NDArray[np.generic]) -> None:
        """Append a C-contiguous block of rows to column number ``column``."""
        step("worker.write")
        data = rows.data.cast("B") if rows.size else memoryview(b"")
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
        """Write the header; the segment is whole after this.

        Raises
        ------
        ValueError
            If a column did not get exactly its rows.
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
