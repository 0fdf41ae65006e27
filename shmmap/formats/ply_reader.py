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
from shmmap.formats.pcd.fields import FieldTable
from shmmap.formats.ply_header import HEADER_LIMIT_BYTES, PlyElement, PlyHeader, parse_ply_header
from shmmap.formats.point_checks import PointChecks
from shmmap.formats.source_file import FileReader, refusal
from shmmap.formats.text_rows import RowParser

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
        self._table = FieldTable(self._header.fields)
        self._oddities: list[str] = []
        self.checks = PointChecks()
        self.crs: CoordinateSystem | None = self._header.crs
        self.bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self.version = ""
        self.points = self._header.vertex.count
        self.columns: tuple[ColumnSpec, ...] = self._table.columns
        self.encoding = self._header.format
        record = self._table.record
        self._record = record.newbyteorder(">") if self.encoding == "binary_big_endian" else record

    def _read_header(self) -> None:
        head = self._source.head(_HEADER_END, HEADER_LIMIT_BYTES)
        self._header: PlyHeader = parse_ply_header(head, path=self.path, file_bytes=self._source.size)

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
            yield from self._table.named(self._ascii_blocks(block_points), start)
            return
        for element in self._header.before:
            if element.has_lists:
                for _ in self._walked(element, _WALK_BYTES, keep=False):
                    pass
            else:
                self._skip(element, element.count)
        if self._header.vertex.has_lists:
            yield from self._table.named(self._list_blocks(block_points), start)
        else:
            self._skip(self._header.vertex, start)
            left = self.points - start
            found = record_blocks(self._source, left, self._table, self._record, block_points)
            yield from self._table.named((block for block, _ in found), 0)
        if self._header.last and self._source.left:
            self._oddities.append(f"{self._source.left} bytes after the last vertex ignored")

    # --- binary -----------------------------------------------------------------------------------

    def _skip(self, element: PlyElement, rows: int) -> None:
        """Skip the first ``rows`` of an element without lists, all of whose rows have to be there."""
        source, needed = self._source, element.least_row_bytes * element.count
        if needed > source.left:
            raise refusal(
                "truncated",
                f"{element.count} rows of element {element.name[:_SHOWN_NAME]} need {needed} bytes,"
                f" {source.left} are left at byte {source.at}",
                path=self.path,
                offset=source.size,
            )
        source.at += element.least_row_bytes * rows

    def _list_blocks(self, block_points: int) -> Iterator[Block]:
        for rows in self._walked(self._header.vertex, block_points, keep=True):
            records = np.frombuffer(rows, self._record)
            block = self._table.empty_block(len(records))
            self._table.put_records(block, records, self.path)
            yield block

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

    def _ascii_blocks(self, block_points: int) -> Iterator[Block]:
        header = self._header
        if header.vertex.has_lists:
            parser: RowParser = _ListRowParser(self.path, self._table, header.vertex)
        else:
            parser = RowParser(self.path, self._table)
        yield from parser.blocks(
            self._source,
            self.points,
            block_points,
            what="vertices",
            ahead=sum(element.count for element in header.before),
            last=header.last,
            bare_cr=header.bare_cr,
        )
        if parser.surplus:
            self._oddities.append(f"{parser.surplus} lines after the last vertex ignored")


class _ListRowParser(RowParser):
    """Parses rows that contain lists, and leaves these out."""

    def __init__(self, path: str, table: FieldTable, vertex: PlyElement) -> None:
        super().__init__(path, table)
        self._properties = vertex.properties

    def tokens(self, text: bytes, offset: int) -> list[bytes]:
        found: list[bytes] = []
        row = self.rows
        for line in text.split(b"\n"):
            words = line.split()
            if words:
                row += 1
                place = 0
                for one in self._properties:
                    word = words[place] if place < len(words) else b""
                    place += 1
                    if one.counter is None:
                        found.append(word)
                    elif not word.isdigit() or len(word) > 10:
                        shown = word[:_SHOWN_NAME].decode("latin-1")
                        raise self.row_error(row, offset, f"{shown!r} is not a number of items")
                    else:
                        place += int(word)
                if place != len(words):
                    raise self.row_error(row, offset, f"{len(words)} values, {place} are needed")
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
