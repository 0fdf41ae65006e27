# SPDX-License-Identifier: Apache-2.0
"""Encode and decode a segment's header, and verify a segment's bytes by its checksums.

``LAYOUT.md`` is the byte-exact specification.  The header's last 64 bytes are the *publish block*: the daemon
run that published the segment, and the version.

Files are read, not mapped: no page of a file stays in the checking process, and a file that is shorter than
its header states causes an error instead of SIGBUS.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from shmmap.errors import SegmentCorrupt
from shmmap.segment.layout import (
    ALIGNMENT_BYTES,
    COLUMN,
    COLUMNS_OFFSET,
    LAYOUT_VERSION,
    MAX_DIMENSIONS,
    PAGE_BYTES,
    TAIL_BYTES,
    Column,
    ColumnRow,
    Lattice,
    SegmentHeader,
    SourceStamp,
)

_BLOCK_BYTES: Final = 1 << 20
PUBLISH_BYTES: Final = 64
PUBLISH: Final = struct.Struct("<8sQQ32xI4x")
PUBLISH_MAGIC: Final = b"PUBLISH\x00"
CRC: Final = struct.Struct("<II")


class PublishBlock(NamedTuple):
    """The daemon run that published a segment, and the version of its cell."""

    epoch: int
    version: int


def pack_publish_block(block: PublishBlock) -> bytes:
    """Return the 64 bytes the daemon writes when it publishes a segment."""
    packed = PUBLISH.pack(PUBLISH_MAGIC, block.epoch, block.version, 0)
    return packed[:56] + CRC.pack(zlib.crc32(packed[:56]), 0)


def unpack_publish_block(header_page: memoryview, header_bytes: int) -> PublishBlock | None:
    """Read the publish block; None while the segment was never published.

    Raises
    ------
    SegmentCorrupt
        The block is neither empty nor complete.
    """
    raw = bytes(header_page[header_bytes - PUBLISH_BYTES : header_bytes])
    magic, epoch, version, crc = PUBLISH.unpack(raw)
    if magic == bytes(8):
        return None
    if magic != PUBLISH_MAGIC or crc != zlib.crc32(raw[:56]):
        raise SegmentCorrupt("the publish block is damaged")
    return PublishBlock(epoch, version)


MAGIC: Final = b"SHMMAP\x00\x01"
BYTE_ORDER: Final = 0x01020304

FIXED: Final = struct.Struct("<8sHHIQQQQQQqq16s4d2d3dIIIIIIIIIIII")
LATTICE: Final = struct.Struct("<3d3q3Q")  # after the fixed part; all zero: no lattice
OUTSIDE: Final = struct.Struct("<Q")  # after the lattice; since 1.3, before 0
OUTSIDE_AT: Final = FIXED.size + LATTICE.size
TABLE: Final = struct.Struct("<III")  # column count, offset of the table, bytes of a row
TABLE_AT: Final = FIXED.size - 11 * 4


@lru_cache(maxsize=64)  # numpy computes ``dtype.str`` in Python
def _dtype_name(dtype: np.dtype[np.generic]) -> bytes:
    name: str = dtype.newbyteorder("<").str
    return name.encode()


def pack_header(header: SegmentHeader) -> bytes:
    """Return the header's bytes, publish block empty.

    Raises
    ------
    ValueError
        If a name or unit is too long, a dtype is not little-endian numeric, or the strings do not
        fit ``header_bytes``.
    """
    page = bytearray(header.header_bytes)
    at = COLUMNS_OFFSET
    for column in header.columns:
        name, unit = column.name.encode(), column.unit.encode()
        dtype = _dtype_name(column.dtype)
        if len(name) > 40 or len(unit) > 16 or len(dtype) > 8 or len(column.shape) > MAX_DIMENSIONS:
            raise ValueError(f"column {column.name!r} does not fit the layout's row")
        if column.dtype.kind not in "fiu":
            raise ValueError(f"column {column.name!r}: dtype {column.dtype} is not numeric")
        shape = (*column.shape, *(0,) * (MAX_DIMENSIONS - len(column.shape)))
        COLUMN.pack_into(
            page,
            at,
            name,
            dtype,
            unit,
            len(column.shape),
            0,
            *shape,
            column.offset,
            column.nbytes,
            column.checksum,
        )
        at += COLUMN.size
    places: list[int] = []
    for text in (header.cell_id.encode(), header.layer.encode(), header.frame_id.encode()):
        if at + len(text) > header.header_bytes - TAIL_BYTES:
            raise ValueError("the header's strings do not fit its pages")
        page[at : at + len(text)] = text
        places += (at, len(text))
        at += len(text)
    FIXED.pack_into(
        page,
        0,
        MAGIC,
        *LAYOUT_VERSION,
        BYTE_ORDER,
        header.header_bytes,
        header.total_bytes,
        header.rows,
        header.source_points,
        header.dropped_points,
        *header.source,
        header.source_digest,
        *header.box,
        header.z_min,
        header.z_max,
        *header.origin,
        header.builder_version,
        len(header.columns),
        COLUMNS_OFFSET,
        COLUMN.size,
        *places,
        0,
        0,
    )
    if header.lattice is not None:
        leaf, first, shape_xyz = header.lattice
        LATTICE.pack_into(page, FIXED.size, *leaf, *first, *shape_xyz)
    OUTSIDE.pack_into(page, OUTSIDE_AT, header.outside_points)
    end = header.header_bytes - TAIL_BYTES
    CRC.pack_into(page, end, zlib.crc32(memoryview(page)[:end]), 0)
    return bytes(page)


_DTYPES: dict[bytes, np.dtype[np.generic]] = {
    np.dtype(f"<{kind}{size}").str.encode(): np.dtype(f"<{kind}{size}")
    for kind, sizes in (("f", (2, 4, 8)), ("i", (1, 2, 4, 8)), ("u", (1, 2, 4, 8)))
    for size in sizes
}


def check_start(start: memoryview, available_bytes: int) -> tuple[int, int]:
    """Check magic, version and sizes of a segment's first bytes; return (header, total) bytes.

    ``available_bytes`` is the real size of the file (fstat): all that the header describes must lie within.
    """
    if len(start) < FIXED.size:
        raise SegmentCorrupt(f"a segment of {len(start)} bytes is shorter than its header")
    magic, major, minor, order, header_bytes, total_bytes = struct.unpack_from("<8sHHIQQ", start)
    if magic != MAGIC:
        raise SegmentCorrupt(f"not a shmmap segment: it starts with {bytes(magic)!r}")
    if major != LAYOUT_VERSION[0]:
        raise SegmentCorrupt(
            f"segment layout {major}.{minor}, this program reads {LAYOUT_VERSION[0]}.x",
            hint="update the older of daemon and client",
        )
    if order != BYTE_ORDER:
        raise SegmentCorrupt("the segment was written on a machine of other byte order")
    if header_bytes % PAGE_BYTES or not PAGE_BYTES <= header_bytes <= total_bytes <= available_bytes:
        raise SegmentCorrupt(
            f"the segment claims {header_bytes} header and {total_bytes} total bytes, has {available_bytes}"
        )
    return header_bytes, total_bytes


def read_columns(page: memoryview, available_bytes: int) -> tuple[int, list[ColumnRow]]:
    """Verify a header and read its column table, which every reader needs.

    Parameters and errors are those of `unpack_header`, which also reads the rest.

    Returns
    -------
    header_bytes : int
        Size of the header.
    rows : list of tuple
        One tuple per column: the fields of `Column`, in order.
    """
    header_bytes, total_bytes = check_start(page, available_bytes)
    if len(page) < header_bytes:
        raise SegmentCorrupt(f"only {len(page)} of {header_bytes} header bytes are there")
    end = header_bytes - TAIL_BYTES
    if zlib.crc32(page[:end]) != int.from_bytes(page[end : end + 4], "little"):
        raise SegmentCorrupt("the header's checksum does not match")
    count, columns_offset, row_bytes = TABLE.unpack_from(page, TABLE_AT)
    if row_bytes < COLUMN.size or columns_offset + count * row_bytes > end:
        raise SegmentCorrupt("the column table does not fit the header")
    rows: list[ColumnRow] = []
    for at in range(columns_offset, columns_offset + count * row_bytes, row_bytes):
        name, dtype, unit, ndim, _, s0, s1, s2, s3, offset, nbytes, checksum = COLUMN.unpack_from(page, at)
        kind = _DTYPES.get(dtype.rstrip(b"\0"))
        shape = (s0, s1, s2, s3)[:ndim]
        if (
            kind is None
            or ndim > MAX_DIMENSIONS
            or math.prod(shape) * kind.itemsize != nbytes
            or offset < header_bytes
            or offset % ALIGNMENT_BYTES
            or offset + nbytes > total_bytes
            or (nbytes == 0 and max(shape, default=0) > total_bytes)  # numpy cannot represent such an array
        ):
            raise SegmentCorrupt(f"column {len(rows)} ({bytes(name)!r}) contradicts the layout")
        rows.append(
            (
                _shared_text(name.rstrip(b"\0")),
                kind,
                shape,
                offset,
                nbytes,
                _shared_text(unit.rstrip(b"\0")),
                checksum,
            )
        )
    return header_bytes, rows


def unpack_header(page: memoryview, available_bytes: int) -> SegmentHeader:
    """Read and verify a header.

    Parameters
    ----------
    page
        The segment's bytes, from its start, at least the whole header.
    available_bytes
        Real size of the segment, bytes.

    Raises
    ------
    SegmentCorrupt
        Wrong magic, other major layout version, bad CRC, or a column outside the segment.
    """
    header_bytes, columns = read_columns(page, available_bytes)
    end = header_bytes - TAIL_BYTES
    (
        _magic,
        _major,
        _minor,
        _order,
        _header_bytes,
        total_bytes,
        rows,
        source_points,
        dropped_points,
        source_size,
        source_mtime_ns,
        source_ctime_ns,
        digest,
        min_x,
        min_y,
        max_x,
        max_y,
        z_min,
        z_max,
        origin_x,
        origin_y,
        origin_z,
        builder_version,
        _count,
        _columns_offset,
        _row_bytes,
        id_at,
        id_bytes,
        layer_at,
        layer_bytes,
        frame_at,
        frame_bytes,
        _flags,
        _reserved,
    ) = FIXED.unpack_from(page)
    if max(id_at + id_bytes, layer_at + layer_bytes, frame_at + frame_bytes) > end:
        raise SegmentCorrupt("a string lies outside the header")
    return SegmentHeader(
        cell_id=_text(page[id_at : id_at + id_bytes]),
        layer=_text(page[layer_at : layer_at + layer_bytes]),
        columns=tuple(Column(*column) for column in columns),
        rows=rows,
        box=(min_x, min_y, max_x, max_y),
        header_bytes=header_bytes,
        total_bytes=total_bytes,
        z_min=z_min,
        z_max=z_max,
        origin=(origin_x, origin_y, origin_z),
        source_points=source_points,
        dropped_points=dropped_points,
        source=SourceStamp(source_size, source_mtime_ns, source_ctime_ns),
        source_digest=digest,
        builder_version=builder_version,
        frame_id=_text(page[frame_at : frame_at + frame_bytes]),
        lattice=_unpack_lattice(page),
        outside_points=OUTSIDE.unpack_from(page, OUTSIDE_AT)[0],
    )


@lru_cache(maxsize=256)  # hundreds of attached segments share a few column names
def _shared_text(raw: bytes) -> str:
    return _text(raw)


def _text(raw: bytes | memoryview) -> str:
    try:
        return str(raw, "utf-8")
    except UnicodeDecodeError:
        raise SegmentCorrupt(f"{bytes(raw)!r} in the header is no UTF-8") from None


def _unpack_lattice(page: memoryview) -> Lattice | None:
    leaf_x, leaf_y, leaf_z, i, j, k, columns, rows, levels = LATTICE.unpack_from(page, FIXED.size)
    if leaf_x == 0.0:
        return None
    return Lattice((leaf_x, leaf_y, leaf_z), (i, j, k), (columns, rows, levels))


def read_page(fd: int, available_bytes: int, offset: int = 0) -> bytes:
    """Read a segment's header from a file: its first page, or more if the header is longer."""
    page = os.pread(fd, min(available_bytes, PAGE_BYTES), offset)
    header_bytes = int.from_bytes(page[16:24], "little")
    return os.pread(fd, header_bytes, offset) if PAGE_BYTES < header_bytes <= available_bytes else page


