# SPDX-License-Identifier: Apache-2.0
"""Read plain text clouds, one point a line: XYZ variants, PTS, and tables with named columns (TXT, CSV, ASC).

Values are separated by white space, commas or semicolons.  Columns are named by a header, a comment or the
first line (``//X Y Z I R G B``, ``# x y z intensity``, ``x [mm],y [mm],z [mm],ring``), which may state units,
as may comments (``# units: mm``).  Without names x, y and z are the first three, the others are guessed from
their number, and a warning reports the guess.  All values are float64.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec, column_names
from shmmap.errors import MapDataError
from shmmap.formats.coordinate_system import CoordinateSystem, LengthUnit
from shmmap.formats.pcd.fields import AXES, MAX_FIELDS, FieldTable, PcdField
from shmmap.formats.point_checks import NAME_THEM, TextChecks
from shmmap.formats.source_file import FileReader, refusal
from shmmap.formats.stated_units import (
    coordinates_of,
    decoded,
    scale_notes,
    split_names,
    system_of_comments,
    units_in_comments,
    units_row,
)
from shmmap.formats.text_rows import NUMBER, RowParser, line_ends, whole_lines

TEXT_SUFFIXES: Final = (".pts", ".xyz", ".xyzn", ".xyzrgb")
TABLE_SUFFIXES: Final = (".txt", ".csv", ".asc")
"""Endings that are read if the file is named; in a directory such files may be anything."""

_HEAD_BYTES: Final = 1 << 16  # the first point must begin within this
_COMMENT: Final = re.compile(rb"(?m)^[ \t]*(?:#|//|%)[^\r\n]*")
_NO_ROW: Final = re.compile(rb"(?m)^[ \t\r\v\f]*(?:$|#|//|%)")
_NORMALS: Final = ("nx", "ny", "nz")
_COLOURS: Final = ("red", "green", "blue")
_UNNAMED: Final = {1: ("intensity",), 3: _COLOURS, 4: ("intensity", *_COLOURS)}
"""Names of the columns after x, y and z, by their number, as in PTS files."""
_NORMAL_LENGTHS: Final = (0.99, 1.01)
_LOOKED_AT: Final = 1024  # rows to look at
_FEW: Final = 10  # rows, which may be so by chance
_LOOKED_AT_NORMALS: Final = 32
_LARGE: Final = 1e100  # no coordinate; its square could not be computed
_SHOWN: Final = 60


@dataclass(slots=True)
class _Layout:
    """The layout of a file, found from its first lines.

    ``names`` are the columns' names, including x, y and z; ``separator`` is empty for white space; ``crs``
    has the units that the file states.
    """

    names: list[str]
    data_at: int
    separator: bytes = b""
    trailing: bool = False
    announced: int | None = None
    crs: CoordinateSystem | None = None
    warnings: tuple[str, ...] = ()
    guessed: bool = False


class TextReader(FileReader):
    """A text file, opened, its layout known and its points counted.

    Attributes
    ----------
    points
        Lines with a point.
    columns
        ``xyz`` first, then every other column of the file, in its order; float64.
    crs
        Units that the file states; None if it states none.
    warnings
        Oddities of the file.
    checks
        What is odd about the points; what reads points adds them.

    Raises
    ------
    MapDataError
        ``bad_row``, ``no_xyz``, ``bad_header``, ``not_metres``, ``truncated`` and the causes of files that
        cannot be opened, with the byte offset and, for a row, its line.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self.columns: tuple[ColumnSpec, ...] = self._table.columns
        self.crs: CoordinateSystem | None = self._layout.crs
        self.bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self.encoding = self.version = ""
        self.warnings: tuple[str, ...] = self._layout.warnings
        plane, height = (self.crs or CoordinateSystem()).units
        self.checks = TextChecks(guessed=self._layout.guessed, unit_m=(plane.metres, height.metres))

    def _read_header(self) -> None:
        head = self._source.peek(min(self._source.size, _HEAD_BYTES))
        self._bare_cr = b"\r" in head and b"\n" not in head
        if self._bare_cr:
            head = head.replace(b"\r", b"\n")
        suffix = os.path.splitext(self.path)[1].lower()
        self._layout = _Lines(head, self.path, suffix, self._source.size).layout()
        others = iter(column_names(name for name in self._layout.names if name not in AXES))
        names = (name if name in AXES else next(others) for name in self._layout.names)
        self._table = FieldTable(tuple(PcdField(name, np.dtype("<f8")) for name in names))
        self.points = sum(self._rows(text) for _, text in self._texts())
        announced = self._layout.announced
        if announced is not None and announced != self.points:
            raise refusal(
                "truncated" if announced > self.points else "bad_header",
                f"the first line announces {announced} points, {self.points} lines of points follow",
                path=self.path,
                offset=self._source.size if announced > self.points else 0,
            )

    def blocks(self, block_points: int, start: int = 0) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns of the points from ``start`` on, at most ``block_points`` rows at a time.

        Raises
        ------
        MapDataError
            ``bad_row``: the number of values differs from the first row's, or a value is no number.
        """
        parser = RowParser(self.path, self._table, self._line_at)
        for offset, text in self._texts():
            plain = self._plain(parser, text, offset)
            ends = line_ends(plain)
            for first in range(0, len(ends), block_points):
                last = min(first + block_points, len(ends))
                begin, stop = int(ends[first - 1]) if first else 0, int(ends[last - 1])
                if start and (rows := self._rows(plain[begin:stop])) <= start:
                    start -= rows
                    continue
                yield from self._table.named([parser.parse(plain[begin:stop], offset + begin)], start)
                start = 0

    def _texts(self) -> Iterator[tuple[int, bytes]]:
        """Yield (offset, text) of whole lines from the first point on."""
        self._source.at = min(self._layout.data_at, self._source.size)
        return whole_lines(self._source, bare_cr=self._bare_cr)

    def _rows(self, text: bytes) -> int:
        """Return the number of lines in ``text`` that contain a point."""
        body = text.removesuffix(b"\n")
        return body.count(b"\n") + 1 - sum(1 for _ in _NO_ROW.finditer(body))

    def _plain(self, parser: RowParser, text: bytes, offset: int) -> bytes:
        """Return the text at equal length with values separated by spaces, and comments after ``#``."""
        if b"#" in text or b"//" in text or b"%" in text:
            text = _COMMENT.sub(lambda found: b"#".ljust(len(found.group())), text)
        separator = self._layout.separator
        if not separator:
            return text
        if self._layout.trailing:
            text = re.sub(separator + rb"(?=[ \t]*\r?$)", b" ", text, flags=re.MULTILINE)
        values = len(self._layout.names)
        empty = re.search(rb"(?m)(?:^|%s)[ \t]*(?:(?=%s)|(?<=%s)\r?$)" % ((separator,) * 3), text)
        if empty is not None or text.count(separator) != (values - 1) * self._rows(text):
            at = 0
            for line in text.split(b"\n"):
                words = line.split(separator)
                is_row = line.strip() and not line.lstrip().startswith(b"#")
                if is_row and (len(words) != values or any(len(word.split()) != 1 for word in words)):
                    what = f"{values} values separated by {separator.decode()!r}"
                    raise parser.row_error(0, offset + at, f"{_shown(line)} is not {what}")
                at += len(line) + 1
        return text.replace(separator, b" ")

    def _line_at(self, offset: int) -> int:
        """Return the number, counted from 1, of the line that begins at a byte offset."""
        line, at = 1, 0
        newline = b"\r" if self._bare_cr else b"\n"
        while part := os.pread(self._fd, min(_HEAD_BYTES, offset - at), at):
            line += part.count(newline)
            at += len(part)
        return line


