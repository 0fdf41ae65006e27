# SPDX-License-Identifier: Apache-2.0
"""One layer of one cell into a segment file: out of the disk cache where it is there, else built and kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shmmap.layers.derive import CellJob, derive
from shmmap.layers.disk_cache import CacheKey, LayerCache
from shmmap.layers.sources import CellSource
from shmmap.layers.spec import LayerSpec
from shmmap.logfmt import log
from shmmap.segment.layout import NO_SOURCE, SegmentHeader, SourceStamp
from shmmap.segment.source import Source

__all__ = ["Made", "cache_key", "make_layer"]


@dataclass(frozen=True, slots=True)
class Made:
    """A finished segment.

    Attributes
    ----------
    version
        Of the layer, for the states of the sources that it was made from.
    neighbours
        States of the neighbours' sources that it stands for.
    cached
        It came out of the cache.
    """

    header: SegmentHeader
    version: int
    neighbours: tuple[SourceStamp, ...] = ()
    warnings: tuple[str, ...] = ()
    cached: bool = False


def cache_key(spec: LayerSpec, job: CellJob) -> CacheKey | None:
    """Key of a layer for the sources as they are now; None where the cell's own cannot be looked at."""
    source = _state(job, job.source)
    if source is NO_SOURCE:
        return None
    return CacheKey(spec, job, source, tuple(_state(job, near.source) for near in job.neighbours))


def _state(job: CellJob, source: Source) -> SourceStamp:
    """State of a source as it is now; zeros where it cannot be looked at."""
    stamp = job.reader.stamp(source)
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
        Empty file, open for reading and writing; after an error its contents mean nothing.
    cache, keep
        Where to look first, and whether to store what was built.
    source
        Returns the cell's points where they are at hand, else None; asked only for computed layers.
    reserve
        Called with the segment's size in bytes before anything is written; it refuses by raising.

    Raises
    ------
    MapDataError
        If a file cannot be read, or its points cannot become this layer.
    OSError
        ENOSPC if the file system is full.
    """
    if job.ready:
        cache = None  # its origin keeps it
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
        derived = derive(spec, job, fd, source=source() if source is not None else None, reserve=reserve)
        version = job.version(spec, derived.header.source, derived.neighbours)
        made = Made(derived.header, version, derived.neighbours, derived.warnings)
    if keep and cache is not None and key is not None:
        _keep(cache, CacheKey(spec, job, made.header.source, made.neighbours), made.header, fd)
    return made


def _keep(cache: LayerCache, key: CacheKey, header: SegmentHeader, fd: int) -> None:
    if not cache.writable:
        return
    try:
        cache.store(key, header, fd)
    except OSError as error:  # the cache is a convenience: a full disk costs nobody a layer
        cache.writable = False
        log.warning("layers not kept on disk", cache_dir=cache.directory, error=error)
