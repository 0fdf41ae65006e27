# SPDX-License-Identifier: Apache-2.0
"""A cell's points as builders want them: from its file, or from its ``points`` segment in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import SegmentCorrupt
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import refusal
from shmmap.layers.contract import Box, PointTable
from shmmap.layers.points import OutsideBox
from shmmap.quantities import format_bytes
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.verify import read_header

__all__ = ["MOST_SOURCE_BYTES", "CellSource", "read_segment", "read_source"]

MOST_SOURCE_BYTES: Final = 1 << 30
"""Points of one cell, uncompressed, that a layer is computed of: all of them are in a process's memory then.

A compressed file of a few megabytes may claim more.  A cloud that is served as one cell has fewer."""

SMALLER: Final = "divide the map into smaller cells"


@dataclass(slots=True)
class CellSource:
    """The finite points of a cell, and what is known of the file they come from."""

    points: PointTable
    stamp: SourceStamp
    digest: bytes
    source_points: int
    dropped_points: int
    z_min: float
    z_max: float
    outside_points: int = 0
    warnings: tuple[str, ...] = ()


def read_source(path: str, box: Box, needs: Sequence[str] | None) -> CellSource:
    """Read the columns that a layer needs (None: all) of a PCD file.

    Raises
    ------
    MapDataError
        If the file cannot be read, is too large (cause ``too_large``), or changed meanwhile (``changed``).
    """
    with PcdReader(path) as reader:
        _check_size(reader.header.points * reader.header.point_bytes, path)
        stamp = SourceStamp.of(os.fstat(reader.fileno()))
        wanted = [i for i, spec in enumerate(reader.columns) if needs is None or spec.name in needs]
        specs = [reader.columns[i] for i in wanted]
        rows = reader.header.points
        shapes = [(rows,) if spec.components == 1 else (rows, spec.components) for spec in specs]
        arrays = [np.empty(shape, spec.dtype) for shape, spec in zip(shapes, specs, strict=True)]
        at, outside = 0, OutsideBox(box)
        for block in reader.blocks():
            outside.add(block[0], *reader.extremes)
            end = at + len(block[0])
            if end > rows:
                break
            for array, i in zip(arrays, wanted, strict=True):
                array[at:end] = block[i]
            at = end
        if at != reader.kept or SourceStamp.of(os.fstat(reader.fileno())) != stamp:
            raise refusal("changed", "the file changed while it was being read", path=path)
        low, high = reader.bounds
        return CellSource(
            points=PointTable(
                {spec.name: array[:at] for spec, array in zip(specs, arrays, strict=True)},
                {spec.name: spec.unit for spec in specs},
                box,
            ),
            stamp=stamp,
            digest=reader.digest,
            source_points=rows,
            dropped_points=reader.dropped,
            z_min=float(low[2]),
            z_max=float(high[2]),
            outside_points=outside.count,
            warnings=reader.warnings,
        )


def read_segment(
    fd: int, box: Box, needs: Sequence[str] | None, header: SegmentHeader | None = None
) -> CellSource:
    """Read them from an open ``points`` segment; nothing of it stays mapped.

    Parameters
    ----------
    header
        Header of a segment that is not published yet; None: read it from the segment.

    Raises
    ------
    MapDataError
        If it is too large (cause ``too_large``).
    SegmentCorrupt
        If its header is not whole, or it is shorter than that says.
    OSError
        If it cannot be read.
    """
    if header is None:
        header, _ = read_header(fd)
    _check_size(sum(column.nbytes for column in header.columns), header.cell_id)
    columns: dict[str, NDArray[Any]] = {}
    for column in header.columns:
        if needs is None or column.name in needs:
            array: NDArray[Any] = np.empty(column.shape, column.dtype)
            left = array.data.cast("B") if array.size else memoryview(b"")
            at = column.offset
            while left:
                got = os.preadv(fd, [left], at)
                if not got:
                    raise SegmentCorrupt("the segment is shorter than its header says")
                left, at = left[got:], at + got
            columns[column.name] = array
    return CellSource(
        points=PointTable(columns, {c.name: c.unit for c in header.columns if c.name in columns}, box),
        stamp=header.source,
        digest=header.source_digest,
        source_points=header.source_points,
        dropped_points=header.dropped_points,
        z_min=header.z_min,
        z_max=header.z_max,
        outside_points=header.outside_points,
    )


def _check_size(nbytes: int, name: str) -> None:
    if nbytes > MOST_SOURCE_BYTES:
        raise refusal(
            "too_large",
            f"a layer is computed of at most {format_bytes(MOST_SOURCE_BYTES)} of points, not of"
            f" {format_bytes(nbytes)}",
            path=name,
            hint=SMALLER,
        )
