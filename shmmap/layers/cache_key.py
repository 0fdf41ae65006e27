# SPDX-License-Identifier: Apache-2.0
"""What an entry of the disk cache is of: a layer of a cell at a version, or computed from some content."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import xxhash

from shmmap.layers.derive import CellJob
from shmmap.layers.spec import LayerSpec
from shmmap.segment.layout import LAYOUT_VERSION, SourceStamp

__all__ = ["CacheKey"]


@dataclass(frozen=True, slots=True)
class CacheKey:
    """What an entry is of.

    Attributes
    ----------
    source, neighbours
        State of the cell's file, and of those around it for a layer with a halo.
    """

    spec: LayerSpec
    job: CellJob
    source: SourceStamp
    neighbours: tuple[SourceStamp, ...] = ()

    @property
    def version(self) -> int:
        """Version of the layer."""
        return self.job.version(self.spec, self.source, self.neighbours)

    def version_name(self) -> str:
        """Name of the entry for this version, in the present layout of segments."""
        major, minor = LAYOUT_VERSION
        return f"{self.version:016x}-{major}.{minor}"

    def content_name(self, digest: bytes) -> str:
        """Name of the entry for what was computed from, by `shmmap.layers.derive.combined_digest`."""
        made = struct.pack("<IHH4d", self.spec.builder_version, *LAYOUT_VERSION, *self.job.box)
        name: str = digest.hex() + xxhash.xxh3_64_hexdigest(str(self.spec).encode() + b"\0" + made)
        return name
