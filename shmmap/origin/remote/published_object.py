# SPDX-License-Identifier: Apache-2.0
"""A published layer of a cell: a segment without its identity, with columns split into planes of bytes.

The cell's identity (id, box, frame, source) is left out, so the same points give the same object wherever
and whenever they are published.  A reader adds the identity.  ``ORIGIN.md`` specifies the format byte by
byte.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from hashlib import sha256
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
import xxhash
from numpy.typing import NDArray

from shmmap.errors import MapDataError, SegmentCorrupt
from shmmap.origin.remote.zstd_frame import DAMAGED, pack_frame
from shmmap.segment.header import pack_header, unpack_header
from shmmap.segment.layout import (
    ALIGNMENT_BYTES,
    NO_SOURCE,
    TAIL_BYTES,
    Column,
    SegmentHeader,
    SourceStamp,
    header_size,
)
from shmmap.segment.version import Source, Stamp
from shmmap.segment.writer import write_all

POINTS: Final = "points"
"""Spec of the layer that each published map has."""
MAX_OBJECT_BYTES: Final = 1 << 30
"""Size limit of an unpacked object, as a loader holds it packed and unpacked in memory."""
STAMP_BYTES: Final = 24
"""Size of a cell's stamp, which is the first bytes of its points' content digest."""

FLAGS_AT: Final = 208
PLANES: Final = 1
MILLIMETRES: Final = 2
MM_ORIGIN_AT: Final = 296
XYZ: Final = "xyz"
MAX_PLANED_COMPONENTS: Final = 8
_FLAGS: Final = struct.Struct("<I")
_MM_ORIGIN: Final = struct.Struct("<3d")
_COUNTS: Final = np.dtype("<u2")
_XYZ: Final = np.dtype("<f4")
_BLOCK_ROWS: Final = 1 << 14  # rows at a time, few enough to stay in the processor's cache


class ObjectName(NamedTuple):
    """Name of an object: hashes and sizes of its packed and unpacked form.

    Attributes
    ----------
    sha256
        SHA-256 of the frame; the object's path is ``blobs/sha256/`` and its 64 hex digits.
    size
        Bytes of the frame.
    raw
        Bytes of the unpacked content.
    content
        SHA-256 of the unpacked content, the *content digest*.
    """

    sha256: bytes
    size: int
    raw: int
    content: bytes

    @property
    def path(self) -> str:
        """Path of the object, relative to the map's URL."""
        return blob_path(self.sha256)


def blob_path(digest: bytes) -> str:
    """Return the path of the object with this SHA-256, relative to the map's URL."""
    return f"blobs/sha256/{digest.hex()}"


@dataclass(frozen=True, slots=True)
class CellIdentity:
    """Identity of a cell, which a segment contains and an object does not; ``box`` in metres.

    ``stamp``, 24 bytes, is the cell's stamp for every layer.
    """

    cell_id: str
    box: tuple[float, float, float, float]
    frame_id: str
    stamp: bytes


# --- out of a segment ---------------------------------------------------------------------------------


def bare_object(segment: memoryview, *, millimetres: bool = False) -> bytearray:
    """Return the unpacked object of a prepared segment whose publish block is empty.

    Parameters
    ----------
    millimetres
        Round the points, see `to_millimetres`; points that cannot be rounded stay exact.

    Raises
    ------
    SegmentCorrupt
        The segment is incomplete.
    """
    header = unpack_header(segment, len(segment))
    header_bytes = header_size(len(header.columns), "", header.layer, "")
    shift = header_bytes - header.header_bytes
    bare = _moved(header, shift)
    bare = msgspec.structs.replace(
        bare, cell_id="", frame_id="", box=(0.0, 0.0, 0.0, 0.0), source=NO_SOURCE, source_digest=bytes(16)
    )
    arrays = [_rows(segment, column) for column in header.columns]
    flags, mm_origin = PLANES, b""
    rounded = _rounded_points(segment, header) if millimetres else None
    if rounded is not None:
        flags |= MILLIMETRES
        mm_origin = _MM_ORIGIN.pack(*rounded.origin.tolist())
        bare, arrays = _in_millimetres(bare, arrays, rounded)
    unpacked = bytearray(bare.total_bytes)
    unpacked[:header_bytes] = _flagged(pack_header(bare), flags, mm_origin)
    for column, rows in zip(bare.columns, arrays, strict=True):
        planes = np.frombuffer(unpacked, np.uint8, column.nbytes, column.offset).reshape(rows.shape[::-1])
        for begin in range(0, len(rows), _BLOCK_ROWS):
            end = begin + _BLOCK_ROWS
            for plane in range(
                len(planes)
            ):  # plane by plane is up to three times as fast as a transposed copy
                planes[plane, begin:end] = rows[begin:end, plane]
    return unpacked