class _Lines:
    """Parser of a file's first lines: comments, a count, names, the first row of numbers."""

    def __init__(self, head: bytes, path: str, suffix: str, file_bytes: int) -> None:
        self.head = head
        self.path = path
        self.suffix = suffix
        self.file_bytes = file_bytes
        self.whole = file_bytes <= len(head)

    def layout(self) -> _Layout:
        """Return the file's layout."""
        if not self.head:
            raise self._error("empty_file", "the file is empty (0 bytes)", 0)
        if self.head.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise self._error("bad_row", "UTF-16 text is not read: save it as UTF-8 or ASCII", 0)
        at = 3 if self.head.startswith(b"\xef\xbb\xbf") else 0
        named, named_at, units = b"", 0, b""
        comments: list[bytes] = []
        announced: int | None = None
        for line in self.head[at:].split(b"\n"):
            start, at = at, at + len(line) + 1
            text = line.strip()
            if not text:
                continue
            if found := _COMMENT.match(text):
                comments.append(found.group().lstrip(b" \t#/%"))
                continue
            words = re.split(rb"[\s,;]+", text.strip(b",;"))
            if not all(map(NUMBER.match, words)):
                if named and not units and units_row(re.split(r"[\s,;]+", decoded(text))):
                    units = text
                    continue
                if named or NUMBER.match(words[0]):
                    raise self._error("bad_row", f"{_shown(text)} is not a row of numbers", start)
                named, named_at = text, start
                continue
            if announced is None and not named and len(words) == 1 and words[0].isdigit():
                announced = int(words[0][:18])
                continue
            if self.suffix == ".pts" and announced is None:
                raise self._error("bad_header", "the first line is not the number of points", start)
            layout = self._of_row(text, start)
            layout.announced = announced
            texts = [decoded(comment) for comment in comments]
            self._name(layout, texts, decoded(named), named_at, decoded(units))
            layout.warnings += scale_notes(texts)
            return layout
        if self.file_bytes > len(self.head):
            raise self._error("bad_row", f"no row of numbers within {len(self.head)} bytes", 0)
        if named:
            raise self._error("bad_row", f"{_shown(named)} is not a row of numbers", named_at)
        if self.suffix == ".pts" and announced is None:
            raise self._error("bad_header", "the first line is not the number of points", 0)
        return _Layout(list(AXES), self.file_bytes, announced=announced)

    def _error(self, cause: str, message: str, offset: int, hint: str = "") -> MapDataError:
        return refusal(cause, message, path=self.path, offset=offset, hint=hint)

    def _of_row(self, text: bytes, start: int) -> _Layout:
        """Return the separator and the number of values of the first row."""
        separator = b";" if b";" in text else b"," if b"," in text else b""
        words = text.split(separator or None)
        trailing = bool(separator) and not words[-1].strip()
        words = words[:-1] if trailing else words
        if any(b"," in word or len(word.split()) > 1 for word in words):
            raise self._error(
                "bad_row",
                f"{_shown(text)} has two kinds of separators",
                start,
                hint="separate values by white space, commas or semicolons, and write decimals with a point",
            )
        if any(not word.strip() for word in words):
            raise self._error("bad_row", f"{_shown(text)} has an empty value", start)
        if not 3 <= len(words) <= MAX_FIELDS:
            raise self._error(
                "no_xyz",
                f"{_shown(text)} has {len(words)} values; 3 to {MAX_FIELDS} can be read",
                start,
            )
        return _Layout([""] * len(words), start, separator, trailing)

    def _name(self, layout: _Layout, comments: list[str], named: str, named_at: int, units: str) -> None:
        """Name the columns: from the line before the rows, a comment, or their number."""
        count, separator = len(layout.names), layout.separator.decode()
        stated = units_in_comments(comments)
        lines_of_units = ([units] if units else []) + comments
        for text in (named, *comments[::-1]):
            for words in _splits(text, separator, count):
                row = next((row for line in lines_of_units if (row := _units(line, separator, count))), ())
                found = coordinates_of(words, row, stated)
                if found is None:
                    continue
                if found.problem:
                    raise self._error("not_metres", found.problem, named_at)
                bare = [word.strip().strip("\"'").strip() for word in words]
                layout.names = [f"{name}_2" if name in AXES else name for name in bare]
                for axis, place in zip(AXES, found.places, strict=True):
                    layout.names[place] = axis
                layout.crs, layout.warnings = found.crs, found.notes
                return
        if named:
            raise self._error(
                "bad_header",
                f"{_shown(named.encode())} names no {count} columns, x, y and z once each",
                named_at,
                hint="name the coordinates x, y and z, each once, and every other column",
            )
        layout.crs = system_of_comments(comments)
        others = count - 3
        layout.guessed = True
        rows = self._first_rows(layout)
        warnings = []
        names_of_others: Sequence[str] = _UNNAMED.get(others, ())
        if others == 3 and (self.suffix == ".xyzn" or (self.suffix != ".xyzrgb" and _are_normals(rows))):
            names_of_others = _NORMALS
        elif names_of_others[-3:] == _COLOURS and not self._are_colours(rows[:, -3:]):
            names_of_others = ()
            warnings.append(f"columns {count - 2} to {count} are no colours, which are integers of 0 to 255")
        if len(rows) > 1 and not (names_of_others and self.suffix in (".xyzn", ".xyzrgb")):
            self._check_first(rows, layout.data_at)
        if others and (odd := _odd_first(rows)):
            warnings.append(f"the first column {odd}: if it is no coordinate, {NAME_THEM}")
        if others >= 3 and not names_of_others and len(rows) >= _FEW and _are_shares(rows[:, :3]):
            warnings.append(f"columns 1 to 3 lie within 0 and 1: if they are a colour, {NAME_THEM}")
        if not names_of_others:
            names_of_others = [f"column_{place}" for place in range(4, count + 1)]
        layout.names = [*AXES, *names_of_others]
        if others and not (others == 3 and self.suffix in (".xyzn", ".xyzrgb")):
            taken = ", ".join(names_of_others)
            warnings.insert(0, f"no header names the columns: after x, y and z they are taken as {taken}")
        layout.warnings = tuple(warnings)

    def _check_first(self, rows: NDArray[np.float64], data_at: int) -> None:
        """Refuse a colour in front: three columns of bytes before three or more that are no integers."""
        if (
            _are_bytes(rows[:, :3])
            and not _are_normals(rows)
            and np.count_nonzero((rows[:, 3:] % 1 != 0).any(axis=0)) >= 3
        ):
            raise self._error(
                "bad_row",
                "columns 1 to 3 look like a colour (integers of 0 to 255), other columns like coordinates",
                data_at,
                hint=f"no header says which columns are coordinates: {NAME_THEM}",
            )

    def _first_rows(self, layout: _Layout) -> NDArray[np.float64]:
        """Return the first rows, (N, columns), as far as they are whole and finite numbers."""
        count, rows = len(layout.names), []
        for line in self.head[layout.data_at :].split(b"\n")[: None if self.whole else -1][:_LOOKED_AT]:
            words = line.replace(layout.separator or b" ", b" ").split()
            if len(words) == count and all(map(NUMBER.match, words)):
                values = [float(word) for word in words]
                if all(abs(value) < _LARGE for value in values):
                    rows.append(values)
        return np.array(rows, np.float64).reshape(-1, count)

    def _are_colours(self, values: NDArray[np.float64]) -> bool:
        """Whether three columns can be a colour; in a file that says so by its name, up to 1, too."""
        return (self.suffix == ".xyzrgb" and _are_shares(values)) or _are_bytes(values)


