# SPDX-License-Identifier: Apache-2.0
"""Read PLY block by block: every property of the vertices becomes a column of its name and type.

Rows of a fixed length are numpy records, in either byte order.  Lists, in the vertices or in elements before
them, make rows differ in length.  Such rows are walked one by one, and their lists left out.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.coordinate_system import CoordinateSystem
from shmmap.formats.pcd.body import record_blocks
from shmmap.formats.pcd.table import FieldTable
from shmmap.formats.ply_header import HEADER_LIMIT_BYTES, PlyElement, PlyHeader, parse_ply_header
from shmmap.formats.source_file import FileReader, refusal
from shmmap.formats.text_rows import RowParser, line_ends, whole_lines

__all__ = ["PlyReader"]

_FIRST_READ_BYTES: Final = 4096  # long enough for nearly every header
_WALK_BYTES: Final = 1 << 20
_SHOWN_NAME: Final = 60
_HEADER_END: Final = re.compile(rb"[\r\n]end_header[ \t]*\r?[\r\n].", re.DOTALL)
_COUNTERS: Final = {
    "i1": "b",
    "u1": "B",
    "i2": "h",
    "u2": "H",
    "i4": "i",
    "u4": "I",
    "i8": "q",
    "u8": "Q",
}

Block = tuple[NDArray[Any], ...]


class PlyReader(FileReader):
    """A PLY file, opened and its header checked.

    Attributes
    ----------
    points
        Vertices in the file.
    columns
        ``xyz`` first (float32 or float64, the smaller that holds every value), then every other property of
        the vertices that is no list, in file order, with its own type.
    encoding
        ``ascii``, ``binary_little_endian`` or ``binary_big_endian``.

    Raises
    ------
    MapDataError
        From the constructor and from `blocks`, with cause and byte offset.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        try:
            head = self._source.peek(min(self._source.size, _FIRST_READ_BYTES))
            if len(head) < self._source.size and not _HEADER_END.search(head):
                head = self._source.peek(min(self._source.size, HEADER_LIMIT_BYTES))
            self._header: PlyHeader = parse_ply_header(head, path=self.path, file_bytes=self._source.size)
        except BaseException:
            self.close()
            raise
        self._table = FieldTable(self._header.fields)
        self._oddities: list[str] = []
        self.crs: CoordinateSystem | None = None
        self.bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self.version = ""
        self.points = self._header.vertex.count
        self.columns: tuple[ColumnSpec, ...] = self._table.columns
        self.encoding = self._header.format
        record = self._table.record
        self._record = record.newbyteorder(">") if self.encoding == "binary_big_endian" else record

    @property
    def warnings(self) -> tuple[str, ...]:
        """Oddities of the header and of the data read so far."""
        return (*self._header.warnings, *self._oddities)

    def blocks(self, block_points: int, start: int = 0) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns of the points from ``start`` on, at most ``block_points`` rows at a time.

        The arrays are reused, so a caller that keeps one must copy it.

        Raises
        ------
        MapDataError
            ``truncated`` or ``bad_row`` if the data contradicts the header.
        """
        self._oddities.clear()
        self._source.at = self._header.data_offset
        if start >= self.points:
            return
        if self.encoding == "ascii":
            found = self._ascii_blocks(block_points, start)
        else:
            found = self._binary_blocks(block_points, start)
        names = [spec.name for spec in self.columns]
        for block in found:
            yield dict(zip(names, block, strict=True))

    # --- binary -----------------------------------------------------------------------------------

    def _binary_blocks(self, block_points: int, start: int) -> Iterator[Block]:
        source, vertex = self._source, self._header.vertex
        for element in self._header.before:
            if element.has_lists:
                for _ in self._walked(element, _WALK_BYTES, keep=False):
                    pass
            else:
                self._skip(element.least_row_bytes * element.count, element)
        if vertex.has_lists:
            for rows in self._walked(vertex, block_points, keep=True):
                skipped = min(start, len(rows) // self._record.itemsize)
                start -= skipped
                records = np.frombuffer(rows, self._record)[skipped:]
                if len(records):
                    block = self._table.empty_block(len(records))
                    self._table.put_records(block, records, self.path)
                    yield block
        else:
            row_bytes = self._record.itemsize
            self._check_left(row_bytes * vertex.count, vertex)
            source.at += row_bytes * start
            found = record_blocks(source, self.points - start, self._table, self._record, block_points)
            yield from (block for block, _ in found)
        if self._header.last and source.left:
            self._oddities.append(f"{source.left} bytes after the last vertex ignored")

    def _check_left(self, nbytes: int, element: PlyElement) -> None:
        if nbytes > self._source.left:
            raise refusal(
                "truncated",
                f"{element.count} rows of element {element.name[:_SHOWN_NAME]} need {nbytes} bytes,"
                f" {self._source.left} are left at byte {self._source.at}",
                path=self.path,
                offset=self._source.size,
            )

    def _skip(self, nbytes: int, element: PlyElement) -> None:
        self._check_left(nbytes, element)
        self._source.at += nbytes

    def _walked(self, element: PlyElement, block_rows: int, *, keep: bool) -> Iterator[bytes]:
        """Walk rows with lists; yield their other values, packed, ``block_rows`` rows at a time.

        Without ``keep`` the rows are only skipped.  At the end the source is at the byte after the last row.
        """
        source = self._source
        steps = _steps(element, ">" if self.encoding == "binary_big_endian" else "<")
        data, at, base = b"", 0, source.at  # data[0] is at byte ``base`` of the file
        rows = bytearray()
        gathered = 0
        for row in range(element.count):
            for fixed, counter, item_bytes in steps:
                needed = fixed + (counter.size if counter is not None else 0)
                if at + needed > len(data):
                    base, at = base + at, 0
                    if base + needed > source.size:
                        raise refusal(
                            "truncated",
                            f"the file ends within row {row + 1} of {element.count} of element"
                            f" {element.name[:_SHOWN_NAME]}",
                            path=self.path,
                            offset=source.size,
                        )
                    source.at = base
                    data = source.read(min(source.left, max(needed, _WALK_BYTES))).tobytes()
                if keep and fixed:
                    rows += data[at : at + fixed]
                at += fixed
                if counter is not None:
                    (items,) = counter.unpack_from(data, at)
                    if items < 0:
                        raise refusal(
                            "bad_row",
                            f"row {row + 1}: a list of {items} items",
                            path=self.path,
                            offset=base + at,
                        )
                    at += counter.size + items * item_bytes
            if keep:
                gathered += 1
                if gathered == block_rows:
                    yield bytes(rows)
                    rows.clear()
                    gathered = 0
        if base + at > source.size:
            raise refusal(
                "truncated",
                f"the last list of element {element.name[:_SHOWN_NAME]} ends at byte {base + at},"
                f" the file at {source.size}",
                path=self.path,
                offset=source.size,
            )
        source.at = base + at
        if rows:
            yield bytes(rows)

    # --- ascii ------------------------------------------------------------------------------------

    def _ascii_blocks(self, block_points: int, start: int) -> Iterator[Block]:
        parser = RowParser(self.path, self._table)
        ahead = sum(element.count for element in self._header.before)
        left = self.points
        vertex = self._header.vertex
        for offset, text in whole_lines(self._source, bare_cr=self._header.bare_cr):
            ends = line_ends(text)
            line = at = 0
            while ahead and line < len(ends):
                ahead -= bool(text[at : int(ends[line])].strip())
                at = int(ends[line])
                line += 1
            while line < len(ends) and left:
                line = min(line + min(block_points, left), len(ends))
                stop = int(ends[line - 1])
                part = text[at:stop]
                tokens = self._scalars(parser, part, offset + at, vertex) if vertex.has_lists else None
                block = parser.parse(part, offset + at, tokens)
                left -= len(block[0])
                at = stop
                skipped = min(start, len(block[0]))
                start -= skipped
                if skipped < len(block[0]):
                    yield tuple(column[skipped:] for column in block)
            if not left:
                if not self._header.last:
                    break
                parser.count_surplus(text[at:])
        if left:
            raise refusal(
                "truncated",
                f"{self.points} vertices announced, {self.points - left} rows are there",
                path=self.path,
                offset=self._source.size,
            )
        if parser.surplus:
            self._oddities.append(f"{parser.surplus} lines after the last vertex ignored")

    def _scalars(self, parser: RowParser, text: bytes, offset: int, vertex: PlyElement) -> list[bytes]:
        """Return the values of properties that are not lists, for rows that contain lists."""
        found: list[bytes] = []
        row = parser.rows
        for line in text.split(b"\n"):
            words = line.split()
            if words:
                row += 1
                place = 0
                for one in vertex.properties:
                    word = words[place] if place < len(words) else b""
                    place += 1
                    if one.counter is None:
                        found.append(word)
                    elif not word.isdigit() or len(word) > 10:
                        shown = word[:_SHOWN_NAME].decode("latin-1")
                        raise parser.row_error(row, offset, f"{shown!r} is not a number of items")
                    else:
                        place += int(word)
                if place != len(words):
                    raise parser.row_error(row, offset, f"{len(words)} values, {place} are needed")
            offset += len(line) + 1
        return found


def _steps(element: PlyElement, order: str) -> list[tuple[int, struct.Struct | None, int]]:
    """Return the steps through a row: bytes of fixed length, then a list's counter and bytes per item."""
    steps: list[tuple[int, struct.Struct | None, int]] = []
    fixed = 0
    for one in element.properties:
        if one.counter is None:
            fixed += one.dtype.itemsize
        else:
            counter = struct.Struct(order + _COUNTERS[one.counter.str[1:]])
            steps.append((fixed, counter, one.dtype.itemsize))
            fixed = 0
    if fixed:
        steps.append((fixed, None, 0))
    return steps
