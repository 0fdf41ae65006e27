# SPDX-License-Identifier: Apache-2.0
"""Read PLY headers (elements, properties), check them against the file's size; and write them.

The format is Greg Turk's (The PLY Polygon File Format, 1994), with both families of type names.  Accepted
beyond it, because such files exist: lines that end in CRLF or CR, `obj_info`, comments in any encoding, a
byte order mark, upper-case X, Y and Z, and 64-bit integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from shmmap.columns import column_names
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.coordinate_system import CoordinateSystem
from shmmap.formats.pcd.fields import AXES, MAX_FIELDS, PcdField
from shmmap.formats.source_file import refusal, refuse_no_data
from shmmap.formats.stated_units import decoded, scale_notes, system_of_comments

HEADER_LIMIT_BYTES: Final = 1 << 20
"""Maximum length of a header in bytes."""

_FORMATS: Final = ("ascii", "binary_little_endian", "binary_big_endian")
_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
_BOM: Final = b"\xef\xbb\xbf"
_MAX_ELEMENTS: Final = 1024
_MAX_COUNT: Final = 1 << 48
_SHOWN: Final = 60


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """One property; for a list, ``dtype`` is the type of its items and ``counter`` that of its length."""

    name: str
    dtype: np.dtype[np.generic]
    counter: np.dtype[np.generic] | None = None


@dataclass(slots=True)
class PlyElement:
    """One element: ``count`` rows of ``properties``, declared at byte ``offset``."""

    name: str
    count: int
    offset: int
    properties: list[PlyProperty] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether rows contain lists, and so differ in length."""
        return any(one.counter is not None for one in self.properties)

    @property
    def least_row_bytes(self) -> int:
        """Bytes of a binary row with empty lists; of every row, if there are no lists."""
        return sum((one.counter or one.dtype).itemsize for one in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """Contents of a header, after all checks.

    Attributes
    ----------
    format
        ``ascii``, ``binary_little_endian`` or ``binary_big_endian``.
    before
        Elements whose rows precede the vertices.
    vertex
        Element of the vertices.
    fields
        Properties of the vertices that are not lists, in file order, including x, y and z.
    last
        Whether no element follows the vertices.
    data_offset
        Byte offset of the first row.
    bare_cr
        Whether lines end in CR alone.
    warnings
        Oddities that did not prevent reading.
    crs
        Units that comments state; None if they state none.
    """

    format: str
    before: tuple[PlyElement, ...]
    vertex: PlyElement
    fields: tuple[PcdField, ...]
    last: bool
    data_offset: int
    bare_cr: bool
    warnings: tuple[str, ...]
    crs: CoordinateSystem | None = None


def parse_ply_header(head: bytes, *, path: str, file_bytes: int) -> PlyHeader:
    """Parse the header at the start of ``head``, and check its counts against the file's size.

    Parameters
    ----------
    head
        The file's first bytes, at least min(file_bytes, `HEADER_LIMIT_BYTES`) of them unless the whole
        header lies in fewer.

    Raises
    ------
    MapDataError
        ``empty_file``, ``bad_header``, ``bad_type``, ``no_xyz``, ``unknown_encoding``, ``too_many_points``
        or ``truncated``, with the byte offset of what is wrong.
    """
    refuse_no_data(head, path)
    return _Parser(head, path, file_bytes).parse()


class _Parser:
    """Parses a header's lines, and checks them against each other."""

    def __init__(self, head: bytes, path: str, file_bytes: int) -> None:
        self.head = head
        self.path = path
        self.file_bytes = file_bytes
        self.at = 0
        self.form = ""
        self.elements: list[PlyElement] = []
        self.warnings: list[str] = []
        self.comments: list[str] = []

    def parse(self) -> PlyHeader:
        start, bare_cr = self._magic()
        data_offset = self._lines(start, b"\r" if bare_cr else b"\n")
        if not self.form:
            raise self._error("the header has no format line", at=0)
        names = [element.name for element in self.elements]
        if names.count("vertex") != 1:
            what = "no element vertex" if "vertex" not in names else "two elements vertex"
            raise self._error(f"the header has {what}: no cloud of points", at=0)
        place = names.index("vertex")
        header = PlyHeader(
            format=self.form,
            before=tuple(self.elements[:place]),
            vertex=self.elements[place],
            fields=self._fields(self.elements[place]),
            last=place == len(self.elements) - 1,
            data_offset=data_offset,
            bare_cr=bare_cr,
            warnings=(*self.warnings, *scale_notes(self.comments)),
            crs=system_of_comments(self.comments),
        )
        self._check_size(header)
        return header

    def _error(self, message: str, cause: str = "bad_header", at: int | None = None) -> MapDataError:
        return refusal(cause, message, path=self.path, offset=self.at if at is None else at)

    def _magic(self) -> tuple[int, bool]:
        """Check the first line; return the offset of the second, and whether lines end in CR alone."""
        start = len(_BOM) if self.head.startswith(_BOM) else 0
        if start:
            self.warnings.append("the file starts with a UTF-8 byte order mark")
        end = start + 3
        while self.head[end : end + 1] in (b" ", b"\t"):
            end += 1
        if self.head[start : start + 3] == b"ply" and self.head[end : end + 1] in (b"\n", b"\r"):
            bare_cr = self.head[end : end + 1] == b"\r" and self.head[end + 1 : end + 2] != b"\n"
            return end + (1 if bare_cr or self.head[end : end + 1] == b"\n" else 2), bare_cr
        raise self._error("not a PLY file: it does not start with the line 'ply'", at=0)

    def _lines(self, at: int, newline: bytes) -> int:
        """Parse all lines; return the offset of the first data byte."""
        head = self.head[:HEADER_LIMIT_BYTES]
        while (end := head.find(newline, at)) >= 0:
            self.at = at
            words = head[at:end].split()
            at = end + 1
            if words == [b"end_header"]:
                return at
            if not words:
                continue
            if words[0] in (b"comment", b"obj_info"):
                self.comments.append(decoded(b" ".join(words[1:])))
                continue
            try:
                self._line([word.decode("ascii") for word in words])
            except UnicodeDecodeError as error:
                text = head[self.at : end][:_SHOWN].decode("latin-1")
                raise self._error(f"the header line {text!r} is not ASCII") from error
        if len(self.head) >= HEADER_LIMIT_BYTES:
            raise self._error(f"no end_header within {HEADER_LIMIT_BYTES} bytes", at=HEADER_LIMIT_BYTES)
        raise self._error("the file ends inside its header: no end_header", "truncated", at=len(self.head))

    def _line(self, words: list[str]) -> None:
        key, *rest = words
        if key == "format" and len(rest) == 2:
            if self.form:
                raise self._error("two format lines")
            if rest[0] not in _FORMATS:
                raise self._error(
                    f"format {rest[0][:_SHOWN]!r} is not one of {', '.join(_FORMATS)}", "unknown_encoding"
                )
            self.form = rest[0]
            if rest[1] != "1.0":
                self.warnings.append(f"PLY version {rest[1][:_SHOWN]!r} is read as 1.0")
        elif key == "element" and len(rest) == 2:
            self._element(*rest)
        elif (
            key == "property" and self.elements and (len(rest) == 2 or (len(rest) == 4 and rest[0] == "list"))
        ):
            self._property(rest)
        else:
            raise self._error(f"the header line {' '.join(words)[:_SHOWN]!r} is not one of PLY's")

    def _element(self, name: str, count: str) -> None:
        if not (count.isascii() and count.isdigit()):
            raise self._error(f"element {name[:_SHOWN]}: {count[:_SHOWN]!r} is not a number of rows")
        number = int(count[:40])
        if number > _MAX_COUNT or len(count) > 40:
            raise self._error(f"element {name[:_SHOWN]} of {count[:_SHOWN]} rows", "too_many_points")
        if len(self.elements) >= _MAX_ELEMENTS:
            raise self._error(f"more than {_MAX_ELEMENTS} elements")
        self.elements.append(PlyElement(name, number, self.at))

    def _property(self, words: list[str]) -> None:
        element = self.elements[-1]
        if len(element.properties) >= MAX_FIELDS:
            raise self._error(f"element {element.name[:_SHOWN]} has more than {MAX_FIELDS} properties")
        name = words[-1]
        dtypes = []
        for word in words[1:3] if len(words) == 4 else words[:1]:
            if word not in _TYPES:
                raise self._error(
                    f"property {name[:_SHOWN]!r} is of type {word[:_SHOWN]!r}, which PLY does not have",
                    "bad_type",
                )
            dtypes.append(np.dtype("<" + _TYPES[word]))
        if len(dtypes) == 1:
            element.properties.append(PlyProperty(name, dtypes[0]))
            return
        if dtypes[0].kind == "f":
            raise self._error(f"the items of list {name[:_SHOWN]!r} are counted by {words[1]}", "bad_type")
        element.properties.append(PlyProperty(name, dtypes[1], dtypes[0]))

    def _fields(self, vertex: PlyElement) -> tuple[PcdField, ...]:
        """Name the columns uniquely: x, y and z, and each other property by its own name."""
        lists = [one.name for one in vertex.properties if one.counter is not None]
        scalars = [one for one in vertex.properties if one.counter is None]
        if lists:
            shown = ", ".join(name[:_SHOWN] for name in lists[:5]) + (", ..." if len(lists) > 5 else "")
            self.warnings.append(f"list properties of the vertices left out: {shown}")
        given = [one.name for one in scalars]
        places: dict[int, str] = {}
        for axis in AXES:
            word = axis if axis in given else axis.upper()
            if word not in given:
                raise refusal(
                    "no_xyz",
                    f"the vertices have no property {axis}: not a cloud of points in space",
                    path=self.path,
                    offset=vertex.offset,
                )
            if word != axis:
                self.warnings.append(f"property {word!r} is taken as {axis!r}")
            places[given.index(word)] = axis
        others = [name for place, name in enumerate(given) if place not in places]
        renamed = dict(
            zip((p for p in range(len(given)) if p not in places), column_names(others), strict=True)
        )
        for place, new in renamed.items():
            if new != given[place]:
                self.warnings.append(f"property {given[place][:_SHOWN]!r} renamed {new[:_SHOWN]!r}")
        return tuple(
            PcdField(places.get(place) or renamed[place], one.dtype) for place, one in enumerate(scalars)
        )

    def _check_size(self, header: PlyHeader) -> None:
        """Refuse counts that the file cannot hold, before allocating memory for them."""
        left = self.file_bytes - header.data_offset
        for element in (*header.before, header.vertex):
            if header.format == "ascii":
                if element.count and not element.properties:
                    raise self._error(f"element {element.name[:_SHOWN]} has no properties", at=element.offset)
                needed, what = max(0, 2 * len(element.properties) * element.count - 1), "characters"
            else:
                needed, what = element.least_row_bytes * element.count, "bytes"
            if needed > left:
                raise refusal(
                    "truncated",
                    f"{element.count} rows of element {element.name[:_SHOWN]} need {needed} {what} at least,"
                    f" but {left} bytes are left",
                    path=self.path,
                    offset=self.file_bytes,
                )
            left -= needed


_WRITTEN_TYPES: Final = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def ply_header(
    fields: Sequence[tuple[str, np.dtype[Any]]], points: int, *, comment: str = "", header_bytes: int = 0
) -> bytes:
    """Return the header of a binary file with ``fields`` (name, dtype of one value).

    ``header_bytes`` pads the header to that length with spaces at the end of a comment.  So it can be written
    in front of the points once their number is known.

    Raises
    ------
    BadRequest
        PLY lacks a type, or the header exceeds ``header_bytes``.
    """
    types = [_WRITTEN_TYPES.get(dtype.str.lstrip("<|")) for _, dtype in fields]
    if None in types:
        raise BadRequest(f"a PLY file cannot hold {', '.join(dtype.str for _, dtype in fields)}")
    first = "ply\nformat binary_little_endian 1.0\n" + f"comment {comment}"
    properties = (f"property {kind} {name}\n" for (name, _), kind in zip(fields, types, strict=True))
    rest = f"\nelement vertex {points}\n" + "".join(properties) + "end_header\n"
    if header_bytes and len(first) + len(rest) > header_bytes:
        raise BadRequest(f"the header needs {len(first) + len(rest)} bytes, more than {header_bytes}")
    return (first.ljust(header_bytes - len(rest)) + rest).encode("ascii")
