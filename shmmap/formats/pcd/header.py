# SPDX-License-Identifier: Apache-2.0
"""Read PCD headers liberally, and check them against the file's size before allocating memory.

The format is that of the Point Cloud Library
(https://pointclouds.org/documentation/tutorials/pcd_file_format.html). Accepted beyond it, because such files
exist: any order of lines, lower-case keys, a byte order mark, CRLF, comments, unknown lines, missing VERSION,
COUNT, VIEWPOINT, POINTS or WIDTH and HEIGHT. Oddities become warnings; ambiguous headers are refused.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final, NoReturn

from shmmap.formats.coordinate_system import CoordinateSystem
from shmmap.formats.pcd.fields import FieldProblem, FieldTable, PcdField, parse_fields
from shmmap.formats.source_file import refusal, refuse_no_data
from shmmap.formats.stated_units import decoded, scale_notes, system_of_comments

HEADER_LIMIT_BYTES: Final = 1 << 16  # a header must end within this
MAX_POINTS: Final = (1 << 32) - 1  # WIDTH and HEIGHT are uint32 in PCL
ENCODINGS: Final = ("ascii", "binary", "binary_compressed")
IDENTITY_VIEWPOINT: Final = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

_KEYS: Final = frozenset(
    (b"VERSION", b"FIELDS", b"SIZE", b"TYPE", b"COUNT", b"WIDTH", b"HEIGHT", b"VIEWPOINT", b"POINTS", b"DATA")
)
_ALIASES: Final = {b"COLUMNS": b"FIELDS"}  # name of the FIELDS line in the oldest files; PCL accepts it, too
_BOM: Final = b"\xef\xbb\xbf"
_INTEGER: Final = re.compile(rb"[+-]?[0-9]{1,19}\Z")


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """Contents of a PCD header, after all checks.

    Attributes
    ----------
    table
        The fields and their columns; headers of a map's cells share one.
    width, height, points
        As in the file; if they disagree, ``points`` is used and a warning added.
    encoding
        ``ascii``, ``binary`` or ``binary_compressed``.
    viewpoint
        Translation x y z in metres, then quaternion w x y z.  Never applied to the points.
    version
        The text after VERSION, empty if missing.
    data_offset
        Byte offset of the first byte after the DATA line.
    warnings
        Oddities that did not prevent reading.
    crs
        Units that comments state; None if they state none.
    """

    table: FieldTable
    width: int
    height: int
    points: int
    encoding: str
    viewpoint: tuple[float, float, float, float, float, float, float]
    version: str
    data_offset: int
    warnings: tuple[str, ...]
    crs: CoordinateSystem | None = None

    @property
    def fields(self) -> tuple[PcdField, ...]:
        """The fields in file order, padding included."""
        return self.table.fields

    @property
    def point_bytes(self) -> int:
        """Bytes of one point in ``binary``, padding included."""
        return self.table.record.itemsize


def parse_header(head: bytes, *, path: str, file_bytes: int) -> PcdHeader:
    """Parse the header at the start of ``head``.

    Parameters
    ----------
    head
        The file's first bytes, at least min(file_bytes, `HEADER_LIMIT_BYTES`) of them unless the
        whole header lies in fewer.
    path
        Name of the file in messages.
    file_bytes
        Size of the whole file.

    Raises
    ------
    MapDataError
        With a cause from `shmmap.formats.source_file`.
    """
    plain = _PLAIN.match(head)
    if plain is None:
        return _parse_any(head, path, file_bytes)
    known = _seen.get(plain.group(*_SHARED))
    if known is None:
        header = _parse_any(head, path, file_bytes)
        if not header.warnings and header.crs is None:
            if len(_seen) >= _SEEN_LIMIT:
                _seen.clear()
            _seen[plain.group(*_SHARED)] = header
        return header
    width, height, points = map(int, plain.group("width", "height", "points"))
    if width * height != points or points > MAX_POINTS:
        return _parse_any(head, path, file_bytes)
    header = PcdHeader(
        known.table,
        width,
        height,
        points,
        known.encoding,
        known.viewpoint,
        known.version,
        plain.end(),
        (),
    )
    _check_size(header, path, file_bytes)
    return header


# Headers of a map's cells differ only in their numbers of points.  So a header as PCL writes it
# is compared with the common parts of one that was parsed before.
_PLAIN: Final = re.compile(
    rb"(?:# \.PCD v[0-9.]+ - Point Cloud Data file format\n)?"  # another comment may state units
    rb"VERSION (?P<version>[^\n]*)\nFIELDS (?P<fields>[^\n]*)\nSIZE (?P<size>[^\n]*)\n"
    rb"TYPE (?P<type>[^\n]*)\nCOUNT (?P<count>[^\n]*)\nWIDTH (?P<width>[0-9]{1,10})\n"
    rb"HEIGHT (?P<height>[0-9]{1,10})\nVIEWPOINT (?P<viewpoint>[^\n]*)\n"
    rb"POINTS (?P<points>[0-9]{1,10})\nDATA (?P<data>[a-z_]*)\n"
)
_SHARED: Final = ("version", "fields", "size", "type", "count", "viewpoint", "data")
_SEEN_LIMIT: Final = 64
_seen: Final[dict[tuple[bytes, ...], PcdHeader]] = {}


def _parse_any(head: bytes, path: str, file_bytes: int) -> PcdHeader:
    refuse_no_data(head, path)
    return _HeaderParser(head, path, file_bytes).parse()


class _HeaderParser:
    """Parses a header's lines, and checks them against each other."""

    def __init__(self, head: bytes, path: str, file_bytes: int) -> None:
        self.head = head
        self.path = path
        self.file_bytes = file_bytes
        self.values: dict[bytes, list[bytes]] = {}
        self.offsets: dict[bytes, int] = {}
        self.warnings: list[str] = []
        self.comments: list[str] = []

    def parse(self) -> PcdHeader:
        data_offset = self._read_lines()
        table = self._table()
        width, height, points = self._extent()
        header = PcdHeader(
            table=table,
            width=width,
            height=height,
            points=points,
            encoding=self._encoding(),
            viewpoint=self._viewpoint(),
            version=b" ".join(self.values.get(b"VERSION", [])).decode("latin-1"),
            data_offset=data_offset,
            warnings=(*self.warnings, *scale_notes(self.comments)),
            crs=system_of_comments(self.comments),
        )
        _check_size(header, self.path, self.file_bytes)
        return header

    def _refuse(self, key: bytes, message: str, cause: str = "bad_header") -> NoReturn:
        raise refusal(cause, message, path=self.path, offset=self.offsets.get(key, 0))

    def _read_lines(self) -> int:
        """Fill ``values`` from the header's lines; return the offset of the first data byte."""
        head, at, lower, unknown = self.head[:HEADER_LIMIT_BYTES], 0, False, 0
        if head.startswith(_BOM):
            at = len(_BOM)
            self.warnings.append("the file starts with a UTF-8 byte order mark")
        while at < len(head):
            end = head.find(b"\n", at)
            stop = len(head) if end < 0 else end
            words = head[at:stop].split()
            start, at = at, stop + 1
            if end < 0 and len(self.head) < self.file_bytes:
                break
            if not words or words[0].startswith(b"#"):
                self.comments.append(decoded(b" ".join(words).lstrip(b"# ")))
                continue
            key = words[0].upper()
            key = _ALIASES.get(key, key)
            if key not in _KEYS:
                if not self.values:
                    break
                self.comments.append(decoded(b" ".join(words)))  # such as UNITS mm
                unknown += 1
                if unknown <= 3:
                    text = words[0][:40].decode("latin-1")
                    self.warnings.append(f"unknown header line {text!r} at byte {start} ignored")
                continue
            lower = lower or words[0] != words[0].upper()
            if key in self.values:
                if self.values[key] != words[1:]:
                    self._refuse(key, f"two different {key.decode()} lines, the second at byte {start}")
                self.warnings.append(f"the {key.decode()} line is there twice")
            self.values[key] = words[1:]
            self.offsets[key] = start
            if key == b"DATA":
                if lower:
                    self.warnings.append("header keys are in lower case")
                return min(at, len(self.head))
        if not self.values:
            raise refusal(
                "not_pcd", "not a PCD file: no PCD header line at its start", path=self.path, offset=0
            )
        if len(self.head) < HEADER_LIMIT_BYTES:
            raise refusal(
                "truncated",
                "the file ends inside its header: no DATA line",
                path=self.path,
                offset=len(self.head),
            )
        raise refusal(
            "bad_header",
            f"no DATA line within {HEADER_LIMIT_BYTES} bytes",
            path=self.path,
            offset=HEADER_LIMIT_BYTES,
        )

    def _need(self, key: bytes) -> list[bytes]:
        if key not in self.values:
            self._refuse(key, f"the header has no {key.decode()} line")
        return self.values[key]

    def _integer(self, key: bytes, word: bytes, low: int) -> int:
        if not _INTEGER.match(word):
            self._refuse(key, f"{key.decode()}: {word[:40].decode('latin-1')!r} is not an integer")
        value = int(word)
        if value < low:
            self._refuse(key, f"{key.decode()} is {value}, at least {low} is needed")
        return value

    def _single(self, key: bytes) -> int | None:
        words = self.values.get(key)
        if words is None:
            return None
        if len(words) != 1:
            self._refuse(key, f"{key.decode()} has {len(words)} values instead of one")
        return self._integer(key, words[0], 0)

    def _table(self) -> FieldTable:
        counts = self.values.get(b"COUNT")
        try:
            table, warnings = parse_fields(
                tuple(self._need(b"FIELDS")),
                tuple(self._need(b"SIZE")),
                tuple(self._need(b"TYPE")),
                None if counts is None else tuple(counts),
            )
        except FieldProblem as problem:
            self._refuse(problem.key, problem.message, problem.cause)
        self.warnings += warnings
        return table

    def _extent(self) -> tuple[int, int, int]:
        width, height, points = self._single(b"WIDTH"), self._single(b"HEIGHT"), self._single(b"POINTS")
        if points is None:
            if width is None:
                self._refuse(b"POINTS", "neither POINTS nor WIDTH: the number of points is unknown")
            height = 1 if height is None else height
            points = width * height
        elif width is None:
            width, height = points, 1
        else:
            height = 1 if height is None else height
            if width * height != points:
                self.warnings.append(f"WIDTH {width} x HEIGHT {height} is not POINTS {points}: POINTS counts")
        if points > MAX_POINTS:
            self._refuse(b"POINTS", f"{points} points; the format ends at {MAX_POINTS}", "too_many_points")
        return width, height, points

    def _encoding(self) -> str:
        words = self.values[b"DATA"]
        name = words[0].decode("latin-1").lower() if words else ""
        if name not in ENCODINGS:
            self._refuse(
                b"DATA", f"DATA {name[:40]!r} is not one of {', '.join(ENCODINGS)}", "unknown_encoding"
            )
        if len(words) > 1:
            self.warnings.append("something follows the encoding on the DATA line")
        return name

    def _viewpoint(self) -> tuple[float, float, float, float, float, float, float]:
        words = self.values.get(b"VIEWPOINT")
        if words is None:
            return IDENTITY_VIEWPOINT
        if len(words) != 7:
            self._refuse(b"VIEWPOINT", f"VIEWPOINT has {len(words)} numbers instead of 7")
        numbers = []
        for word in words:
            try:
                number = float(word) if b"_" not in word else math.nan
            except ValueError:
                number = math.nan
            if not math.isfinite(number):
                self._refuse(
                    b"VIEWPOINT", f"VIEWPOINT: {word[:40].decode('latin-1')!r} is not a finite number"
                )
            numbers.append(number)
        x, y, z, qw, qx, qy, qz = numbers
        if (x, y, z, abs(qw), qx, qy, qz) != IDENTITY_VIEWPOINT:
            self.warnings.append("VIEWPOINT is not the identity; the points are left as they are")
        return x, y, z, qw, qx, qy, qz


def _check_size(header: PcdHeader, path: str, file_bytes: int) -> None:
    """Refuse a header that claims more than the file can hold, before allocating memory for it."""
    left = file_bytes - header.data_offset
    if header.encoding == "binary":
        needed, what = header.points * header.point_bytes, "bytes of points"
    elif header.encoding == "ascii":
        needed, what = header.points * 2 * header.table.values - 1, "characters at least"
    else:
        needed, what = 8 if header.points else 0, "bytes of sizes"
    if needed > left:
        raise refusal(
            "truncated",
            f"{header.points} points need {needed} {what}, but {left} bytes follow the header",
            path=path,
            offset=file_bytes,
        )
