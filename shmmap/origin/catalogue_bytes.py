# SPDX-License-Identifier: Apache-2.0
"""A catalogue as bytes: in a file (`shmmap.origin.sidecar`) or a pipe (`shmmap.origin.reading_apart`).

Layout, little-endian::

    0   8 bytes   magic "SHMMAPCT"
    8   uint32    version of this layout, 1
    12  uint32    bytes of the header
    16  uint64    XXH3 (64 bit) of everything after this field
    24  header    JSON: key, sources, prefix, cells, name_bytes, problems; then zero bytes to a multiple of 8
    ..  names     cells x name_bytes, zero padded; then zero bytes to a multiple of 8
    ..  boxes     float64: all min_x, all min_y, all max_x, all max_y
    ..  stamps    int64: size, mtime_ns, ctime_ns of each cell

A reader takes one column after the other.  Names and boxes that are those of the map's state before are not
kept a second time: of a million cells whose files have changed, a new state takes 24 bytes a cell.
"""

from __future__ import annotations

import math
import os
import stat
import struct
from collections.abc import Sequence
from typing import IO, Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64

from shmmap.origin.catalogue import Catalogue

__all__ = ["Header", "Source", "read_catalogue", "write_catalogue"]

_MAGIC: Final = b"SHMMAPCT"
_VERSION: Final = 1
_START: Final = struct.Struct("<8sIIQ")
_BLOCK_BYTES: Final = 1 << 18


class Source(msgspec.Struct, frozen=True, array_like=True):
    """State of a file or directory that a catalogue was made from."""

    path: str
    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int

    @classmethod
    def of(cls, path: str, status: os.stat_result) -> Source:
        """State of ``path`` as `os.stat` gave it.  A directory's size says nothing and counts as 0."""
        size = 0 if stat.S_ISDIR(status.st_mode) else status.st_size
        return cls(path, size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)


class Header(msgspec.Struct, forbid_unknown_fields=True):
    """What is written before the columns.

    Attributes
    ----------
    key
        What the catalogue was asked for by.
    sources
        What it was made from.
    prefix, problems
        As in `Catalogue`.
    cells, name_bytes
        How many cells; how many bytes the longest name has.
    """

    key: str
    sources: list[Source]
    prefix: str
    cells: int
    name_bytes: int
    problems: list[str]


def write_catalogue(file: IO[bytes], key: str, sources: Sequence[Source], catalogue: Catalogue) -> None:
    """Write a catalogue, and what it was made from."""
    names = np.ascontiguousarray(catalogue.names)
    header = msgspec.json.encode(
        Header(
            key=key,
            sources=list(sources),
            prefix=catalogue.id_prefix,
            cells=len(catalogue),
            name_bytes=names.dtype.itemsize,
            problems=list(catalogue.problems),
        )
    )
    parts: list[bytes | memoryview] = [
        header.ljust(_padded(len(header)), b"\0"),
        names.view(np.uint8).data,
        bytes(_padded(names.nbytes) - names.nbytes),
        np.ascontiguousarray(catalogue.boxes.T).data,
        np.ascontiguousarray(catalogue.stamps).data,
    ]
    digest = xxh3_64()
    for part in parts:
        digest.update(part)
    file.write(_START.pack(_MAGIC, _VERSION, len(header), digest.intdigest()))
    for part in parts:
        file.write(part)


def read_catalogue(
    file: IO[bytes], size_bytes: int | None = None, before: Catalogue | None = None
) -> tuple[Header, Catalogue]:
    """Read a catalogue up to the end of a file or pipe.

    Parameters
    ----------
    size_bytes
        Bytes of the file; None where they are not known, and the writer is to be trusted.
    before
        An earlier state: columns that have not changed are shared with it.

    Raises
    ------
    ValueError, msgspec.MsgspecError, MapDataError
        It is damaged, or not whole.
    """
    columns = _Columns(file)
    start = bytearray(_START.size)
    columns.fill(memoryview(start))
    magic, version, header_bytes, digest = _START.unpack(start)
    if magic != _MAGIC or version != _VERSION:
        raise ValueError("its magic or version is another")
    columns.digest.reset()
    after_header = _START.size + _padded(header_bytes)
    if size_bytes is not None and size_bytes < after_header:
        raise ValueError("it is truncated")
    written = memoryview(bytearray(_padded(header_bytes)))
    columns.fill(written)
    header = msgspec.json.decode(written[:header_bytes], type=Header)
    cells, name_bytes = header.cells, header.name_bytes
    if min(cells, name_bytes) < 0:
        raise ValueError("its header makes no sense")
    if size_bytes is not None and size_bytes != after_header + _padded(cells * name_bytes) + cells * (
        32 + 24
    ):
        raise ValueError("its size contradicts its header")
    old_names = before.names if before is not None and before.id_prefix == header.prefix else None
    old_boxes = before.boxes.T if before is not None else None
    names = columns.take(np.dtype(f"S{name_bytes}"), (cells,), old_names)
    columns.fill(memoryview(bytearray(_padded(cells * name_bytes) - cells * name_bytes)))
    boxes = columns.take(np.dtype(np.float64), (4, cells), old_boxes)
    stamps = columns.take(np.dtype(np.int64), (cells, 3), None)  # not shared: they are corrected in place
    if columns.digest.intdigest() != digest:
        raise ValueError("its checksum is wrong")
    return header, Catalogue(
        id_prefix=header.prefix,
        names=names,
        boxes=before.boxes if before is not None and boxes is old_boxes else boxes.T,
        stamps=stamps,
        problems=header.problems,
        before=before,
    )


class _Columns:
    """Takes columns from a file or pipe, one after the other, and hashes them."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.digest = xxh3_64()

    def fill(self, buffer: memoryview) -> None:
        """Take as many bytes as there is room for."""
        for begin in range(0, len(buffer), _BLOCK_BYTES):
            block = buffer[begin : begin + _BLOCK_BYTES]
            if self._file.readinto(block) != len(block):  # type: ignore[attr-defined]
                raise ValueError("it is truncated")
            self.digest.update(block)

    def take(self, dtype: np.dtype[Any], shape: tuple[int, ...], before: NDArray[Any] | None) -> NDArray[Any]:
        """Take one column; ``before`` itself where that has the same bytes."""
        size = dtype.itemsize * math.prod(shape)
        column: NDArray[np.uint8] | None = None
        done = 0
        if before is not None and before.dtype == dtype and before.shape == shape:
            old = before.reshape(-1).view(np.uint8)
            block = np.empty(min(size, _BLOCK_BYTES), np.uint8)
            while column is None and done < size:
                part, there = block[: size - done], old[done : done + _BLOCK_BYTES]
                self.fill(part.data)
                if not np.array_equal(part, there):
                    column = np.empty(size, np.uint8)
                    column[:done], column[done : done + len(part)] = old[:done], part
                done += len(part)
            if column is None:
                return before
        else:
            column = np.empty(size, np.uint8)
        self.fill(column[done:].data)
        return column.view(dtype).reshape(shape)


def _padded(size: int) -> int:
    return -(-size // 8) * 8
