# SPDX-License-Identifier: Apache-2.0
"""Read and check the header of a LAS or LAZ file: counts against its size, scales, coordinate system.

The format is that of the ASPRS LAS specification 1.4 R15.  The header is checked here because laspy trusts it
and allocates memory for what it claims.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO, Final

from shmmap.errors import MapDataError
from shmmap.formats.coordinate_system import CoordinateSystem, geokey_system, wkt_system
from shmmap.formats.source_file import open_regular, refusal

__all__ = ["LasHeader", "read_las_header"]

_SIGNATURE: Final = b"LASF"
_HEADER_BYTES: Final = 375  # LAS 1.4
_SHORTEST_BYTES: Final = 227  # LAS 1.0 to 1.2
_START: Final = struct.Struct("<HII")  # at 94: header bytes, offset to points, records
_POINTS: Final = struct.Struct("<BHI")  # at 104: format, record bytes, points (legacy count)
_LEGACY_AT: Final = 107
_SCALES: Final = struct.Struct("<6d")  # at 131: scales, offsets
_LONG: Final = struct.Struct("<QQIQ")  # at 227, since 1.4: waveforms, extended records and count, points
_LONG_AT: Final = 247
_LAZ_BIT: Final = 0x80
_WKT_BIT: Final = 0x10  # flag of the global encoding
_RECORD: Final = struct.Struct("<2x16sHH32x")
_EXTENDED: Final = struct.Struct("<2x16sHQ32x")
_PROJECTION: Final = b"LASF_Projection"
_WKT, _GEOKEYS, _GEODOUBLES, _GEOTEXTS = 2112, 34735, 34736, 34737
_LASZIP: Final = (b"laszip encoded", 22204)
_MAX_RECORDS: Final = 10_000
_MAX_RECORD_BYTES: Final = 1 << 20
_VARIABLE_CHUNKS: Final = 0xFFFFFFFF
_LEGACY_FORMATS: Final = 6  # point formats below this have the legacy count, too


@dataclass(frozen=True, slots=True)
class LasHeader:
    """Contents of a header, after all checks.

    Attributes
    ----------
    points
        Number of points in the header.
    compressed
        Whether it is LAZ.
    laszip
        Content of the LASzip record, which describes the compression; empty if there is none.
    point_format, record_bytes
        Format and size of an uncompressed point.
    data_at
        Byte offset of the points.
    crs
        The coordinate system; None if the file names none.
    warnings
        Oddities that did not prevent reading.
    """

    points: int
    compressed: bool
    laszip: bytes
    point_format: int
    record_bytes: int
    data_at: int
    crs: CoordinateSystem | None
    warnings: list[str]


def read_las_header(path: str) -> LasHeader:
    """Read and check a header; reject one that contradicts the file's bytes.

    Raises
    ------
    MapDataError
        ``empty_file``, ``bad_las`` or ``truncated``, with the byte offset; or the file cannot be opened.
    """
    try:
        with open(open_regular(path), "rb") as file:
            return _Header(file, path).checked()
    except OSError as error:
        raise refusal("unreadable", f"cannot be read: {error.strerror}", path=path) from error


class _Header:
    def __init__(self, file: IO[bytes], path: str) -> None:
        self.file = file
        self.path = path
        self.head = file.read(_HEADER_BYTES)
        self.size = os.fstat(file.fileno()).st_size
        self.warnings: list[str] = []

    def _error(self, cause: str, message: str, offset: int) -> MapDataError:
        return refusal(cause, message, path=self.path, offset=offset)

    def checked(self) -> LasHeader:
        head = self.head
        if not head:
            raise self._error("empty_file", "no bytes at all", 0)
        if not head.startswith(_SIGNATURE):
            raise self._error("bad_las", "not a LAS file: it does not start with LASF", 0)
        if len(head) < _SHORTEST_BYTES:
            raise self._error("truncated", "the file ends within its header", len(head))
        header_bytes, data_at, records = _START.unpack_from(head, 94)
        form, record_bytes, legacy = _POINTS.unpack_from(head, 104)
        waveforms = extended_at = extended = 0
        long: int | None = None
        if head[25] >= 4 and len(head) >= _LONG_AT + 8:
            waveforms, extended_at, extended, long = _LONG.unpack_from(head, 227)
        self._check_scales()
        points = self._count(legacy, long, form)
        compressed = bool(form & _LAZ_BIT)
        # a byte of LAZ holds at most 256 points, and a LAS point takes its whole record
        needed = data_at if compressed else data_at + points * record_bytes
        if self.size < needed or (compressed and points > (self.size - data_at) * 256):
            raise self._error(
                "truncated",
                f"{points} points announced need {needed} bytes, {self.size} are there",
                self.size,
            )
        for what, first, count, end, form_of in (
            ("records", header_bytes, records, data_at, _RECORD),
            ("extended records", extended_at, extended, self.size, _EXTENDED),
        ):
            room = max(0, end - first)
            if count * form_of.size > room:  # laspy would search for each of them
                raise self._error(
                    "bad_las", f"{count} {what} announced in {room} bytes", min(first, self.size)
                )
        found = dict(self._records(header_bytes, records, extended_at, extended))
        if compressed:
            self._check_chunks(points, data_at, found.get(_LASZIP, b""))
        else:
            behind = [at for at in (waveforms, extended_at if extended else 0) if at >= needed]
            self._check_rest(points, needed, min(behind, default=self.size), record_bytes)
        return LasHeader(
            points=points,
            compressed=compressed,
            laszip=found.get(_LASZIP, b""),
            point_format=form & 0x3F,
            record_bytes=record_bytes,
            data_at=data_at,
            crs=self._system(found),
            warnings=self.warnings,
        )

    def _check_scales(self) -> None:
        values = _SCALES.unpack_from(self.head, 131)
        for place, value in enumerate(values):
            if not math.isfinite(value) or (place < 3 and value == 0):
                axis, what = "xyz"[place % 3], ("offset" if place >= 3 else "scale")
                message = f"the {what} of {axis} is {value:g}: no point has a place"
                raise self._error("bad_las", message, 131 + 8 * place)

    def _count(self, legacy: int, long: int | None, form: int) -> int:
        """Return the number of points: the wide count of 1.4, or the legacy one if only that is set."""
        if long is None:
            return legacy
        if not long and legacy:
            self.warnings.append(
                f"only the legacy count says how many points there are, {legacy}: the count of LAS 1.4 is 0"
            )
            return legacy
        if legacy and legacy != long and form & 0x3F < _LEGACY_FORMATS:
            self.warnings.append(
                f"the header counts {long} points, its legacy count {legacy}: the first counts"
            )
        return long

    def _check_rest(self, points: int, end: int, rest_end: int, record_bytes: int) -> None:
        """Check that the bytes after the last point are plausible."""
        rest = rest_end - end
        more = rest // record_bytes if record_bytes else 0
        if more and not points:
            raise self._error(
                "bad_las", f"the header counts no points, but {rest} bytes follow: {more} points", _LEGACY_AT
            )
        if rest > 0:
            room = f", room for {more} more points" if more else ""
            self.warnings.append(
                f"{rest} bytes after the last point ignored{room}: the header counts {points} points"
            )

    def _check_chunks(self, points: int, data_at: int, laszip: bytes) -> None:
        """Check the number of points of a LAZ file against its chunk table."""
        if len(laszip) < 16:
            return  # `check_laz` reports the error
        (chunk_points,) = struct.unpack_from("<I", laszip, 12)
        self.file.seek(data_at)
        start = self.file.read(8)
        table_at = int.from_bytes(start, "little", signed=True)
        if table_at == -1:  # LAZ written to a pipe: the offset is in the last bytes
            self.file.seek(max(data_at, self.size - 8))
            table_at = int.from_bytes(self.file.read(8), "little", signed=True)
        if len(start) < 8 or not data_at + 8 <= table_at <= self.size - 8:
            if points:
                raise self._error("truncated", "its table of chunks lies outside the file", data_at)
            return
        self.file.seek(table_at + 4)
        chunks = int.from_bytes(self.file.read(4), "little")
        if chunks > table_at - data_at:
            raise self._error("bad_las", f"{chunks} chunks in {table_at - data_at} bytes", table_at + 4)
        if chunk_points in (0, _VARIABLE_CHUNKS):
            if chunks and not points:
                raise self._error(
                    "bad_las", f"the header counts no points, but there are {chunks} chunks", 107
                )
            return
        least, most = max(0, chunks - 1) * chunk_points + bool(chunks), chunks * chunk_points
        if not points and chunks:
            raise self._error(
                "bad_las", f"the header counts no points, but there are {least} to {most}", _LEGACY_AT
            )
        if points > most:
            raise self._error("truncated", f"{points} points announced, at most {most} are there", table_at)
        if points < least:
            self.warnings.append(
                f"{points} points announced, {least} to {most} are there: the chunks behind are ignored"
            )

    # --- records ------------------------------------------------------------------------------------

    def _records(
        self, header_bytes: int, records: int, extended_at: int, extended: int
    ) -> Iterator[tuple[tuple[bytes, int], bytes]]:
        """Yield (user, number) and content of each relevant record; records after the points come last."""
        for at, count, form in ((header_bytes, records, _RECORD), (extended_at, extended, _EXTENDED)):
            for _ in range(min(count, _MAX_RECORDS)):
                self.file.seek(at)
                head = self.file.read(form.size)
                if len(head) < form.size:
                    self.warnings.append(f"a record announced at byte {at} is not there")
                    return
                user, number, length = form.unpack(head)
                key = user.rstrip(b"\0"), number
                if key == _LASZIP or (key[0] == _PROJECTION and length <= _MAX_RECORD_BYTES):
                    yield key, self.file.read(min(length, _MAX_RECORD_BYTES))
                at += form.size + length
                if at > self.size:
                    self.warnings.append(f"a record ends at byte {at}, behind the file's end")
                    return

    def _system(self, found: dict[tuple[bytes, int], bytes]) -> CoordinateSystem | None:
        """Return the file's coordinate system, from WKT or GeoTIFF keys as the header's flag selects."""
        text = found.get((_PROJECTION, _WKT), b"").split(b"\0")[0].decode("utf-8", "replace").strip()
        keys = found.get((_PROJECTION, _GEOKEYS), b"")
        by_text = wkt_system(text) if text else None
        by_keys = None
        if keys:
            doubles, texts = (found.get((_PROJECTION, kind), b"") for kind in (_GEODOUBLES, _GEOTEXTS))
            by_keys = geokey_system(keys, doubles, texts)
        if (text and by_text is None) or (keys and by_keys is None):
            self.warnings.append("its coordinate system cannot be read")
        if by_text is None or by_keys is None:
            return by_text or by_keys
        means_text = self.head[6] & _WKT_BIT
        chosen = by_text if means_text else by_keys
        if (by_text.geographic, by_text.units) != (by_keys.geographic, by_keys.units):
            used = "WKT" if means_text else "latter"
            self.warnings.append(f"its WKT and its GeoTIFF keys have different units: the {used} is used")
        return chosen
