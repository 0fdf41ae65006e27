# SPDX-License-Identifier: Apache-2.0
"""One layer of one cell of a published map into a segment file: got, verified, and written."""

from __future__ import annotations

from collections.abc import Callable

from shmmap.errors import MapDataError
from shmmap.origin.remote.object_tier import KeptObjects
from shmmap.origin.remote.published_object import CellIdentity, ObjectName, unpack_object, write_segment
from shmmap.origin.remote.zstd_frame import DAMAGED
from shmmap.segment.layout import SegmentHeader

__all__ = ["fetch_segment"]


def fetch_segment(
    objects: KeptObjects,
    name: ObjectName,
    identity: CellIdentity,
    layer: str,
    fd: int,
    *,
    builder_version: int | None = None,
    reserve: Callable[[int], None] | None = None,
) -> SegmentHeader:
    """Fill an empty segment file with a published layer; may be called in threads.

    Parameters
    ----------
    name
        As the shard has it.
    identity, layer
        Of the cell, and the layer's spec: what the object lacks, or has to be.
    fd
        Empty file, open for writing; after an error its contents mean nothing.
    builder_version
        Of the layer, as the root says; None: any.
    reserve
        Called with the segment's size in bytes before anything is written; it refuses by raising.

    Returns
    -------
    The header as written, publish block empty.

    Raises
    ------
    Offline
        It is not in the tier, and the store does not answer, or refuses.
    MapMissing
        The store does not have it either.
    MapDataError
        It is damaged (cause ``damaged``), or made by a later version (``newer``).
    OSError
        ENOSPC if the file system is full.
    """
    frame = objects.read(name.sha256, name.size)
    path = f"{objects.url}/{name.path}"
    unpacked = unpack_object(frame, name, verified=True)
    header = write_segment(unpacked, fd, identity, layer, name=path, reserve=reserve)
    if builder_version is not None and header.builder_version != builder_version:
        raise MapDataError(
            f"builder version {header.builder_version}, the map says {builder_version}",
            path=path,
            cause=DAMAGED,
        )
    return header
