# SPDX-License-Identifier: Apache-2.0
"""The points of ``binary`` and ``binary_compressed`` PCD files, as blocks of columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats.causes import refusal
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.header import PcdHeader
from shmmap.formats.pcd.table import FieldTable, RawBlock
from shmmap.formats.scratch import borrow_scratch
from shmmap.formats.source_file import SourceFile

__all__ = ["binary_blocks", "check_sizes", "compressed_blocks", "field_arrays", "record_blocks"]

_BLOCK_BYTES: Final = 1 << 20  # of file data per block, at most
_BYTE: Final = np.dtype(np.uint8)


def binary_blocks(
    source: SourceFile, header: PcdHeader, table: FieldTable, block_points: int
) -> Iterator[RawBlock]:
    """Yield blocks of a ``binary`` body: records of all fields, one point after the other."""
    yield from record_blocks(source, header.points, table, table.record, block_points)


def record_blocks(
    source: SourceFile, points: int, table: FieldTable, record: np.dtype[Any], block_points: int
) -> Iterator[RawBlock]:
    """Yield blocks of ``points`` records of type ``record``, which has the fields of ``table`` by name."""
    if not points:
        return
    point_bytes = record.itemsize
    rows = _balanced(points, min(block_points, _BLOCK_BYTES // point_bytes))
    with borrow_scratch() as scratch:
        raw, *columns = scratch.cut(((rows * point_bytes,), _BYTE), *table.block_shapes(rows))
        for start in range(0, points, rows):
            count = min(rows, points - start)
            part = raw[: count * point_bytes]
            source.read_into(part)
            block = tuple(columns) if count == rows else tuple(column[:count] for column in columns)
            table.put_records(block, part.view(record), source.path)
            yield block, ()


def _balanced(points: int, limit: int) -> int:
    """Rows per block: at most ``limit``, and no short block at the end."""
    blocks = -(-points // max(1, limit))
    return -(-points // blocks)


def compressed_blocks(
    source: SourceFile, header: PcdHeader, table: FieldTable, block_points: int
) -> Iterator[RawBlock]:
    """Yield blocks of a ``binary_compressed`` body: two uint32 sizes, then LZF over whole fields.

    Decompressed, the data is all values of the first field, then all of the second, ...  PCL leaves
    padding fields out; a file whose sizes say that they are in is read too.

    Raises
    ------
    MapDataError
        ``bad_lzf`` or ``truncated``; nothing is allocated for sizes that cannot be true.
    """
    if not header.points:
        return
    compressed_bytes, output_bytes = (int(size) for size in source.read(8).view("<u4"))
    with_padding = check_sizes(header, compressed_bytes, output_bytes, left=source.left, path=source.path)
    at = header.data_offset
    sound = lzf.reachable(compressed_bytes, output_bytes)
    rows = _balanced(header.points, block_points)
    with borrow_scratch() as scratch:
        shapes = (((output_bytes,), _BYTE), ((rows, 3), table.xyz_dtype))
        if sound and output_bytes > lzf.TRUST_BYTES:
            packed = source.read(compressed_bytes)
            sound = lzf.first_error(packed.data, output_bytes) is None
            if sound:
                data, xyz = scratch.cut(*shapes)
        elif sound:
            data, xyz, packed = scratch.cut(*shapes, ((compressed_bytes,), _BYTE))
            source.read_into(packed)
        if not sound or not lzf.decompress(packed, data):
            raise refusal(
                "bad_lzf",
                f"{compressed_bytes} bytes do not decompress to {output_bytes}",
                path=source.path,
                offset=at + 8,
            )
        fields = field_arrays(data, header, padded=with_padding)
        for start in range(0, header.points, rows):
            stop = min(start + rows, header.points)
            part = xyz[: stop - start]
            axes = tuple(fields[field.name][start:stop] for field in table.axes)
            for axis, values in enumerate(axes):
                table.put_axis(part, axis, values, source.path)
            others = [np.require(fields[field.name][start:stop], requirements="A") for field in table.others]
            yield (part, *others), axes if table.axes_are_xyz else ()


def check_sizes(header: PcdHeader, compressed_bytes: int, output_bytes: int, *, left: int, path: str) -> bool:
    """Check the two sizes before a compressed body against the header and the ``left`` bytes of the file.

    Returns
    -------
    Whether the decompressed data has the padding fields too.

    Raises
    ------
    MapDataError
        ``bad_lzf`` or ``truncated``.
    """
    with_padding = header.points * header.point_bytes
    without = header.points * sum(field.row_bytes for field in header.fields if not field.padding)
    if output_bytes not in (with_padding, without):
        raise refusal(
            "bad_lzf",
            f"{header.points} points are {without} bytes, but the data claims {output_bytes} decompressed",
            path=path,
            offset=header.data_offset + 4,
        )
    if compressed_bytes > left:
        raise refusal(
            "truncated",
            f"{compressed_bytes} compressed bytes announced, {left} are there",
            path=path,
            offset=header.data_offset,
        )
    return output_bytes == with_padding


def field_arrays(data: NDArray[np.uint8], header: PcdHeader, *, padded: bool) -> dict[str, NDArray[Any]]:
    """Return a view of each field's values in the decompressed bytes."""
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    for field in header.fields:
        nbytes = header.points * field.row_bytes
        if not field.padding:
            values = data[at : at + nbytes].view(field.dtype)
            arrays[field.name] = values if field.count == 1 else values.reshape(-1, field.count)
        if not field.padding or padded:
            at += nbytes
    return arrays