def _odd_first(rows: NDArray[np.float64]) -> str:
    """Return what makes the first of four or more columns unlike a coordinate; empty if nothing does."""
    first = rows[:, 0]
    rises, whole = bool((np.diff(first) > 0).all()), bool((first % 1 == 0).all())
    if len(rows) > 2 and rises and whole:
        return "counts the rows"
    if len(rows) < _FEW:
        return ""
    if whole and (rows[:, 1:4] % 1 != 0).any(axis=0).all():
        return "has integers alone, unlike the next three"
    return "rises with each row, as times do" if rises else ""


def _are_bytes(values: NDArray[np.float64]) -> bool:
    return bool(((values >= 0) & (values <= 255) & (values % 1 == 0)).all())


def _are_shares(values: NDArray[np.float64]) -> bool:
    return bool(((values >= 0) & (values <= 1)).all())


def _are_normals(rows: NDArray[np.float64]) -> bool:
    """Whether columns 4 to 6 of the first rows are unit vectors, not all along an axis."""
    vectors = rows[:_LOOKED_AT_NORMALS, 3:6]
    if not len(vectors) or not any(0 < abs(value) < 1 for value in vectors[0]):
        return False
    lengths = np.linalg.norm(vectors, axis=1)
    return bool((lengths > _NORMAL_LENGTHS[0]).all() and (lengths < _NORMAL_LENGTHS[1]).all())


def _splits(text: str, separator: str, count: int) -> Iterator[list[str]]:
    """Yield the ways to split a line into ``count`` names; units in brackets may have spaces around them."""
    marks = [mark for mark in dict.fromkeys((separator, "\t", ",", ";")) if mark and mark in text]
    for words in (*(text.split(mark) for mark in marks), split_names(text)):
        if len(words) == count + 1 and not words[-1].strip():
            words.pop()
        if len(words) == count:
            yield words


def _units(text: str, separator: str, count: int) -> list[LengthUnit | None] | None:
    """Return the units of ``count`` columns if a line has nothing but units."""
    return next(filter(None, map(units_row, _splits(text, separator, count))), None)


def _shown(line: bytes) -> str:
    text = line.strip()
    return repr(text[:_SHOWN].decode("utf-8", "replace")) + ("..." if len(text) > _SHOWN else "")
