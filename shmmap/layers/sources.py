# SPDX-License-Identifier: Apache-2.0
"""A cell's points as builders want them: from its file, or from its ``points`` segment in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError, SegmentCorrupt
from shmmap.formats.causes import refusal
from shmmap.formats.pcd.reader import PcdReader
from shmmap.layers.contract import Box, PointTable
from shmmap.segment.layout import NO_SOURCE, SourceStamp
from shmmap.segment.verify import read_header

__all__ = ["CellSource", "read_halo", "read_segment", "read_source", "state_of"]


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
    warnings: tuple[str, ...] = ()


def read_source(path: str, box: Box, needs: Sequence[str] | None) -> CellSource:
    """Read the columns that a layer needs (None: all) of a PCD file.

    Raises
    ------
    MapDataError
        If the file cannot be read, or changed meanwhile (cause ``changed``).
    """
    with PcdReader(path) as reader:
        stamp = SourceStamp.of(os.fstat(reader.fileno()))
        wanted = [i for i, spec in enumerate(reader.columns) if needs is None or spec.name in needs]
        specs = [reader.columns[i] for i in wanted]
        rows = reader.header.points
        shapes = [(rows,) if spec.components == 1 else (rows, spec.components) for spec in specs]
        arrays = [np.empty(shape, spec.dtype) for shape, spec in zip(shapes, specs, strict=True)]
        at = 0
        for block in reader.blocks():
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
            warnings=reader.warnings,
        )


def read_segment(fd: int, box: Box, needs: Sequence[str] | None) -> CellSource:
    """Read them from an open ``points`` segment; nothing of it stays mapped.

    Raises
    ------
    SegmentCorrupt
        If its header is not whole, or it is shorter than that says.
    OSError
        If it cannot be read.
    """
    header, _ = read_header(fd)
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
    )


def read_halo(
    paths: Sequence[str], box: Box, halo_m: float, dtype: np.dtype[Any]
) -> tuple[NDArray[Any], tuple[tuple[SourceStamp, bytes], ...]]:
    """Read the neighbours' points within ``halo_m`` of a cell's box, (M, 3) of ``dtype``.

    Also returns each neighbour's stamp and digest.  One that cannot be read has no points, the stamp of
    before the attempt and a digest of zeros: it must not cost its neighbours their layers.
    """
    found: list[NDArray[Any]] = [np.empty((0, 3), dtype)]
    seen: list[tuple[SourceStamp, bytes]] = []
    for path in paths:
        before = state_of(path)  # afterwards it may be that of a file that nobody has read
        try:
            source = read_source(path, box, ("xyz",))
        except MapDataError:
            seen.append((before, bytes(16)))
            continue
        xyz = source.points.xyz
        x, y = xyz[:, 0], xyz[:, 1]
        inside = (
            (x >= box[0] - halo_m) & (x <= box[2] + halo_m) & (y >= box[1] - halo_m) & (y <= box[3] + halo_m)
        )
        found.append(xyz[inside].astype(dtype))
        seen.append((source.stamp, source.digest))
    return np.concatenate(found), tuple(seen)


def state_of(path: str) -> SourceStamp:
    """Return the state of a file as it is now; zeros where it cannot be looked at."""
    try:
        return SourceStamp.of(os.stat(path))
    except OSError:
        return NO_SOURCE