def pack_object(unpacked: bytes | bytearray, content: bytes) -> tuple[ObjectName, bytes]:
    """Return the name of an object and its frame; ``content`` is its content digest."""
    frame = pack_frame(unpacked)
    return ObjectName(sha256(frame).digest(), len(frame), len(unpacked), content), frame


def _moved(header: SegmentHeader, shift: int) -> SegmentHeader:
    """Return the header lengthened by ``shift`` bytes, which moves the columns."""
    return msgspec.structs.replace(
        header,
        header_bytes=header.header_bytes + shift,
        total_bytes=header.total_bytes + shift,
        columns=tuple(
            msgspec.structs.replace(column, offset=column.offset + shift) for column in header.columns
        ),
    )


def _flagged(page: bytes, flags: int, mm_origin: bytes) -> bytearray:
    flagged = bytearray(page)
    _FLAGS.pack_into(flagged, FLAGS_AT, flags)
    flagged[MM_ORIGIN_AT : MM_ORIGIN_AT + len(mm_origin)] = mm_origin
    end = len(page) - TAIL_BYTES
    _FLAGS.pack_into(flagged, end, zlib.crc32(memoryview(flagged)[:end]))
    return flagged


def _plane_count(column: Column) -> int:
    """Return the bytes per row of a column, which is also its number of planes."""
    itemsize = column.dtype.itemsize
    if len(column.shape) == 2 and 0 < column.shape[1] <= MAX_PLANED_COMPONENTS:
        return itemsize * column.shape[1]
    return itemsize


def _rows(segment: memoryview, column: Column) -> NDArray[np.uint8]:
    """Return the bytes of a column, (rows, bytes per row)."""
    count = _plane_count(column)
    return np.frombuffer(segment, np.uint8, column.nbytes, column.offset).reshape(-1, count)


def _rounded_points(segment: memoryview, header: SegmentHeader) -> MillimetrePoints | None:
    """Return a segment's points in millimetres; None if it has no points, or they stay exact."""
    for column in header.columns:
        if (column.name, column.dtype, column.shape) == (XYZ, _XYZ, (header.rows, 3)) and header.rows:
            return to_millimetres(np.frombuffer(segment, _XYZ, 3 * header.rows, column.offset).reshape(-1, 3))
    return None


def _in_millimetres(
    bare: SegmentHeader, arrays: list[NDArray[np.uint8]], rounded: MillimetrePoints
) -> tuple[SegmentHeader, list[NDArray[np.uint8]]]:
    """Return header and rows with points in millimetres; checksums are those of the decoded columns."""
    xyz = rounded.xyz
    columns, ordered = [], []
    for column, rows in zip(bare.columns, arrays, strict=True):
        if column.name == XYZ:
            ordered.append(rounded.counts.view(np.uint8))
            checksum = xxhash.xxh3_64_intdigest(xyz.data)
            columns.append(
                msgspec.structs.replace(
                    column, dtype=_COUNTS, nbytes=rounded.counts.nbytes, checksum=checksum
                )
            )
        else:
            ordered.append(rows[rounded.order])
            columns.append(
                msgspec.structs.replace(column, checksum=xxhash.xxh3_64_intdigest(ordered[-1].data))
            )
    placed, total_bytes = _placed(columns, bare.header_bytes)
    z = xyz[:, 2]
    header = msgspec.structs.replace(
        bare, columns=placed, total_bytes=total_bytes, z_min=float(z.min()), z_max=float(z.max())
    )
    return header, ordered


