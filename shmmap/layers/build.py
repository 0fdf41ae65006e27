# SPDX-License-Identifier: Apache-2.0
"""Builds layers from plain arrays, or for one cell into a segment file.

`build_layer` runs the same builders as the daemon's loaders, without a daemon::

    from shmmap.layers import build_layer

    ndt = build_layer("ndt(leaf=2.0)", xyz)
    ndt["mean"], ndt["inverse_covariance"], ndt.lattice

`make_layer` fills a segment file from the disk cache, or else builds the layer and keeps it there.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.errors import BadRequest, CannotWrite, InternalError, MapDataError
from shmmap.formats.source_file import refusal
from shmmap.kernel_cache import all_kept, compiled_mark
from shmmap.layers.contract import BUILT_ANYWHERE, Box, Columns, LayerTable, PointTable
from shmmap.layers.disk_cache import CacheKey, LayerCache
from shmmap.layers.sources import SMALLER, CellJob, CellSource, SourceReader
from shmmap.layers.spec import LayerSpec, parse_layer
from shmmap.lazy_imports import needed_packages
from shmmap.logfmt import log
from shmmap.segment.layout import NO_SOURCE, SegmentHeader, SourceStamp
from shmmap.segment.version import Source
from shmmap.segment.writer import SegmentOrigin, write_table


def build_layer(
    layer: str | LayerSpec,
    points: NDArray[np.generic] | Mapping[str, NDArray[np.generic]],
    *,
    units: Mapping[str, str] | None = None,
    box: Box = BUILT_ANYWHERE,
    halo: NDArray[np.generic] | None = None,
) -> LayerTable:
    """Build one layer of a cloud.

    Parameters
    ----------
    layer
        A layer spec, such as ``voxel(leaf=0.5)``.
    points
        (N, 3) float32 or float64, metres; or named columns, ``xyz`` among them, all of N rows.
        Other dtypes of coordinates become float64.
    units
        Unit of each column, copied into the result.
    box
        (min_x, min_y, max_x, max_y) of the cell, metres; only kinds with a halo use it.
    halo
        (M, 3) coordinates of points around the cell, for kinds with a halo.

    Returns
    -------
    The layer, without points that are not finite.

    Raises
    ------
    BadRequest
        The spec or the arrays are invalid.
    MapDataError
        The layer cannot be computed from these points.
    PackageMissing
        A package that the builder needs is not installed.
    """
    spec = parse_layer(layer) if isinstance(layer, str) else layer
    given = points if isinstance(points, Mapping) else {"xyz": points}
    columns = _checked(given)
    around = None
    if halo is not None:
        around = np.ascontiguousarray(_checked({"xyz": halo})["xyz"], columns["xyz"].dtype)
    with needed_packages(f"layer {spec.kind.name}"):
        return build_spec(spec, PointTable(columns, dict(units or {}), box, around))


def build_spec(spec: LayerSpec, points: PointTable) -> LayerTable:
    """Build a layer, and first the layers it is built of, from the source's points."""
    if spec.of is not None:
        below = build_spec(spec.of, points)
        points = PointTable(below.columns, below.units, points.box)
    table = spec.kind.build(points, spec.parameters)
    for name, column in table.columns.items():
        if not column.flags.c_contiguous or column.dtype.kind not in "fiu" or column.ndim > 4:
            raise InternalError(f"{spec.kind.name}: column {name} is not a contiguous numeric array")
    return table


def _checked(columns: Mapping[str, NDArray[np.generic]]) -> Columns:
    if "xyz" not in columns:
        raise BadRequest("points need a column xyz")
    checked = {name: np.ascontiguousarray(column) for name, column in columns.items()}
    xyz = checked["xyz"]
    if xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        raise BadRequest(f"xyz must have shape (N, 3), not {xyz.shape} of {xyz.dtype}")
    if xyz.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        checked["xyz"] = xyz.astype(np.float64)
    for name, column in checked.items():
        if column.ndim not in (1, 2) or len(column) != len(xyz) or column.dtype.kind not in "fiu":
            raise BadRequest(
                f"column {name!r} must be numeric with {len(xyz)} rows, not {column.shape} of {column.dtype}"
            )
    return checked


@dataclass(frozen=True, slots=True)
class Made:
    """A finished segment.

    Attributes
    ----------
    version
        Version of the layer, for the states of the sources that it was made from.
    neighbours
        States of the neighbours' sources that the version covers.
    cached
        Whether the layer was read from the cache.
    """

    header: SegmentHeader
    version: int
    neighbours: tuple[SourceStamp, ...] = ()
    warnings: tuple[str, ...] = ()
    cached: bool = False


def combined_digest(own: bytes, neighbours: Sequence[bytes]) -> bytes:
    """Return the digest of a layer's inputs: the source's own digest if no neighbour was used."""
    return xxhash.xxh3_128_digest(b"".join([own, *neighbours])) if neighbours else own


