# SPDX-License-Identifier: Apache-2.0
"""A computed layer of one cell, from its points to a finished segment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.formats.source_file import refusal
from shmmap.layers.build import build_spec
from shmmap.layers.contract import Box
from shmmap.layers.points import LAYER
from shmmap.layers.source_reader import FILES, SourceReader
from shmmap.layers.sources import SMALLER, CellSource
from shmmap.layers.spec import LayerSpec
from shmmap.segment.layout import NO_SOURCE, SegmentHeader, SourceStamp
from shmmap.segment.source import Source
from shmmap.segment.table_writer import SegmentOrigin, write_table
from shmmap.segment.version import cell_version, layer_version

__all__ = ["CellJob", "Derived", "Halo", "Neighbour", "combined_digest", "derive", "read_halo"]


class Neighbour(NamedTuple):
    """A cell that a layer of another one looks into: source, box in metres, id (empty: the source's name)."""

    source: Source
    box: Box
    cell_id: str = ""

    @classmethod
    def of(cls, cell_id: str, source: Source, box: Box) -> Neighbour:
        """Return the cell of this id."""
        return cls(source, box, "" if cell_id == source.name else cell_id)


@dataclass(frozen=True, slots=True)
class CellJob:
    """Which cell: id, source, box (metres), frame, and for a layer with a halo the cells around it.

    ``reader`` reads the sources; ``ready`` is the version of a layer that the origin has ready made, 0 of
    one that is computed.
    """

    cell_id: str
    source: Source
    box: Box
    frame_id: str = "map"
    neighbours: tuple[Neighbour, ...] = ()
    reader: SourceReader = FILES
    ready: int = 0

    def version(self, spec: LayerSpec, source: SourceStamp, around: Sequence[SourceStamp]) -> int:
        """Version of a layer of the cell for these states of its file and of its neighbours'."""
        cell = cell_version(self.cell_id, source.token, self.box)
        if spec.kind.name == LAYER:
            return cell
        near = [
            cell_version(one.cell_id or one.source.name, stamp.token, one.box)
            for one, stamp in zip(self.neighbours, around, strict=True)
        ]
        return layer_version(cell, str(spec), spec.builder_version, near)


@dataclass(frozen=True, slots=True)
class Derived:
    """A finished segment's header, and what was read for it.

    ``neighbours`` are the stamps of the neighbours' files, in the job's order.
    """

    header: SegmentHeader
    neighbours: tuple[SourceStamp, ...]
    warnings: tuple[str, ...]


def combined_digest(own: bytes, neighbours: Sequence[bytes]) -> bytes:
    """Digest of everything that a layer was computed from: the source's own where there is no more."""
    return xxhash.xxh3_128_digest(b"".join([own, *neighbours])) if neighbours else own


def derive(
    spec: LayerSpec,
    job: CellJob,
    fd: int,
    *,
    source: CellSource | None = None,
    reserve: Callable[[int], None] | None = None,
) -> Derived:
    """Build a layer of a cell into an empty segment file.

    Parameters
    ----------
    fd
        Empty file, open for writing; after an error its contents mean nothing.
    source
        The cell's points, where they are at hand; else its file is read.
    reserve
        Called with the segment's size in bytes before anything is written; it refuses by raising.

    Raises
    ------
    MapDataError
        If a file cannot be read, or its points cannot become this layer.
    OSError
        ENOSPC if the file system is full.
    """
    if source is None:
        source = job.reader.read(job.source, job.box, spec.source_columns)
    points, warnings = source.points, source.warnings
    around: tuple[tuple[SourceStamp, bytes], ...] = ()
    if job.neighbours:
        around_it = [near.source for near in job.neighbours]
        halo = read_halo(job.reader, around_it, job.box, spec.halo_m, points.xyz.dtype)
        points.halo, around, warnings = halo.xyz, halo.seen, (*warnings, *halo.warnings)
    table = build_spec(spec, points)
    header = write_table(
        fd,
        {name: np.ascontiguousarray(column) for name, column in table.columns.items()},
        layer=str(spec),
        rows=table.rows,
        origin=SegmentOrigin(
            cell_id=job.cell_id,
            box=job.box,
            frame_id=job.frame_id,
            source=source.stamp,
            source_digest=combined_digest(source.digest, [digest for _, digest in around]),
            source_points=source.source_points,
            dropped_points=source.dropped_points,
            outside_points=source.outside_points,
        ),
        builder_version=spec.builder_version,
        units=table.units,
        lattice=table.lattice,
        z_min=source.z_min,
        z_max=source.z_max,
        reserve=reserve,
    )
    return Derived(header, tuple(stamp for stamp, _ in around), warnings)


@dataclass(slots=True)
class Halo:
    """Points around a cell.

    Attributes
    ----------
    xyz
        (M, 3), of the cell's dtype.
    seen
        Each neighbour's stamp and digest.
    warnings
        Which neighbours have no points here, and why.
    """

    xyz: NDArray[Any]
    seen: tuple[tuple[SourceStamp, bytes], ...]
    warnings: tuple[str, ...]


def read_halo(
    reader: SourceReader, sources: Sequence[Source], box: Box, halo_m: float, dtype: np.dtype[Any]
) -> Halo:
    """Read the neighbours' points within ``halo_m`` of a cell's box, as ``dtype``.

    One that cannot be read has no points, the stamp of before the attempt and a digest of zeros: it must
    not cost its neighbours their layers.

    Raises
    ------
    MapDataError
        If there is not enough memory for a neighbour: another time there may be, so that no layer is
        made without it.
    """
    found: list[NDArray[Any]] = [np.empty((0, 3), dtype)]
    seen: list[tuple[SourceStamp, bytes]] = []
    warnings: list[str] = []
    for neighbour in sources:
        stamp = reader.stamp(neighbour)  # afterwards it may be that of a file that was never read
        before = SourceStamp.from_token(stamp) if stamp is not None else NO_SOURCE
        try:
            source = reader.read(neighbour, box, ("xyz",))
        except MapDataError as error:
            seen.append((before, bytes(16)))
            warnings.append(f"made without a neighbour: {error.message}")
            continue
        except MemoryError as error:
            raise refusal(
                "too_large",
                "this neighbour takes more memory than there is",
                path=neighbour.name,
                hint=SMALLER,
            ) from error
        xyz = source.points.xyz
        x, y = xyz[:, 0], xyz[:, 1]
        inside = (
            (x >= box[0] - halo_m) & (x <= box[2] + halo_m) & (y >= box[1] - halo_m) & (y <= box[3] + halo_m)
        )
        found.append(xyz[inside].astype(dtype))
        seen.append((source.stamp, source.digest))
    return Halo(np.concatenate(found), tuple(seen), tuple(warnings))