def read_header(fd: int) -> tuple[SegmentHeader, PublishBlock]:
    """Read and verify the header and publish block of an open segment.

    Raises
    ------
    SegmentCorrupt
        As `unpack_header`; or the segment was never published.
    """
    available = os.fstat(fd).st_size
    page = memoryview(read_page(fd, available))
    header = unpack_header(page, available)
    block = unpack_publish_block(page, header.header_bytes)
    if block is None:
        raise SegmentCorrupt("the segment was never published")
    return header, block


def checked_blocks(fd: int, header: SegmentHeader, block_bytes: int) -> Iterator[tuple[int, memoryview]]:
    """Read every column of a segment file; yield each block's position and bytes, valid until the next block.

    Raises
    ------
    SegmentCorrupt
        A column does not match its checksum; raised after its last block.
    """
    import xxhash  # clients may lack it

    buffer = memoryview(bytearray(block_bytes))
    for column in header.columns:
        digest = xxhash.xxh3_64()
        at, end = column.offset, column.offset + column.nbytes
        while at < end and (got := os.preadv(fd, [buffer[: min(block_bytes, end - at)]], at)):
            digest.update(buffer[:got])
            yield at, buffer[:got]
            at += got
        if digest.intdigest() != column.checksum:
            raise SegmentCorrupt(f"column {column.name!r} of {header.cell_id} does not match its checksum")


def verify_file(fd: int) -> SegmentHeader:
    """Compare every column of an open segment with its checksum (about 25 ms per 100 MB).

    Raises
    ------
    SegmentCorrupt
        As `read_header`; or a column's bytes changed: the message names the first such column.
    """
    header, _ = read_header(fd)
    for _at, _block in checked_blocks(fd, header, _BLOCK_BYTES):
        pass
    return header
