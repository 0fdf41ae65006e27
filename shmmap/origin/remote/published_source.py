# SPDX-License-Identifier: Apache-2.0
"""The objects of one cell of a published map as the `Source` that loaders are given."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import msgspec

from shmmap.origin.remote.published_index import POINTS
from shmmap.origin.remote.published_object import STAMP_BYTES, ObjectName
from shmmap.segment.version import Source, Stamp

__all__ = ["LayerSource", "pack_source", "stamp_of", "unpack_source"]


class LayerSource(NamedTuple):
    """The object of a layer, as `ObjectName` has it, and the version of what has built it."""

    sha256: bytes
    size: int
    raw: int
    content: bytes
    builder_version: int

    @property
    def name(self) -> ObjectName:
        """The object."""
        return ObjectName(*self[:4])


_DECODER = msgspec.msgpack.Decoder(dict[str, LayerSource])


def pack_source(cell_id: str, layers: Mapping[str, LayerSource]) -> Source:
    """Return the source of a cell: its published layers by spec."""
    return Source(cell_id, msgspec.msgpack.encode(layers))


@lru_cache(maxsize=256)
def unpack_source(source: Source) -> Mapping[str, LayerSource]:
    """Return the published layers of a cell."""
    return _DECODER.decode(source.words)


def stamp_of(source: Source) -> Stamp:
    """Return the stamp of a cell, which its points' content says."""
    return unpack_source(source)[POINTS].content[:STAMP_BYTES]
