# SPDX-License-Identifier: Apache-2.0
"""A cell's points as builders need them, and their readers in loaders and preparing processes.

Points are read from the cell's file, from its ``points`` segment in memory, or by any other `SourceReader`,
such as that of a published map.  A reader that fetches gets several jobs at once and reports which one it
works on; the deadline of a job counts from that report.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import SegmentCorrupt
from shmmap.formats.pcd.reader import PcdReader
from shmmap.formats.source_file import refusal
from shmmap.layers.contract import Box, PointTable
from shmmap.layers.points import LAYER, OutsideBox, build_points
from shmmap.layers.spec import LayerSpec
from shmmap.quantities import format_bytes
from shmmap.segment.header import read_header
from shmmap.segment.layout import SegmentHeader, SourceStamp
from shmmap.segment.version import Source, Stamp, cell_version, layer_version

MAX_SOURCE_BYTES: Final = 1 << 30
"""Size limit of one cell's uncompressed points, as a layer's builder holds all of them in memory.

The header of a compressed file of a few megabytes may claim more.  A cloud served as one cell has fewer."""

SMALLER: Final = "divide the map into smaller cells"


@dataclass(slots=True)
class CellSource:
    """The finite points of a cell, with stamp, digest and statistics of their source."""

    points: PointTable
    stamp: SourceStamp
    digest: bytes
    source_points: int
    dropped_points: int
    z_min: float
    z_max: float
    outside_points: int = 0
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, header: SegmentHeader, columns: dict[str, NDArray[Any]], box: Box) -> CellSource:
        """Return the source with some columns of a ``points`` layer that has this header."""
        units = {column.name: column.unit for column in header.columns if column.name in columns}
        return cls(
            points=PointTable(columns, units, box),
            stamp=header.source,
            digest=header.source_digest,
            source_points=header.source_points,
            dropped_points=header.dropped_points,
            z_min=header.z_min,
            z_max=header.z_max,
            outside_points=header.outside_points,
        )


def read_source(path: str, box: Box, needs: Sequence[str] | None) -> CellSource:
    """Read the columns that a layer needs (None: all) of a PCD file.

    Raises
    ------
    MapDataError
        The file cannot be read, is too large (cause ``too_large``), or changed meanwhile (``changed``).
    """
    with PcdReader(path) as reader:
        check_size(reader.header.points * reader.header.point_bytes, path)
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


def read_segment(fd: int, box: Box, needs: Sequence[str] | None) -> CellSource:
    """Read the columns that a layer needs from an open ``points`` segment, which does not stay mapped.

    Raises
    ------
    MapDataError
        The segment is too large (cause ``too_large``).
    SegmentCorrupt
        The header is incomplete, or the segment is shorter than its header says.
    OSError
        The segment cannot be read.
    """
    header, _ = read_header(fd)
    check_size(sum(column.nbytes for column in header.columns), header.cell_id)
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
    return CellSource.of(header, columns, box)


def check_size(nbytes: int, name: str) -> None:
    """Raise MapDataError (cause ``too_large``) for more points than a layer is computed of."""
    if nbytes > MAX_SOURCE_BYTES:
        raise refusal(
            "too_large",
            f"a layer is computed of at most {format_bytes(MAX_SOURCE_BYTES)} of points, not of"
            f" {format_bytes(nbytes)}",
            path=name,
            hint=SMALLER,
        )


REPLACED: Final = "another directory has the map's name now: `shmmap reload` reads it"


class Fetcher(Protocol):
    """Fetches the sources of several jobs concurrently, before the jobs run one after the other.

    A source that cannot be fetched raises its error when the job reads it.
    """

    @property
    def fd(self) -> int:
        """File descriptor that is readable when `take_done` may return a job."""

    def begin(self, number: int, spec: LayerSpec, job: CellJob) -> None:
        """Begin to fetch the sources of a cell's layer, without waiting."""

    def take_done(self) -> int | None:
        """Return the number of a job whose fetches have succeeded or failed, once; None if there is none."""


