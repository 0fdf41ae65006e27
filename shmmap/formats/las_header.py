# SPDX-License-Identifier: Apache-2.0
"""Read and check the header of a LAS or LAZ file: counts against its size, scales, coordinate system.

The format is that of the ASPRS LAS specification 1.4 R15.  The header is checked here because laspy trusts it
and allocates memory for what it claims.  laspy gets a header with the records that points need, no others.
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
from shmmap.formats.laz_chunks import standard_bytes
from shmmap.formats.source_file import open_regular, refusal

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
_EXTRA_BYTES: Final = (b"LASF_Spec", 4)
_DIMENSION_BYTES: Final = 192  # one dimension in the Extra Bytes record
_SCALES_AT: Final = 112  # in it
_TYPE_BYTES: Final = (1, 1, 2, 2, 4, 4, 8, 8, 4, 8)  # of types 1 to 10; 11 to 20 are pairs, 21 to 30 triples
_TYPES: Final = 30
_NAMES: Final = (
    "X Y Z x y z intensity return_number number_of_returns scan_direction_flag edge_of_flight_line"
    " classification synthetic key_point withheld user_data point_source_id"
)
_BEFORE_6: Final = "scan_angle_rank"
_SINCE_6: Final = "scan_angle overlap scanner_channel gps_time"
_SOME: Final = {
    (1, 3, 4, 5): "gps_time",
    (2, 3, 5, 7, 8, 10): "red green blue",
    (8, 10): "nir",
    (
        4,
        5,
        9,
        10,
    ): "wavepacket_index wavepacket_offset wavepacket_size return_point_wave_location x_t y_t z_t",
}
_MAX_RECORDS: Final = 10_000
_MAX_RECORD_BYTES: Final = 1 << 20
_MAX_CHUNKS: Final = (
    1 << 17
)  # in any file; and one more for each of these bytes, which hold thousands of points
_CHUNK_BYTES: Final = 1 << 14
_SHOWN: Final = 8  # names in a warning
_VARIABLE_CHUNKS: Final = 0xFFFFFFFF
_NEWEST: Final = (1, 4)
_NEWEST_FORMAT: Final = 10
_SCALE_RANGE: Final = (1e-12, 1e6)
_FARTHEST: Final = 2.0**70  # scales; so far away, points 2**17 scales apart have one place in float64
_SCALED: Final = 0x08  # flag of an extra dimension
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
    head
        A header for laspy: the file's, with the LASzip and the Extra Bytes record only.
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
    head: bytes
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
        version = head[24], head[25]
        if not (1, 0) <= version <= _NEWEST:
            raise self._error("bad_las", f"LAS {version[0]}.{version[1]}; 1.0 to 1.4 are read", 24)
        header_bytes, data_at, records = _START.unpack_from(head, 94)
        form, record_bytes, legacy = _POINTS.unpack_from(head, 104)
        if form & 0x3F > _NEWEST_FORMAT:
            raise self._error("bad_las", f"point format {form & 0x3F}; 0 to {_NEWEST_FORMAT} are read", 104)
        waveforms = extended_at = extended = 0
        long: int | None = None
        if head[25] >= 4 and len(head) >= _LONG_AT + 8:
            waveforms, extended_at, extended, long = _LONG.unpack_from(head, 227)
        if header_bytes < _SHORTEST_BYTES:
            raise self._error("bad_las", f"a header of {header_bytes} bytes announced", 94)
        if data_at < header_bytes:
            message = f"its points begin at byte {data_at}, within its header of {header_bytes} bytes"
            raise self._error("bad_las", message, 96)
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
        room = max(0, data_at - header_bytes)
        if records * _RECORD.size > room:
            message = f"{records} records announced in {room} bytes"
            raise self._error("bad_las", message, min(header_bytes, self.size))
        room = max(0, self.size - extended_at) if extended_at >= data_at else 0
        if extended * _EXTENDED.size > room:
            self.warnings.append(
                f"{extended} extended records announced at byte {extended_at}, where there is room for"
                f" {room // _EXTENDED.size}"
            )
            extended = room // _EXTENDED.size
        found = dict(self._records(header_bytes, records, extended_at, extended))
        if compressed:
            self._check_chunks(points, data_at, found.get(_LASZIP, b""))
        else:
            behind = (waveforms, extended_at if extended else 0)
            rest_end = min((at for at in behind if needed <= at <= self.size), default=self.size)
            self._check_rest(points, needed, rest_end, record_bytes)
        needs = {_LASZIP: found.get(_LASZIP, b"")}
        needs[_EXTRA_BYTES] = self._dimensions(found.get(_EXTRA_BYTES, b""), form & 0x3F, record_bytes)
        return LasHeader(
            points=points,
            compressed=compressed,
            laszip=found.get(_LASZIP, b""),
            point_format=form & 0x3F,
            record_bytes=record_bytes,
            data_at=data_at,
            head=self._head_with(header_bytes, {key: text for key, text in needs.items() if text}),
            crs=self._system(found),
            warnings=self.warnings,
        )

    def _check_scales(self) -> None:
        values = _SCALES.unpack_from(self.head, 131)
        low, high = _SCALE_RANGE
        for place, value in enumerate(values):
            least, most = (low, high) if place < 3 else (0.0, abs(values[place - 3]) * _FARTHEST)
            if not least <= abs(value) <= most:
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
        room = table_at - data_at
        if chunks > min(room, _MAX_CHUNKS + room // _CHUNK_BYTES):  # lazrs makes a list of them
            raise self._error("bad_las", f"{chunks} chunks announced in {room} bytes", table_at + 4)
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
                if key in (_LASZIP, _EXTRA_BYTES) or key[0] == _PROJECTION:
                    yield key, self.file.read(min(length, _MAX_RECORD_BYTES))
                at += form.size + length
                if at > self.size:
                    self.warnings.append(f"a record ends at byte {at}, behind the file's end")
                    return

    def _dimensions(self, described: bytes, point_format: int, record_bytes: int) -> bytes:
        """Return an Extra Bytes record of what the points have, each name once; note the others."""
        room = record_bytes - standard_bytes(point_format)
        used, end, left_out = 0, 0, []
        usable, names = bytearray(), _standard_names(point_format)
        for at in range(0, len(described) - _DIMENSION_BYTES + 1, _DIMENSION_BYTES):
            one = described[at : at + _DIMENSION_BYTES]
            name, renamed = _dimension_name(one, names)
            kind, size = one[2:4]
            if 1 <= kind <= _TYPES:
                size = _TYPE_BYTES[(kind - 1) % 10] * (1 + (kind - 1) // 10)
            used += size
            if kind > _TYPES or used > room:
                used = max(used, room + 1)  # where the next one begins is not known either
                left_out.append(name)
            elif size:
                end = used
                names.add(name)
                options = one[3]
                scales = struct.unpack_from(f"<{1 + (kind - 1) // 10}d", one, _SCALES_AT)
                if options & _SCALED and not all(math.isfinite(scale) and scale for scale in scales):
                    options &= ~_SCALED
                    self.warnings.append(
                        f"extra dimension {name!r} has scale {scales[0]:g}, which is ignored"
                    )
                usable += one[:3] + bytes([options]) + name.encode().ljust(32, b"\0") + one[36:]
                if renamed:
                    self.warnings.append(f"an extra dimension has no name of its own: it is {name!r} here")
        if left_out:
            self.warnings.append(
                f"its Extra Bytes record does not fit the {max(0, room)} extra bytes of its points: without"
                f" {', '.join(map(repr, left_out[:_SHOWN]))}" + (", ..." if len(left_out) > _SHOWN else "")
            )
        elif described and end < room:
            self.warnings.append(
                f"its Extra Bytes record describes {end} bytes, its points have {room}: the extra"
                " dimensions may be wrong"
            )
        return bytes(usable)

    def _head_with(self, header_bytes: int, records: dict[tuple[bytes, int], bytes]) -> bytes:
        """Return the header with these records and no others."""
        self.file.seek(0)
        head = bytearray(self.file.read(header_bytes))
        if self.head[25] >= 4 and len(head) >= _LONG_AT + 8:
            struct.pack_into("<QI", head, _LONG_AT - 12, 0, 0)
        for (user, number), text in records.items():
            head += _RECORD.pack(user, number, len(text)) + text
        struct.pack_into("<II", head, 96, len(head), len(records))
        return bytes(head)

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


def _standard_names(point_format: int) -> set[str]:
    """Return the names of a point format's own dimensions."""
    names = {*_NAMES.split(), *(_SINCE_6 if point_format >= _LEGACY_FORMATS else _BEFORE_6).split()}
    for formats, more in _SOME.items():
        names.update(more.split() if point_format in formats else ())
    return names


def _dimension_name(described: bytes, taken: set[str]) -> tuple[str, bool]:
    """Return a dimension's name, and whether it had to be changed: it was empty, no text or taken."""
    text = described[4:36].split(b"\0")[0].decode("utf-8", "replace").replace("\ufffd", "_").strip()
    base = text or "extra"
    name, number = base, 1
    while name in taken or len(name.encode()) > 32:
        number += 1
        name = f"{base[:24]}_{number}"
    return name, name != described[4:36].split(b"\0")[0].decode("utf-8", "replace")