def derive(
    spec: LayerSpec,
    job: CellJob,
    fd: int,
    *,
    source: CellSource | None = None,
    reserve: Callable[[int], None] | None = None,
) -> Made:
    """Build a layer of a cell into an empty segment file.

    Parameters
    ----------
    fd
        Empty file, open for writing; after an error its content is undefined.
    source
        The cell's points, if already in memory; None: the cell's file is read.
    reserve
        Called with the segment's size in bytes before anything is written; raises to refuse it.

    Raises
    ------
    MapDataError
        A file cannot be read, or the layer cannot be computed from its points.
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
    neighbours = tuple(stamp for stamp, _ in around)
    return Made(header, job.version(spec, header.source, neighbours), neighbours, warnings)


@dataclass(slots=True)
class Halo:
    """Points around a cell.

    Attributes
    ----------
    xyz
        (M, 3), of the cell's dtype.
    seen
        Stamp and digest of each neighbour.
    warnings
        The neighbours that could not be read, and why.
    """

    xyz: NDArray[Any]
    seen: tuple[tuple[SourceStamp, bytes], ...]
    warnings: tuple[str, ...]


def read_halo(
    reader: SourceReader, sources: Sequence[Source], box: Box, halo_m: float, dtype: np.dtype[Any]
) -> Halo:
    """Read the neighbours' points within ``halo_m`` of a cell's box, as ``dtype``.

    A neighbour that cannot be read contributes no points, the stamp from before the attempt and a digest of
    zeros, so that the cell still gets its layer.

    Raises
    ------
    MapDataError
        There is not enough memory for a neighbour.  As a later attempt may succeed, no layer is made without
        that neighbour.
    """
    found: list[NDArray[Any]] = [np.empty((0, 3), dtype)]
    seen: list[tuple[SourceStamp, bytes]] = []
    warnings: list[str] = []
    for neighbour in sources:
        before = _state(reader, neighbour)  # before reading: later it may be that of another file
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


def cache_key(spec: LayerSpec, job: CellJob) -> CacheKey | None:
    """Return a layer's key for the present state of its sources; None if the cell's file cannot be read."""
    source = _state(job.reader, job.source)
    if source is NO_SOURCE:
        return None
    return CacheKey(spec, job, source, tuple(_state(job.reader, near.source) for near in job.neighbours))


def _state(reader: SourceReader, source: Source) -> SourceStamp:
    """Return the present state of a source; zeros if it cannot be read."""
    stamp = reader.stamp(source)
    return SourceStamp.from_token(stamp) if stamp is not None else NO_SOURCE


def make_layer(
    spec: LayerSpec,
    job: CellJob,
    fd: int,
    *,
    cache: LayerCache | None = None,
    keep: bool = False,
    source: Callable[[], CellSource | None] | None = None,
    reserve: Callable[[int], None] | None = None,
) -> Made:
    """Fill an empty segment file with a layer.

    Parameters
    ----------
    fd
        Empty file, open for reading and writing; after an error its content is undefined.
    cache, keep
        Cache that is searched first, and whether to store a built layer in it.
    source
        Returns the cell's points if they are in memory, else None; called only for computed layers.
    reserve
        Called with the segment's size in bytes before anything is written; raises to refuse it.

    Raises
    ------
    MapDataError
        A file cannot be read, or the layer cannot be computed from its points.
    OSError
        ENOSPC if the file system is full.
    """
    if job.ready:
        cache = None  # published layers are kept by their origin
    key = cache_key(spec, job) if cache is not None else None
    if cache is not None and key is not None:
        header = cache.load(key, fd, reserve=reserve)
        if header is not None:
            return Made(header, key.version, key.neighbours, cached=True)
    warnings: list[str] = []
    header = job.reader.fill(spec, job, fd, reserve=reserve, warn=warnings.append)
    if header is not None:
        version = job.ready or job.version(spec, header.source, ())
        made = Made(header, version, warnings=tuple(warnings))
    else:
        made = derive(spec, job, fd, source=source() if source is not None else None, reserve=reserve)
    if keep and cache is not None and cache.writable and key is not None:
        try:
            cache.store(CacheKey(spec, job, made.header.source, made.neighbours), made.header, fd)
        except OSError as error:  # a layer does not fail because the cache's disk is full
            cache.writable = False
            log.warning("layers not kept on disk", cache_dir=cache.directory, error=error)
    return made


def keep_layer(
    spec: LayerSpec,
    job: CellJob,
    cache: LayerCache,
    *,
    source: Callable[[], CellSource | None] | None = None,
) -> int:
    """Compute a layer into the cache, without a segment; return its bytes.

    Parameters
    ----------
    source
        As in `make_layer`.

    Raises
    ------
    MapDataError
        As in `make_layer`.
    CannotWrite
        The cache has no room for it, or cannot be written.
    """
    fd = os.memfd_create("layer", os.MFD_CLOEXEC)
    try:
        made = make_layer(spec, job, fd, source=source)
        key = CacheKey(spec, job, made.header.source, made.neighbours)
        try:
            stored = cache.store(key, made.header, fd)
        except OSError as error:
            raise CannotWrite(f"{cache.directory}: {error.strerror or error}") from error
        if not stored:
            raise CannotWrite(f"{cache.directory}: there is no room for it")
        return made.header.total_bytes
    finally:
        os.close(fd)


def compile_kernels(*, wait: bool = True) -> None:
    """Compile the kernels that are not compiled yet, if the result can be kept on disk.

    Parameters
    ----------
    wait
        Wait for another process that is compiling them; else return at once.

    Raises
    ------
    MemoryError
        There is not enough memory for the compiler.
    """
    mark = compiled_mark()
    if mark is None or mark.is_file():
        return
    with contextlib.ExitStack() as stack:
        try:
            lock = stack.enter_context(mark.with_suffix(".lock").open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError:  # another process compiles, or nothing can be kept: then each process compiles
            return
        from shmmap.layers import kernels  # the import compiles them

        del kernels
        if all_kept():
            with contextlib.suppress(OSError):
                mark.touch()
