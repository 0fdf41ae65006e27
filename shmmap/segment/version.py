# SPDX-License-Identifier: Apache-2.0
"""Sources of cells, and versions: 64-bit numbers that identify the bytes of one layer of one cell.

``LAYOUT.md`` has the formula.  A cell's version is that of its ``points``: a hash of the cell's id, its
source's *stamp* and its box.  The version of a computed layer also depends on the computation and on the
neighbouring cells that it reads.  So a version is the same across restarts, and changes with anything on
which the bytes depend.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Final, TypeAlias

import msgspec
from xxhash import xxh3_64_intdigest


class Source(msgspec.Struct, frozen=True, array_like=True):
    """Source of a cell's points.

    Attributes
    ----------
    name
        Name in messages; for a file its path, which identifies it completely.
    words
        Further data from the origin, only for the origin's own reader (`shmmap.layers.sources`).
    """

    name: str
    words: bytes = b""


Stamp: TypeAlias = bytes
"""Identifies one state of a cell's source.  Only the origin that made it interprets it: for a file it is a
`shmmap.segment.layout.SourceStamp`, otherwise a hash of the content, for example."""

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
        Version of the layer's cell.
    layer
        The layer's spec in canonical form.
    builder_version
        Version of the code that computes the layer, as in the segment's header.
    neighbours
        Versions of the other cells that the computation reads, in id order.
    """
    spec = layer.encode()
    return xxh3_64_intdigest(
        _CELL.pack(cell)
        + _LENGTH.pack(len(spec))
        + spec
        + _LENGTH.pack(builder_version)
        + struct.pack(f"<{len(neighbours)}Q", *neighbours)
    )
