# SPDX-License-Identifier: Apache-2.0
"""The ``points`` layer: the source's points, with every field as a column, bits unchanged."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.pcd.reader import Block, PcdReader
from shmmap.formats.source_file import refusal
from shmmap.layers.contract import (
    OTHER_FIELDS,
    LayerColumn,
    LayerKind,
    LayerTable,
    Parameters,
    PointTable,
)
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.writer import SegmentWriter

LAYER: Final = "points"
BUILDER_VERSION: Final = 1  # increase it when the same source would give other bytes


def build_points(
    source: str,
    segment_fd: int,
    *,
    cell_id: str,
    box: tuple[float, float, float, float],
    frame_id: str = "map",
    reserve: Callable[[int], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> SegmentHeader:
    """Stream a PCD file into an empty segment file.

    The file is copied block by block through a buffer, so memory does not grow with the cell.  A file with
    points that are not finite is read twice: the first pass counts the finite points.

    Parameters
    ----------
    source
        Path of the PCD file.
    segment_fd
        Empty file on the shared-memory file system, open for reading and writing.  After an error
        its content is undefined.
    cell_id, box, frame_id
        Values for the segment's header; ``box`` is (min_x, min_y, max_x, max_y) in metres.
    reserve
        Called with the segment's size in bytes before anything is allocated; raises to refuse it.
    warn
        Called with a message for each oddity of the file.

    Returns
    -------
    The header as written, publish block empty.

    Raises
    ------
    MapDataError
        The file cannot be read, or changed while it was read (cause ``changed``).
    OSError
        ENOSPC if the file system is full.
    """
    with PcdReader(source) as reader:
        stamp = SourceStamp.of(os.fstat(reader.fileno()))
        rows = reader.header.points
        writer = _started(reader, rows, segment_fd, reserve, cell_id, box, frame_id)
        outside = OutsideBox(box)
        for block in reader.blocks():
            outside.add(block[0], *reader.extremes)
            if not reader.dropped:  # after a dropped point, this pass only counts
                _append(writer, block)
        if reader.dropped:
            rows = reader.kept
            os.ftruncate(segment_fd, 0)
            writer = _started(reader, rows, segment_fd, reserve, cell_id, box, frame_id)
            for block in reader.blocks():
                if reader.kept <= rows:
                    _append(writer, block)
        if reader.kept != rows or SourceStamp.of(os.fstat(reader.fileno())) != stamp:
            raise refusal("changed", "the file changed while it was being read", path=reader.path)
        if warn is not None:
            for warning in reader.warnings:
                warn(warning)
        low, high = reader.bounds
        return writer.finish(
            z_min=float(low[2]),
            z_max=float(high[2]),
            source=stamp,
            source_digest=reader.digest,
            source_points=reader.header.points,
            dropped_points=reader.dropped,
            builder_version=BUILDER_VERSION,
            outside_points=outside.count,
        )


def _started(
    reader: PcdReader,
    rows: int,
    segment_fd: int,
    reserve: Callable[[int], None] | None,
    cell_id: str,
    box: tuple[float, float, float, float],
    frame_id: str,
) -> SegmentWriter:
    writer = SegmentWriter(reader.columns, rows, cell_id=cell_id, layer=LAYER, box=box, frame_id=frame_id)
    if reserve is not None:
        reserve(writer.total_bytes)
    writer.start(segment_fd)
    return writer


def _append(writer: SegmentWriter, block: Block) -> None:
    for index, column in enumerate(block):
        writer.append(index, column)


def _from_arrays(points: PointTable, parameters: Parameters) -> LayerTable:
    """Build the layer from arrays: the finite points, with every column."""
    del parameters
    return points.selected(points.finite())


POINTS: Final = LayerKind(
    name=LAYER,
    builder_version=BUILDER_VERSION,
    summary="the source itself: every field a column, the bits unchanged",
    borders="each point is in the cell whose file has it",
    parameters=(),
    columns=(
        LayerColumn("xyz", None, "(rows, 3)", "m", "coordinates", "map"),
        OTHER_FIELDS,
    ),
    build=_from_arrays,
    gives_points=True,
    takes_layers=False,
    needs=None,
    bytes_ratio=1.0,
)


class OutsideBox:
    """Counts points outside a box by more than float32 rounding; nearly free if there are none.

    Attributes
    ----------
    count
        Points outside so far.
    """

    def __init__(self, box: tuple[float, float, float, float]) -> None:
        self._box = box
        # the writer of the file may have rounded to float32 across the border
        step = float(np.spacing(np.float32(max(map(abs, box)))))
        self._low = box[0] - step, box[1] - step
        self._high = box[2] + step, box[3] + step
        self.count = 0

    def add(self, xyz: NDArray[Any], low: Sequence[float], high: Sequence[float]) -> None:
        """Count the outside points of a block (N, 3); the bounds are of all points so far, this block too."""
        inside_x = low[0] >= self._low[0] and high[0] <= self._high[0]
        if inside_x and low[1] >= self._low[1] and high[1] <= self._high[1]:
            return
        outside = np.zeros(len(xyz), np.bool_)
        for axis in (0, 1):
            column = np.ascontiguousarray(xyz[:, axis])
            if column.dtype.kind != "f":
                column = column.astype(np.float64)
            # limits in the points' dtype, rounded outwards, as comparing different dtypes is much slower
            least = np.nextafter(column.dtype.type(self._low[axis]), column.dtype.type(-np.inf))
            most = np.nextafter(column.dtype.type(self._high[axis]), column.dtype.type(np.inf))
            outside |= column < least
            outside |= column > most
        self.count += int(np.count_nonzero(outside))
