# SPDX-License-Identifier: Apache-2.0
"""The points of ``binary`` and ``binary_compressed`` PCD files, as blocks of columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.formats import lzf
from shmmap.formats.causes import refusal
from shmmap.formats.pcd_header import PcdField
from shmmap.formats.pcd_table import FieldTable
from shmmap.formats.source_file import SourceFile

__all__ = ["binary_blocks", "compressed_blocks"]

_BLOCK_BYTES: Final = 1 << 20  # of file data per block, at most


def binary_blocks(
    source: SourceFile, table: FieldTable, block_points: int
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield blocks of a ``binary`` body: records of all fields, one point after the other."""
    points, point_bytes = table.header.points, table.header.point_bytes
    if not points:
        return
    rows = max(1, min(points, block_points, _BLOCK_BYTES // point_bytes))
    record = _record_dtype(table.header.fields)
    names = [(f"f{table.header.fields.index(field)}", index) for index, field in enumerate(table.others, 1)]
    axes = [f"f{table.header.fields.index(field)}" for field in table.axes]
    columns = table.empty_block(rows)
    for start in range(0, points, rows):
        count = min(rows, points - start)
        records = source.read(count * point_bytes).view(record)
        block = columns if count == rows else tuple(column[:count] for column in columns)
        for axis, name in enumerate(axes):
            table.put_axis(block[0], axis, records[name], source.path)
        for name, index in names:
            block[index][...] = records[name]
        yield block


def _record_dtype(fields: tuple[PcdField, ...]) -> np.dtype[Any]:
    """Return the packed type of one record; field number i is called ``f<i>``, padding is skipped."""
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    at = 0
    for index, field in enumerate(fields):
        if not field.padding:
            names.append(f"f{index}")
            formats.append(field.dtype if field.count == 1 else (field.dtype, (field.count,)))
            offsets.append(at)
        at += field.row_bytes
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})


def compressed_blocks(
    source: SourceFile, table: FieldTable, block_points: int
) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield blocks of a ``binary_compressed`` body: two uint32 sizes, then LZF over whole fields.

    Decompressed, the data is all values of the first field, then all of the second, ...  PCL leaves
    padding fields out; a file whose sizes say that they are in is read too.

    Raises
    ------
    MapDataError
        ``bad_lzf`` or ``truncated``; nothing is allocated for sizes that cannot be true.
    """
    header = table.header
    if not header.points:
        return
    compressed_bytes, output_bytes = (int(size) for size in source.read(8).view("<u4"))
    with_padding = header.points * header.point_bytes
    without = header.points * sum(field.row_bytes for field in header.fields if not field.padding)
    at = header.data_offset
    if output_bytes not in (with_padding, without):
        raise refusal(
            "bad_lzf",
            f"{header.points} points are {without} bytes, but the data claims {output_bytes} decompressed",
            path=source.path,
            offset=at + 4,
        )
    if compressed_bytes > source.left:
        raise refusal(
            "truncated",
            f"{compressed_bytes} compressed bytes announced, {source.left} are there",
            path=source.path,
            offset=at,
        )
    data = lzf.decompress(source.read_bytes(compressed_bytes), output_bytes)
    if data is None:
        raise refusal(
            "bad_lzf",
            f"{compressed_bytes} bytes do not decompress to {output_bytes}",
            path=source.path,
            offset=at + 8,
        )
    fields = _field_arrays(data, header.fields, header.points, padded=output_bytes == with_padding)
    rows = max(1, min(header.points, block_points))
    xyz = np.empty((rows, 3), table.xyz_dtype)
    for start in range(0, header.points, rows):
        stop = min(start + rows, header.points)
        part = xyz[: stop - start]
        for axis, field in enumerate(table.axes):
            table.put_axis(part, axis, fields[field.name][start:stop], source.path)
        yield (
            part,
            *(np.require(fields[field.name][start:stop], requirements=["C", "A"]) for field in table.others),
        )


def _field_arrays(
    data: bytes, fields: tuple[PcdField, ...], points: int, *, padded: bool
) -> dict[str, NDArray[Any]]:
    """Return a view of each field's values in the decompressed bytes."""
    arrays: dict[str, NDArray[Any]] = {}
    at = 0
    for field in fields:
        if not field.padding:
            values = np.frombuffer(data, field.dtype, points * field.count, at)
            arrays[field.name] = values if field.count == 1 else values.reshape(points, field.count)
        if not field.padding or padded:
            at += points * field.row_bytes
    return arrays
