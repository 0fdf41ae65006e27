# SPDX-License-Identifier: Apache-2.0
"""What an entry of the disk cache is of: a layer of a cell, by the state of its files or by their content."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import xxhash

from shmmap.layers.contract import Box
from shmmap.layers.spec import LayerSpec
from shmmap.segment.layout import LAYOUT_VERSION, NO_SOURCE, SourceStamp

__all__ = ["CacheKey", "neighbour_states"]


@dataclass(frozen=True, slots=True)
class CacheKey:
    """What an entry is of.

    Attributes
    ----------
    stamp, neighbours
        State of the cell's file, and paths and states of those around it for a layer with a halo.
    """

    spec: LayerSpec
    cell_id: str
    box: Box
    frame_id: str
    stamp: SourceStamp
    neighbours: tuple[tuple[str, SourceStamp], ...] = ()

    def _layer(self) -> bytes:
        version = struct.pack("<IHH4d", self.spec.builder_version, *LAYOUT_VERSION, *self.box)
        return str(self.spec).encode() + b"\0" + version

    def state_name(self) -> str:
        """Name of the entry for this state of the files."""
        words = [self._layer()]
        for path, stamp in ((self.cell_id, self.stamp), *self.neighbours):
            words.append(os.fsencode(path) + b"\0" + struct.pack("<Qqq", *stamp))
        name: str = xxhash.xxh3_128_hexdigest(b"".join(words))
        return name

    def content_name(self, digest: bytes) -> str:
        """Name of the entry for what was computed from, by `shmmap.layers.derive.combined_digest`."""
        name: str = digest.hex() + xxhash.xxh3_64_hexdigest(self._layer())
        return name


def neighbour_states(paths: Sequence[str]) -> tuple[tuple[str, SourceStamp], ...]:
    """Return paths with the stamps of what lies there now; zeros where nothing does."""
    return tuple((path, _state_of(path)) for path in paths)


def _state_of(path: str) -> SourceStamp:
    try:
        return SourceStamp.of(os.stat(path))
    except OSError:
        return NO_SOURCE