def _placed(columns: Sequence[Column], header_bytes: int) -> tuple[tuple[Column, ...], int]:
    """Place columns one after the other, 64-byte aligned; return them and the total bytes."""
    placed, offset = [], header_bytes
    for column in columns:
        placed.append(msgspec.structs.replace(column, offset=offset))
        offset = -(-(offset + column.nbytes) // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
    return tuple(placed), offset


# --- into a segment -----------------------------------------------------------------------------------


def write_segment(
    unpacked: bytes | memoryview,
    fd: int,
    identity: CellIdentity,
    layer: str,
    *,
    name: str = "",
    reserve: Callable[[int], None] | None = None,
) -> SegmentHeader:
    """Write an unpacked object into an empty file as a segment of the current layout, header last.

    Parameters
    ----------
    fd
        Empty file, open for writing; after an error its content is undefined.
    layer
        Spec of the layer that the object must have.
    name
        Name of the object, for messages.
    reserve
        Called with the segment's size in bytes before anything is written; raises to refuse it.

    Returns
    -------
    The header as written, publish block empty.

    Raises
    ------
    MapDataError
        The data is not an object of this layer (cause ``damaged``), or of a later version (``newer``).
    OSError
        ENOSPC if the file system is full.
    """
    bare = read_bare_header(unpacked, layer, name=name)
    try:
        shift = header_size(len(bare.columns), identity.cell_id, layer, identity.frame_id) - bare.header_bytes
    except UnicodeEncodeError:
        raise MapDataError(f"the id {identity.cell_id!r} is no text", path=name, cause=DAMAGED) from None
    header = msgspec.structs.replace(
        _moved(bare, shift),
        cell_id=identity.cell_id,
        frame_id=identity.frame_id,
        box=identity.box,
        source=SourceStamp.from_token(identity.stamp),
        source_digest=identity.stamp[:16],
    )
    mm_origin = _mm_origin(unpacked)
    if mm_origin is not None:
        columns, total_bytes = _placed([_decoded(column) for column in header.columns], header.header_bytes)
        header = msgspec.structs.replace(header, columns=columns, total_bytes=total_bytes)
    page = pack_header(header)
    if reserve is not None:
        reserve(header.total_bytes)
    os.ftruncate(fd, header.total_bytes)
    for column, target in zip(bare.columns, header.columns, strict=True):
        offset = target.offset
        for rows in _decoded_blocks(unpacked, column, mm_origin):
            write_all(fd, rows.data.cast("B"), offset)
            offset += rows.nbytes
    write_all(fd, memoryview(page), 0)
    return header


def read_bare_header(
    unpacked: bytes | bytearray | memoryview, layer: str, *, name: str = ""
) -> SegmentHeader:
    """Return the header of an unpacked object; errors are those of `write_segment`."""
    view = memoryview(unpacked)
    try:
        header = unpack_header(view, len(view))
    except SegmentCorrupt as error:
        raise MapDataError(f"no object of a map: {error.message}", path=name, cause=DAMAGED) from None
    if header.total_bytes != len(view):
        raise MapDataError(
            f"it has {len(view):,} bytes, its header says {header.total_bytes:,}", path=name, cause=DAMAGED
        )
    (flags,) = _FLAGS.unpack_from(view, FLAGS_AT)
    if flags not in (PLANES, PLANES | MILLIMETRES):
        raise MapDataError(
            f"its flags are {flags:#x}, this program reads {PLANES:#x} and {PLANES | MILLIMETRES:#x}",
            path=name,
            cause="newer",
            hint="update shmmap",
        )
    if header.layer != layer:
        raise MapDataError(f"it is layer {header.layer!r}, not {layer!r}", path=name, cause=DAMAGED)
    if (mm_origin := _mm_origin(view)) is not None:
        counts = [c for c in header.columns if (c.name, c.dtype, c.shape) == (XYZ, _COUNTS, (header.rows, 3))]
        if len(counts) != 1 or not np.isfinite(mm_origin).all():
            raise MapDataError("its points are not what their flag says", path=name, cause=DAMAGED)
    return header


def read_points(
    unpacked: bytes | memoryview, source: Source, needs: Sequence[str] | None, *, name: str = ""
) -> tuple[SegmentHeader, dict[str, NDArray[Any]]]:
    """Return the header of a cell's unpacked points, and the columns that are needed (None: all).

    Errors are those of `write_segment`.
    """
    stamp = stamp_of(source)
    bare = read_bare_header(unpacked, POINTS, name=name)
    columns = {
        column.name: rows_of(unpacked, column)
        for column in bare.columns
        if needs is None or column.name in needs
    }
    is_rounded = _mm_origin(unpacked) is not None
    header = msgspec.structs.replace(
        bare,
        columns=tuple(_decoded(column) for column in bare.columns) if is_rounded else bare.columns,
        source=SourceStamp.from_token(stamp),
        source_digest=stamp[:16],
    )
    return header, columns


def rows_of(unpacked: bytes | bytearray | memoryview, column: Column) -> NDArray[Any]:
    """Return a decoded column of an unpacked object, in the shape that its header gives."""
    mm_origin = _mm_origin(unpacked)
    dtype = column.dtype if mm_origin is None else _decoded(column).dtype
    if not column.nbytes:
        return np.empty(column.shape, dtype)
    rows = np.concatenate([block.copy() for block in _decoded_blocks(unpacked, column, mm_origin)])
    return rows.reshape(-1).view(dtype).reshape(column.shape)


def _mm_origin(unpacked: bytes | bytearray | memoryview) -> NDArray[np.float64] | None:
    """Return the origin of points in millimetres; None if points are exact."""
    (flags,) = _FLAGS.unpack_from(unpacked, FLAGS_AT)
    return np.array(_MM_ORIGIN.unpack_from(unpacked, MM_ORIGIN_AT)) if flags & MILLIMETRES else None


def _decoded(column: Column) -> Column:
    """Return the description that a column of an object in millimetres has once decoded."""
    if column.name != XYZ:
        return column
    return msgspec.structs.replace(column, dtype=_XYZ, nbytes=2 * column.nbytes)


def _decoded_blocks(
    unpacked: bytes | bytearray | memoryview, column: Column, mm_origin: NDArray[np.float64] | None
) -> Iterator[NDArray[Any]]:
    """Yield the decoded rows of a column, block by block; each is valid until the next block."""
    if not column.nbytes:
        return
    for rows in _row_blocks(unpacked, column):
        if mm_origin is not None and column.name == XYZ:
            yield from_millimetres(rows.view(_COUNTS), mm_origin)
        else:
            yield rows


def _row_blocks(unpacked: bytes | bytearray | memoryview, column: Column) -> Iterator[NDArray[np.uint8]]:
    """Yield the rows of a column, (n, bytes per row), block by block; each is valid until the next block."""
    count = _plane_count(column)
    planes = np.frombuffer(unpacked, np.uint8, column.nbytes, column.offset).reshape(count, -1)
    buffer = np.empty((min(_BLOCK_ROWS, planes.shape[1]), count), np.uint8)
    for begin in range(0, planes.shape[1], _BLOCK_ROWS):
        block = planes[:, begin : begin + _BLOCK_ROWS]
        rows = buffer[: block.shape[1]]
        for plane in range(count):
            rows[:, plane] = block[plane]
        yield rows


STEP_M: Final = 0.001
MAX_COUNT: Final = 0xFFFF


@dataclass(frozen=True, slots=True, eq=False)
class MillimetrePoints:
    """Points of one cell, rounded to millimetres.

    Attributes
    ----------
    origin
        (3,) float64, metres, in the frame of the points.
    counts
        (N, 3) uint16, millimetres from the origin, in Morton order.
    order
        (N,) int64, the original row of each point.
    """

    origin: NDArray[np.float64]
    counts: NDArray[np.uint16]
    order: NDArray[np.int64]

    @property
    def xyz(self) -> NDArray[np.float32]:
        """Return the decoded points, (N, 3) float32, metres."""
        return from_millimetres(self.counts, self.origin)


def to_millimetres(xyz: NDArray[Any]) -> MillimetrePoints | None:
    """Round points to millimetres.

    Parameters
    ----------
    xyz
        (N, 3) metres.

    Returns
    -------
    The points; None if they must stay exact: not float32, no points, not all finite, or more than 65.535 m
    apart along an axis.
    """
    if xyz.dtype != np.float32 or xyz.ndim != 2 or xyz.shape[1] != 3 or not len(xyz):
        return None
    axes = np.ascontiguousarray(xyz.T).astype(np.float64)
    low, high = axes.min(axis=1), axes.max(axis=1)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    origin = np.floor(low * 1000.0) / 1000.0
    axes -= origin[:, None]
    axes *= 1000.0
    np.rint(axes, out=axes)
    if axes.max() > MAX_COUNT:
        return None
    numbers = np.maximum(axes, 0.0, out=axes).astype(np.uint16)
    key = np.zeros(len(xyz), np.uint64)
    for axis, spread in zip(numbers, _spread(), strict=True):
        key |= spread[axis]
    order = np.argsort(key, kind="stable")
    return MillimetrePoints(origin, np.ascontiguousarray(numbers[:, order].T), order)


def from_millimetres(counts: NDArray[np.uint16], origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return points, (N, 3) float32 in metres, from counts of millimetres (N, 3) and their origin (3,)."""
    xyz = np.empty(counts.shape, np.float32)
    for axis in range(3):
        xyz[:, axis] = counts[:, axis] * STEP_M + origin[axis]
    return xyz


@cache
def _spread() -> tuple[NDArray[np.uint64], ...]:
    """Return a table for each axis that spreads the bits of a 16-bit number to every third bit of a key."""
    spread = np.arange(MAX_COUNT + 1, dtype=np.uint64)
    for shift, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    return tuple(spread << np.uint64(axis) for axis in range(3))


class LayerSource(NamedTuple):
    """The object of a layer, as in `ObjectName`, and the version of the builder that built it."""

    sha256: bytes
    size: int
    raw: int
    content: bytes
    builder_version: int

    @property
    def name(self) -> ObjectName:
        """Name of the object."""
        return ObjectName(*self[:4])


_DECODER = msgspec.msgpack.Decoder(dict[str, LayerSource])


def pack_source(cell_id: str, layers: Mapping[str, LayerSource]) -> Source:
    """Return the source of a cell, which encodes its published layers by spec."""
    return Source(cell_id, msgspec.msgpack.encode(layers))


@lru_cache(maxsize=256)
def unpack_source(source: Source) -> Mapping[str, LayerSource]:
    """Return the published layers of a cell by spec."""
    return _DECODER.decode(source.words)


def stamp_of(source: Source) -> Stamp:
    """Return a cell's stamp: the first 24 bytes of its points' content digest."""
    return unpack_source(source)[POINTS].content[:STAMP_BYTES]
