# SPDX-License-Identifier: Apache-2.0
"""A cell's source, and versions: 64-bit numbers that name the bytes of one layer of one cell.

``LAYOUT.md`` has the recipe.  A cell's version is that of its ``points``.  It follows from the cell's id, its
source's *stamp* and its box; a computed layer's from that, from how the layer is computed, and from the cells
that it looks into.  So a version is the same across restarts, and differs as soon as anything changes
that the bytes depend on.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Final, TypeAlias

import msgspec
from xxhash import xxh3_64_intdigest

__all__ = [
    "Source",
    "Stamp",
    "cell_version",
    "layer_version",
]


class Source(msgspec.Struct, frozen=True, array_like=True):
    """Where a cell's points come from.

    Attributes
    ----------
    name
        What messages call it; of a file its path, which is all there is to know.
    words
        What the origin that named it says beside, for its own reader (`shmmap.layers.sources`) alone.
    """

    name: str
    words: bytes = b""


Stamp: TypeAlias = bytes
"""Names one state of a cell's source.  Only the origin that made it knows what it says: of a file, what
``stat`` says (`shmmap.segment.layout.SourceStamp`); elsewhere a hash of the content, say."""

_LENGTH: Final = struct.Struct("<I")
_BOX: Final = struct.Struct("<4d")
_CELL: Final = struct.Struct("<Q")


def cell_version(cell_id: str, stamp: Stamp, box: tuple[float, float, float, float]) -> int:
    """Return the version of a cell, ``box`` in metres; `os.fsencode` gives the id's bytes (UTF-8)."""
    name = os.fsencode(cell_id)
    return xxh3_64_intdigest(
        _LENGTH.pack(len(name)) + name + _LENGTH.pack(len(stamp)) + stamp + _BOX.pack(*box)
    )


def layer_version(cell: int, layer: str, builder_version: int, neighbours: Sequence[int] = ()) -> int:
    """Return the version of a computed layer.

    Parameters
    ----------
    cell
        Version of its cell.
    layer
        Its spec in canonical form.
    builder_version
        Of the code that computes it, as the segment's header has it.
    neighbours
        Versions of the cells that it looks into beside its own, in id order.
    """
    spec = layer.encode()
    return xxh3_64_intdigest(
        _CELL.pack(cell)
        + _LENGTH.pack(len(spec))
        + spec
        + _LENGTH.pack(builder_version)
        + struct.pack(f"<{len(neighbours)}Q", *neighbours)
    )
