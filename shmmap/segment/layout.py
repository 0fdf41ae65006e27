# SPDX-License-Identifier: Apache-2.0
"""Structure of a segment: one header, then columns.  ``LAYOUT.md`` is the byte-exact specification.

A segment is one layer of one cell at one version.  Its header contains all that a reader needs (a handle
names only segment, offset and size).  It is immutable except for the 64-byte *publish block* at its end,
which the daemon fills in when it gives the segment a name.

`shmmap.segment.header` encodes and decodes the header.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import msgspec

if TYPE_CHECKING:
    import os

    import numpy as np
    from numpy.typing import NDArray

    from shmmap.columns import ColumnSpec

LAYOUT_VERSION: Final = (1, 3)
PAGE_BYTES: Final = 4096
ALIGNMENT_BYTES: Final = 64
COLUMNS_OFFSET: Final = 512
TAIL_BYTES: Final = 72  # header CRC, padding, publish block
MAX_DIMENSIONS: Final = 4
COLUMN: Final = struct.Struct("<40s8s16sII4QQQQ")
_TOKEN: Final = struct.Struct("<Qqq")  # a size is not negative; the first 8 bytes of a hash are arbitrary


class SourceStamp(NamedTuple):
    """State of a source file according to ``stat``, without reading the file: bytes and nanoseconds.

    ``ctime_ns`` makes it reliable: no program can set it back, so a rewrite that restores size and mtime
    (``cp -p``, ``rsync -t``) is still detected.
    """

    size: int
    mtime_ns: int
    ctime_ns: int

    @classmethod
    def of(cls, status: os.stat_result) -> SourceStamp:
        """Return the stamp of a file from its `os.stat` or `os.fstat` result."""
        return cls(status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    @classmethod
    def from_token(cls, token: bytes) -> SourceStamp:
        """Return the stamp with this `token`."""
        return cls(*_TOKEN.unpack(token))

    @property
    def token(self) -> bytes:
        """The stamp as bytes, the only form that versions and the daemon use."""
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
        Position of the C-contiguous array from the start of the segment, and its size, bytes.
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
    """A global lattice, and the box of voxels in it that a layer occupies.

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
        Voxels of the box along x, y, z; 0 if no voxel is occupied.
    """

    leaf: tuple[float, float, float]
    first: tuple[int, int, int]
    shape: tuple[int, int, int]


ColumnRow: TypeAlias = tuple[str, "np.dtype[np.generic]", tuple[int, ...], int, int, str, int]
"""The fields of a `Column`, in order."""


class SegmentHeader(msgspec.Struct, frozen=True):
    """All fields of a segment's header; metres, map frame.

    ``box`` is the cell's (min_x, min_y, max_x, max_y); ``z_min``/``z_max`` bound the points and are NaN for
    an empty cell.  Coordinates in columns are relative to ``origin`` ((0, 0, 0) for `points`, which keeps the
    source's bits).  ``rows`` counts the kept points, ``source_points`` the points in the file,
    ``dropped_points`` the non-finite points left out, ``outside_points`` the kept points outside ``box``. For
    a computed layer ``rows`` counts its own rows (points, voxels), which lie on ``lattice``.
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
    """Return the size of a segment's header in bytes, a multiple of the page size."""
    strings = len(cell_id.encode()) + len(layer.encode()) + len(frame_id.encode())
    return _up(COLUMNS_OFFSET + column_count * COLUMN.size + strings + TAIL_BYTES, PAGE_BYTES)


def plan_columns(specs: Sequence[ColumnSpec], rows: int, header_bytes: int) -> tuple[tuple[Column, ...], int]:
    """Place one column after the other, each 64-byte aligned; return the columns and the total bytes."""
    return _placed(
        (
            (spec.name, spec.dtype, (rows,) if spec.components == 1 else (rows, spec.components), spec.unit)
            for spec in specs
        ),
        header_bytes,
    )


def plan_arrays(
    arrays: Mapping[str, NDArray[np.generic]], units: Mapping[str, str], header_bytes: int
) -> tuple[tuple[Column, ...], int]:
    """Place arrays of any shapes as `plan_columns` does; return the columns and the total bytes."""
    return _placed(
        ((name, array.dtype, array.shape, units.get(name, "")) for name, array in arrays.items()),
        header_bytes,
    )


def _placed(
    wanted: Iterable[tuple[str, np.dtype[np.generic], tuple[int, ...], str]], offset: int
) -> tuple[tuple[Column, ...], int]:
    """Place columns, given by name, type, shape and unit, from an offset on."""
    columns = []
    for name, dtype, shape, unit in wanted:
        nbytes = math.prod(shape) * dtype.itemsize
        columns.append(Column(name, dtype, shape, offset, nbytes, unit))
        offset = _up(offset + nbytes, ALIGNMENT_BYTES)
    return tuple(columns), offset
