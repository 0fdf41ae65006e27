# SPDX-License-Identifier: Apache-2.0
"""Check the compression metadata of a LAZ file before a decompressor allocates memory for it.

The LASzip record names the items that make a point; the table of chunks counts their bytes and, where chunks
differ in size, their points; a chunk of LAS 1.4's formats counts its layers.  lazrs trusts all of these
numbers, and a wrong one makes it abort the process for lack of memory.  Format as in LASzip 3 (laszip_dll,
`src/laszip.cpp`).
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import IO, Final

from shmmap.errors import MapDataError
from shmmap.formats.source_file import refusal

_RECORD: Final = struct.Struct("<H10xI16xH")  # compressor, points per chunk, items
_ITEM: Final = struct.Struct("<HHH")  # type, bytes, version
_VARIABLE: Final = (0, 0xFFFFFFFF)  # points per chunk if the table counts them
_LAYERED: Final = 3  # compressor whose chunks count their points and layers
_CHUNKED: Final = (2, _LAYERED)
_POINT10, _GPS, _RGB, _WAVE, _POINT14, _RGB14, _RGBNIR14, _WAVE14 = range(6, 14)
_EXTRA, _EXTRA14 = 0, 14
_ITEMS: Final = {  # item types of each point format
    0: (_POINT10,),
    1: (_POINT10, _GPS),
    2: (_POINT10, _RGB),
    3: (_POINT10, _GPS, _RGB),
    4: (_POINT10, _GPS, _WAVE),
    5: (_POINT10, _GPS, _RGB, _WAVE),
    6: (_POINT14,),
    7: (_POINT14, _RGB14),
    8: (_POINT14, _RGBNIR14),
    9: (_POINT14, _WAVE14),
    10: (_POINT14, _RGBNIR14, _WAVE14),
}
_BYTES: Final = {
    _POINT10: 20,
    _GPS: 8,
    _RGB: 6,
    _WAVE: 29,
    _POINT14: 30,
    _RGB14: 6,
    _RGBNIR14: 8,
    _WAVE14: 29,
}
_LAYERS: Final = {_POINT14: 9, _RGB14: 1, _RGBNIR14: 2, _WAVE14: 1}
_WHOLE_CHUNK_BYTES: Final = 256 << 20  # bytes of one chunk's points, held at once


def standard_bytes(point_format: int) -> int:
    """Return the bytes of a point without extra bytes; 0 for a format that LAS does not have."""
    return sum(_BYTES[kind] for kind in _ITEMS.get(point_format, ()))


@dataclass(frozen=True, slots=True)
class LazChunks:
    """Summary of a file's chunks.

    Attributes
    ----------
    points
        Points in all chunks; None if neither the table nor the chunks contain counts.
    small
        Whether the points of each chunk fit in memory, so that several can be decompressed at once.
    """

    points: int | None
    small: bool


def check_laz(
    path: str, laszip: bytes, *, point_format: int, record_bytes: int, data_at: int
) -> LazChunks | None:
    """Check a LAZ file's LASzip record against its header, and its chunks against the file's bytes.

    Parameters
    ----------
    path
        The file, whose table of chunks lies inside it.
    laszip
        Content of its LASzip record.
    point_format, record_bytes, data_at
        From the header: format without the compression bits, bytes of an uncompressed point, and byte offset
        of the chunks.

    Returns
    -------
    LazChunks or None
        None for a file without chunks, which is decompressed point by point.

    Raises
    ------
    MapDataError
        ``bad_las``.
    """
    import lazrs

    if len(laszip) < _RECORD.size or len(laszip) < _RECORD.size + _ITEM.size * _RECORD.unpack_from(laszip)[2]:
        raise _damaged(path, "its LASzip record is missing or too short")
    compressor, chunk_points, count = _RECORD.unpack_from(laszip)
    items = [_ITEM.unpack_from(laszip, _RECORD.size + place * _ITEM.size) for place in range(count)]
    _check_items(path, items, point_format, record_bytes)
    if compressor not in _CHUNKED:
        return None
    size = os.stat(path).st_size
    with open(path, "rb") as file:
        file.seek(data_at)
        try:
            chunks: list[tuple[int, int]] = lazrs.read_chunk_table(file, lazrs.LazVlr(laszip))
        except (lazrs.LazrsError, OSError, OverflowError, MemoryError) as error:
            raise _damaged(path, f"its table of chunks: {error}", data_at) from error
        room = size - data_at - 8
        if sum(nbytes for _, nbytes in chunks) > room:
            message = f"its table of chunks announces more than the {room} bytes after its header"
            raise _damaged(path, message, data_at)
        counts = [points for points, _ in chunks]
        if compressor == _LAYERED:
            layers = sum(nbytes if kind == _EXTRA14 else _LAYERS[kind] for kind, nbytes, _ in items)
            counted = _check_layers(path, file, chunks, layers, record_bytes, data_at + 8)
            counts[-1:] = counted[-1:]  # with fixed points per chunk, the table lacks the last count
        elif chunk_points not in _VARIABLE:
            counts = []
    most = max([points for points, _ in chunks], default=0)
    return LazChunks(sum(counts) if counts else None, most * record_bytes <= _WHOLE_CHUNK_BYTES)


def _check_items(path: str, items: list[tuple[int, int, int]], point_format: int, record_bytes: int) -> None:
    """Check the items of a compressed point against the point format in the header."""
    needed = _ITEMS.get(point_format, ())
    extra = record_bytes - standard_bytes(point_format)
    expected = [(kind, _BYTES[kind]) for kind in needed]
    if extra:
        expected.append((_EXTRA14 if needed[:1] == (_POINT14,) else _EXTRA, extra))
    if [(kind, nbytes) for kind, nbytes, _ in items] != expected:
        message = f"its LASzip record is not of point format {point_format} of {record_bytes} bytes"
        raise _damaged(path, message)


def _check_layers(
    path: str, file: IO[bytes], chunks: list[tuple[int, int]], layers: int, record_bytes: int, at: int
) -> list[int]:
    """Check each chunk's layers, after its uncompressed first point, against its bytes; return its points."""
    form = struct.Struct(f"<{1 + layers}I")
    counted = []
    for _, nbytes in chunks:
        if not nbytes:  # some programs write an empty last chunk if the points fill the others
            counted.append(0)
            continue
        file.seek(at + record_bytes)
        head = file.read(form.size)
        if len(head) < form.size:
            raise _damaged(path, "a chunk ends within its first point", at)
        points, *sizes = form.unpack(head)
        if record_bytes + form.size + sum(sizes) > nbytes:
            message = f"a chunk of {nbytes} bytes announces {sum(sizes)} bytes of layers"
            raise _damaged(path, message, at)
        counted.append(points)
        at += nbytes
    return counted


def _damaged(path: str, message: str, offset: int | None = None) -> MapDataError:
    hint = "the file is damaged: copy it again, or let the program that made it write it again"
    return refusal("bad_las", message, path=path, offset=offset, hint=hint)