class SourceReader(ABC):
    """Reads sources, which the map's origin names.

    A source that cannot be reached at present raises `shmmap.errors.Offline`.

    Attributes
    ----------
    fetcher
        Fetcher for several jobs at once; None: each job reads its sources when it runs.
    """

    fetcher: Fetcher | None = None

    @abstractmethod
    def stamp(self, source: Source) -> Stamp | None:
        """Return the present state of a source; None if it cannot be read."""

    @abstractmethod
    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the columns that a layer needs (None: all) of a cell's points.

        Raises
        ------
        MapDataError
            The source cannot be read, or is too large.
        """

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        """Fill an empty segment file with a layer that the source contains; None: it must be computed.

        Parameters and errors are as in `shmmap.layers.build.make_layer`.
        """
        del spec, job, fd, reserve, warn
        return None

    def named(self, message: str) -> str:
        """Return a message in which sources have the names that users know."""
        return message

    def explain(self, source: Source, message: str) -> str:
        """Return a message that explains why a source could not be read, with names that users know."""
        del source
        return message

    def take_counts(self) -> tuple[int, ...]:
        """Return counts of objects read since the last call, in the order of `OBJECTS_READ`, or ()."""
        return ()


class Files(SourceReader):
    """Sources that are PCD files.

    Parameters
    ----------
    at
        Translates a path into the path under which this process can open the file.
    named
        Replaces such paths in a message by the original ones.
    """

    def __init__(self, at: Callable[[str], str] = str, named: Callable[[str], str] = str) -> None:
        self._at, self._named = at, named

    def stamp(self, source: Source) -> Stamp | None:
        """Return the state of the file from ``stat``; None if that fails."""
        try:
            return SourceStamp.of(os.stat(self._at(source.name))).token
        except OSError:
            return None

    def read(self, source: Source, box: Box, needs: Sequence[str] | None) -> CellSource:
        """Read the file, see `shmmap.layers.sources.read_source`."""
        return read_source(self._at(source.name), box, needs)

    def fill(
        self,
        spec: LayerSpec,
        job: CellJob,
        fd: int,
        *,
        reserve: Callable[[int], None] | None,
        warn: Callable[[str], None],
    ) -> SegmentHeader | None:
        """Stream the file into the segment if the layer is ``points``; do nothing for others."""
        if spec.kind.name != LAYER:
            return None
        return build_points(
            self._at(job.source.name),
            fd,
            cell_id=job.cell_id,
            box=job.box,
            frame_id=job.frame_id,
            reserve=reserve,
            warn=warn,
        )

    def named(self, message: str) -> str:
        """Return a message with the files' original paths."""
        return self._named(message)

    def explain(self, source: Source, message: str) -> str:
        """Return a message with original paths; it adds whether the map's path now is another directory."""
        place = self._at(source.name)
        if place != source.name and self.stamp(source) is None and os.path.exists(source.name):
            return f"{source.name}: {REPLACED}"
        return self._named(message)


FILES: Final = Files()
"""Reader of files by their unchanged paths."""


class Neighbour(NamedTuple):
    """A neighbouring cell whose points a layer uses: source, box in metres, id (empty: the source's name)."""

    source: Source
    box: Box
    cell_id: str = ""

    @classmethod
    def of(cls, cell_id: str, source: Source, box: Box) -> Neighbour:
        """Return the neighbour with this id."""
        return cls(source, box, "" if cell_id == source.name else cell_id)


@dataclass(frozen=True, slots=True)
class CellJob:
    """Cell of a job: id, source, box (metres), frame, and for a layer with a halo the cells around it.

    ``reader`` reads the sources.  ``ready`` is the version of a published layer; 0 for a layer that is
    computed.
    """

    cell_id: str
    source: Source
    box: Box
    frame_id: str = "map"
    neighbours: tuple[Neighbour, ...] = ()
    reader: SourceReader = FILES
    ready: int = 0

    def version(self, spec: LayerSpec, source: SourceStamp, around: Sequence[SourceStamp]) -> int:
        """Return a layer's version for these states of the cell's source and of its neighbours' sources."""
        cell = cell_version(self.cell_id, source.token, self.box)
        if spec.kind.name == LAYER:
            return cell
        near = [
            cell_version(one.cell_id or one.source.name, stamp.token, one.box)
            for one, stamp in zip(self.neighbours, around, strict=True)
        ]
        return layer_version(cell, str(spec), spec.builder_version, near)
