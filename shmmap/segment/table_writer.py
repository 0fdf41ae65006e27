# SPDX-License-Identifier: Apache-2.0
"""Writing a finished table of arrays, of whatever shapes, as a segment."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.segment.header import pack_header
from shmmap.segment.layout import Lattice, SegmentHeader, SourceStamp, header_size, plan_arrays
from shmmap.segment.writer import write_all

__all__ = ["SegmentOrigin", "write_table"]


@dataclass(frozen=True, slots=True)
class SegmentOrigin:
    """What a segment says about the cell and the file it was made from.

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
        What the header and handles count.
    reserve
        Called with the segment's size in bytes before anything is written; it refuses by raising.

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
