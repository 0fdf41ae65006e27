# SPDX-License-Identifier: Apache-2.0
"""Read the points of PCD files in each encoding, as blocks of columns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.formats.pcd import lzf
from shmmap.formats.pcd.fields import FieldTable, RawBlock
from shmmap.formats.pcd.header import PcdHeader
from shmmap.formats.source_file import SourceFile, refusal
from shmmap.formats.text_rows import RowParser

_BLOCK_BYTES: Final = 1 << 20  # bytes of file data per block, at most
_BYTE: Final = np.dtype(np.uint8)

_KEPT_BYTES: Final = 16 << 20  # larger sets of buffers are not kept
_FIRST_BYTES: Final = 4 << 20  # from this size on numpy asks for huge pages; only touched pages count
_ALIGNMENT_BYTES: Final = 64
_idle: list[_Scratch] = []


def record_blocks(
    source: SourceFile, points: int, table: FieldTable, record: np.dtype[Any], block_points: int
) -> Iterator[RawBlock]:
    """Yield blocks of ``points`` records of type ``record``, which has the fields of ``table`` by name."""
    if not points:
        return
    point_bytes = record.itemsize
    rows = _balanced(points, min(block_points, _BLOCK_BYTES // point_bytes))
    with _borrow_scratch() as scratch:
        raw, *columns = scratch.cut(((rows * point_bytes,), _BYTE), *table.block_shapes(rows))
        for start in range(0, points, rows):
            count = min(rows, points - start)
            part = raw[: count * point_bytes]
            source.read_into(part)
            block = tuple(columns) if count == rows else tuple(column[:count] for column in columns)
            table.put_records(block, part.view(record), source.path)
            yield block, ()


def _balanced(points: int, limit: int) -> int:
    """Return the rows per block: at most ``limit``, without a short block at the end."""
    blocks = -(-points // max(1, limit))
    return -(-points // blocks)


def compressed_blocks(source: SourceFile, header: PcdHeader, block_points: int) -> Iterator[RawBlock]:
    """Yield blocks of a ``binary_compressed`` body: two uint32 sizes, then LZF over whole fields.

    Decompressed, the data is all values of the first field, then all of the second, ...  PCL leaves padding
    fields out; a file whose sizes include them is read, too.

    Raises
    ------
    MapDataError
        ``bad_lzf`` or ``truncated``; nothing is allocated for impossible sizes.
    """
    if not header.points:
        return
    compressed_bytes, output_bytes = (int(size) for size in source.read(8).view("<u4"))
    with_padding = check_sizes(header, compressed_bytes, output_bytes, left=source.left, path=source.path)
    table = header.table
    rows = _balanced(header.points, block_points)
    with _borrow_scratch() as scratch:
        shapes = (((output_bytes,), _BYTE), ((rows, 3), table.xyz_dtype))
        if output_bytes > lzf.TRUST_BYTES:
            packed = source.read(compressed_bytes)
            if lzf.first_error(packed.data, output_bytes) is not None:
                raise _not_lzf(header, compressed_bytes, output_bytes, source.path)
            data, xyz = scratch.cut(*shapes)
        else:
            data, xyz, packed = scratch.cut(*shapes, ((compressed_bytes,), _BYTE))
            source.read_into(packed)
        decompress(packed, data, header, source.path)
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
    """Check the two sizes of a compressed body against the header and the ``left`` bytes of the file.

    Returns
    -------
    Whether the decompressed data has the padding fields too.

    Raises
    ------
    MapDataError
        ``bad_lzf`` or ``truncated``; also if no LZF stream of that length becomes so long.
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
    if not lzf.reachable(compressed_bytes, output_bytes):
        raise _not_lzf(header, compressed_bytes, output_bytes, path)
    return output_bytes == with_padding


def decompress(packed: NDArray[np.uint8], data: NDArray[np.uint8], header: PcdHeader, path: str) -> None:
    """Decompress the whole body of a file into ``data``, or raise ``bad_lzf``."""
    if not lzf.decompress(packed, data):
        raise _not_lzf(header, len(packed), len(data), path)


def _not_lzf(header: PcdHeader, compressed_bytes: int, output_bytes: int, path: str) -> MapDataError:
    return refusal(
        "bad_lzf",
        f"{compressed_bytes} bytes do not decompress to {output_bytes}",
        path=path,
        offset=header.data_offset + 8,
    )


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


def ascii_blocks(
    source: SourceFile, header: PcdHeader, block_points: int, warnings: list[str]
) -> Iterator[RawBlock]:
    """Yield blocks of an ``ascii`` body: one line per point, values separated by white space.

    Raises
    ------
    MapDataError
        ``bad_row`` with the row (counted from 1) and its byte offset, or ``truncated`` when there
        are fewer rows than points.
    """
    parser = RowParser(source.path, header.table)
    for block in parser.blocks(source, header.points, block_points):
        yield block, ()
    if parser.skipped:
        warnings.append(f"{parser.skipped} blank or comment lines among the points ignored")
    if parser.surplus:
        warnings.append(f"{parser.surplus} lines after the last point ignored")


class _Scratch:
    """One growing buffer, cut into arrays that stay valid until the next `cut`.

    The buffer is used for many files: cells are small and many, and a new buffer for each would cost more in
    page faults than reading the file.
    """

    def __init__(self) -> None:
        self._memory: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._start = 0

    def __enter__(self) -> _Scratch:
        return self

    def __exit__(self, *_: object) -> None:
        if not _idle and self.nbytes <= _KEPT_BYTES:
            _idle.append(self)

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self._memory.nbytes

    def cut(self, *shapes: tuple[tuple[int, ...], np.dtype[Any]]) -> tuple[NDArray[Any], ...]:
        """Return one uninitialised C-contiguous array per (shape, dtype)."""
        sizes = [math.prod(shape) * dtype.itemsize for shape, dtype in shapes]
        steps = [-(-size // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES for size in sizes]
        needed = sum(steps) + _ALIGNMENT_BYTES
        if len(self._memory) < needed:
            self._memory = np.empty(max(needed, _FIRST_BYTES), np.uint8)
            self._start = -self._memory.ctypes.data % _ALIGNMENT_BYTES
        at = self._start
        arrays: list[NDArray[Any]] = []
        for (shape, dtype), size, step in zip(shapes, sizes, steps, strict=True):
            arrays.append(self._memory[at : at + size].view(dtype).reshape(shape))
            at += step
        return tuple(arrays)


def _borrow_scratch() -> _Scratch:
    """Return a buffer for the block of a ``with``; at most one idle buffer is kept."""
    try:
        return _idle.pop()
    except IndexError:
        return _Scratch()
