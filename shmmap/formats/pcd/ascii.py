# SPDX-License-Identifier: Apache-2.0
"""The points of ``ascii`` PCD files, as blocks of columns."""

from __future__ import annotations

from collections.abc import Iterator

from shmmap.formats.causes import refusal
from shmmap.formats.pcd.header import PcdHeader
from shmmap.formats.pcd.table import FieldTable, RawBlock
from shmmap.formats.source_file import SourceFile
from shmmap.formats.text_rows import RowParser, line_ends, whole_lines

__all__ = ["ascii_blocks"]


def ascii_blocks(
    source: SourceFile, header: PcdHeader, table: FieldTable, block_points: int, warnings: list[str]
) -> Iterator[RawBlock]:
    """Yield blocks of an ``ascii`` body: one line per point, values separated by white space.

    Raises
    ------
    MapDataError
        ``bad_row`` with the row (counted from 1) and its byte offset, or ``truncated`` when there
        are fewer rows than points.
    """
    parser = RowParser(source.path, table)
    left = header.points
    for offset, text in whole_lines(source):
        ends = line_ends(text)
        line = at = 0
        while line < len(ends) and left:
            line = min(line + min(block_points, left), len(ends))
            stop = int(ends[line - 1])
            block = parser.parse(text[at:stop], offset + at)
            left -= len(block[0])
            at = stop
            if len(block[0]):
                yield block, ()
        parser.count_surplus(text[at:])
    if left:
        points = header.points
        raise refusal(
            "truncated",
            f"{points} points announced, {points - left} rows are there",
            path=source.path,
            offset=source.size,
        )
    if parser.skipped:
        warnings.append(f"{parser.skipped} blank or comment lines among the points ignored")
    if parser.surplus:
        warnings.append(f"{parser.surplus} lines after the last point ignored")
