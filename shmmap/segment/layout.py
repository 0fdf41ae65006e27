# SPDX-License-Identifier: Apache-2.0
"""What a segment is made of: one header, then columns.  ``LAYOUT.md`` is the byte-exact document.

A segment is one layer of one cell at one version.  Its header carries everything a reader needs
(a handle names only segment, offset and size), and is immutable but for the 64-byte *publish
block* at its end, which the daemon fills in when it gives the segment a name.

The header's bytes are the business of `shmmap.segment.header`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import msgspec

if TYPE_CHECKING:
    import os

    import numpy as np
    from numpy.typing import NDArray

    from shmmap.columns import ColumnSpec

__all__ = [
    "LAYOUT_VERSION",
    "Column",
    "ColumnRow",
    "Lattice",
    "SegmentHeader",
    "SourceStamp",
    "header_size",
    "plan_arrays",
    "plan_columns",
]

LAYOUT_VERSION: Final = (1, 3)
PAGE_BYTES: Final = 4096
ALIGNMENT_BYTES: Final = 64
COLUMNS_OFFSET: Final = 512
TAIL_BYTES: Final = 72  # header CRC, padding, publish block
MAX_DIMENSIONS: Final = 4
COLUMN: Final = struct.Struct("<40s8s16sII4QQQQ")
_TOKEN: Final = struct.Struct("<Qqq")  # a size is not negative; the first 8 bytes of a hash may be any


class SourceStamp(NamedTuple):
    """What ``stat`` says about one state of a source file without reading it: bytes and nanoseconds.

    ``ctime_ns`` is what makes it sound: no program can set it back, so a rewrite that restores size
    and mtime (``cp -p``, ``rsync -t``) still shows.
    """

    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, status: os.stat_result) -> SourceStamp:
        """Stamp of a file from its `os.stat` or `os.fstat` result."""
        return cls(status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    @classmethod
    def from_token(cls, token: bytes) -> SourceStamp:
        """Stamp whose `token` this is."""
        return cls(*_TOKEN.unpack(token))

    @property
    def token(self) -> bytes:
        """The same as bytes, which is all that versions and the daemon know of it."""
        return _TOKEN.pack(*self)


NO_SOURCE: Final = SourceStamp(0, 0, 0)


class Column(msgspec.Struct, frozen=True):
    """One named array of a segment.

    Attributes
    ----------
    name
        At most 40 bytes of UTF-8.
    dtype
        Little-endian numpy type of one element.
    shape
        Up to four dimensions; rows first.
    offset, nbytes
        Where the C-contiguous array lies, counted from the start of the segment.
    unit
        SI unit of the values, empty where unknown.
    checksum
        XXH3-64 of the column's bytes.
    """

    name: str
    dtype: np.dtype[np.generic]
    shape: tuple[int, ...]
    offset: int
    nbytes: int
    unit: str = ""
    checksum: int = 0


class Lattice(NamedTuple):
    """A global lattice and the box of it that a layer occupies.

    A point lies in voxel ``floor(coordinate / leaf)`` along each axis, the same in every cell of a
    map.  An axis that the lattice does not divide (z of a height grid) has an infinite ``leaf``,
    ``first`` 0 and ``shape`` 1.

    Attributes
    ----------
    leaf
        Edge lengths along x, y, z; metres.
    first
        Index of the first voxel of the box along x, y, z.
    shape
        Voxels of the box along x, y, z; 0 where nothing is occupied.
    """

    leaf: tuple[float, float, float]
    first: tuple[int, int, int]
    shape: tuple[int, int, int]


ColumnRow: TypeAlias = tuple[str, "np.dtype[np.generic]", tuple[int, ...], int, int, str, int]
"""The fields of a `Column`, in order."""


class SegmentHeader(msgspec.Struct, frozen=True):
    """Everything a segment says about itself; metres, map frame.

    ``box`` is the cell's (min_x, min_y, max_x, max_y); ``z_min``/``z_max`` bound the points and are
    NaN for an empty cell.  Coordinates in columns are relative to ``origin`` ((0, 0, 0) for
    `points`, which keeps the source's bits).  ``rows`` counts the points kept,
    ``source_points`` those in the file, ``dropped_points`` those left out as not finite,
    ``outside_points`` those kept although they lie outside ``box``.
    For a computed layer ``rows`` are its own (points, voxels), and ``lattice`` is what they lie on.
    """

    cell_id: str
    layer: str
    columns: tuple[Column, ...]
    rows: int
    box: tuple[float, float, float, float]
    header_bytes: int
    total_bytes: int
    z_min: float = math.nan
    z_max: float = math.nan
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    source_points: int = 0
    dropped_points: int = 0
    source: SourceStamp = NO_SOURCE
    source_digest: bytes = bytes(16)
    builder_version: int = 0
    frame_id: str = "map"
    lattice: Lattice | None = None
    outside_points: int = 0


def _up(value: int, step: int) -> int:
    return -(-value // step) * step


def header_size(column_count: int, cell_id: str, layer: str, frame_id: str) -> int:
    """Bytes of the header of such a segment: a whole number of pages."""
    strings = len(cell_id.encode()) + len(layer.encode()) + len(frame_id.encode())
    return _up(COLUMNS_OFFSET + column_count * COLUMN.size + strings + TAIL_BYTES, PAGE_BYTES)


def plan_columns(specs: Sequence[ColumnSpec], rows: int, header_bytes: int) -> tuple[tuple[Column, ...], int]:
    """Place one column after the other, each 64-byte aligned; returns them and the total bytes."""
    columns = []
    offset = header_bytes
    for spec in specs:
        shape = (rows,) if spec.components == 1 else (rows, spec.components)
        nbytes = rows * spec.row_bytes
        columns.append(Column(spec.name, spec.dtype, shape, offset, nbytes, spec.unit))
        offset = _up(offset + nbytes, ALIGNMENT_BYTES)
    return tuple(columns), offset


def plan_arrays(
    arrays: Mapping[str, NDArray[np.generic]], units: Mapping[str, str], header_bytes: int
) -> tuple[tuple[Column, ...], int]:
    """Place arrays of any shapes, as `plan_columns` does; returns them and the total bytes."""
    columns = []
    offset = header_bytes
    for name, array in arrays.items():
        columns.append(Column(name, array.dtype, array.shape, offset, array.nbytes, units.get(name, "")))
        offset = _up(offset + array.nbytes, ALIGNMENT_BYTES)
    return tuple(columns), offset
