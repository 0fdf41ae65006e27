# SPDX-License-Identifier: Apache-2.0
"""Read clouds of any format as streams of the divided map's rows, in bounded memory."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.errors import BadRequest, MapDataError
from shmmap.formats.cloud import cloud_suffix, open_blocks
from shmmap.formats.coordinate_system import CoordinateSystem
from shmmap.formats.pcd.reader import PcdReader, expanded_blocks
from shmmap.formats.point_checks import PointChecks
from shmmap.formats.source_file import refusal

AXES: Final = ("x", "y", "z")
NO_MOVE: Final = (0.0, 0.0, 0.0)
NO_SCALE: Final = (1.0, 1.0)

Columns = Mapping[str, NDArray[Any]] | NDArray[np.void]
Blocks = Generator[Mapping[str, NDArray[Any]], None, None]


@dataclass(frozen=True, slots=True)
class RowLayout:
    """Row type of the divided map, packed, one field per PCD field; and the conversion to it.

    Attributes
    ----------
    row
        Structured dtype with x, y and z, both float32 or float64, and every other field.
    move
        Translation of each point, metres (x, y, z); added in float64 and rounded once.
    scale
        Metres per unit of the source, in the plane and in height; applied before ``move``.
    """

    row: np.dtype[np.void]
    move: tuple[float, float, float] = NO_MOVE
    scale: tuple[float, float] = NO_SCALE

    def takes_as_is(self, row: np.dtype[np.void]) -> bool:
        """Whether records of type ``row`` are rows of the map already, byte for byte."""
        return row == self.row and self._stays and row.itemsize == self.row.itemsize

    @property
    def _stays(self) -> bool:
        return self.move == NO_MOVE and self.scale == NO_SCALE

    def put(self, block: Columns, rows: NDArray[np.void]) -> None:
        """Write the columns of ``block`` to ``rows``; both have the same length."""
        for name in self.row.names or ():
            values = block[name]
            if name in AXES and not self._stays:
                axis = AXES.index(name)
                moved = values.astype(np.float64)
                if self.scale != NO_SCALE:
                    moved *= self.scale[axis // 2]
                moved += self.move[axis]
                values = moved
            with np.errstate(invalid="ignore", over="ignore"):  # signalling NaNs; values too large become inf
                rows[name] = values


def common_rows(
    rows: Sequence[np.dtype[np.void]],
    paths: Sequence[str],
    *,
    common_only: bool,
    wanted: Sequence[str] = (),
) -> np.dtype[np.void]:
    """Return the fields common to all inputs, in the order of the first; axes have the widest type.

    Parameters
    ----------
    wanted
        Fields to consider; empty: all.

    Raises
    ------
    BadRequest
        A wanted field is in none of the inputs.
    MapDataError
        The inputs have different fields, and ``common_only`` is False.
    """
    if wanted:
        known = dict.fromkeys(name for row in rows for name in row.names or ())
        if missing := [name for name in wanted if name not in known]:
            raise BadRequest(
                f"no input has a field {', '.join(missing)}", hint=f"there are: {', '.join(known)}"
            )
        rows = [np.dtype([(name, row[name]) for name in row.names or () if name in wanted]) for row in rows]
    fields: list[tuple[str, Any]] = []
    for name in rows[0].names or ():
        if name in AXES:
            widest = max(row[axis].itemsize for row in rows for axis in AXES)
            fields.append((name, np.dtype(f"<f{widest}")))
        elif all(name in (row.names or ()) and row[name] == rows[0][name] for row in rows):
            fields.append((name, rows[0][name]))
    if not common_only:
        kept = {name for name, _ in fields}
        for row, path in zip(rows, paths, strict=True):
            odd = sorted({*(row.names or ())} - kept) or sorted({*(rows[0].names or ())} - kept)
            if odd:
                raise MapDataError(
                    f"the inputs have different fields: not all have {', '.join(odd)} of the same type",
                    path=path,
                    cause="different_fields",
                    hint="--common-fields keeps only what all inputs have",
                )
    return np.dtype(fields)


def with_axes(row: np.dtype[np.void], axis: np.dtype[Any]) -> np.dtype[np.void]:
    """Return the packed row type with another type for x, y and z."""
    return np.dtype([(name, axis if name in AXES else row[name]) for name in row.names or ()])


def field_types(row: np.dtype[np.void]) -> list[tuple[str, str]]:
    """Return names and dtypes of a row's fields, for reports."""
    return [(name, row[name].str) for name in row.names or ()]


def word_view(rows: NDArray[np.void]) -> NDArray[Any]:
    """Return a view of rows as (N, words) unsigned integers, as wide as the row's size allows."""
    size = rows.dtype.itemsize
    width = next(width for width in (8, 4, 2, 1) if size % width == 0)
    return rows.view(np.uint8).view(f"<u{width}").reshape(-1, size // width)


Bound3 = tuple[NDArray[np.float64], NDArray[np.float64]]

_BLOCK_POINTS: Final = 1 << 16  # points of files that need conversion; small enough for the processor's cache
_READER_BLOCK_POINTS: Final = 1 << 18  # a few of LAZ's chunks of 50000 points, so that all cores help


class Source(ABC):
    """A cloud that is read from front to back.

    The file is open only while it is read: a map has more cells than a process may have open files.

    Attributes
    ----------
    path
        The file.
    points
        Number of points, from the header and checked against the file's size.
    row
        Packed type of a point: x, y, z (both float32 or float64) and every other field.
    claimed_bounds
        (min_xyz, max_xyz) from the file's header; None if it has none.
    crs
        The coordinate system that the file names; None if it names none.
    scale
        Metres per unit, in the plane and in height; 1 until set, which must happen before reading.
    warnings
        Oddities of the file.
    checks
        What is odd about the points that were read.
    """

    claimed_bounds: Bound3 | None = None
    crs: CoordinateSystem | None = None
    scale = NO_SCALE

    def __init__(self, path: str, points: int, row: np.dtype[np.void], warnings: tuple[str, ...]) -> None:
        self.path = path
        self.points = points
        self.row = row
        self.warnings = warnings
        self.checks = PointChecks()
        self._layout = RowLayout(row)

    @abstractmethod
    def begin(self, layout: RowLayout, start: int) -> None:
        """Seek to point ``start``; `read` then returns rows of ``layout``."""

    @abstractmethod
    def read(self, rows: NDArray[np.void]) -> int:
        """Fill ``rows`` with the next points; return their number, smaller than requested only at the end.

        Raises
        ------
        MapDataError
            The data contradicts the header.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file."""

    def _check_same(self, points: int, row: np.dtype[np.void]) -> None:
        """Check that the file that was opened again is the one that was looked at."""
        if points != self.points or row != self.row:
            raise refusal("changed", "the file changed since it was looked at", path=self.path)


def open_source(path: str, *, memory_bytes: int, scratch_dir: str, drop_noise: bool = False) -> Source:
    """Open a cloud and check its header.

    Parameters
    ----------
    path
        The file, whose ending determines the format.
    memory_bytes
        Memory that reading may take.
    scratch_dir
        Directory in which a compressed PCD file larger than that is expanded, as an unnamed file.
    drop_noise
        As in `shmmap.formats.cloud.read_cloud`.

    Raises
    ------
    MapDataError
        The file contradicts its header or format.
    """
    suffix = cloud_suffix(path)
    if suffix == ".pcd":
        with _open_pcd(path) as reader:
            floats = all(reader.record[axis].kind == "f" for axis in AXES)
            if reader.header.encoding == "binary" and floats:
                return _BinaryPcd(reader)
            return _StreamedPcd(reader, memory_bytes, scratch_dir)
    return _OtherFormat(path, suffix, drop_noise=drop_noise)


def _open_pcd(path: str) -> PcdReader:
    return PcdReader(path, keep_non_finite=True, block_points=_BLOCK_POINTS)


class _BinaryPcd(Source):
    """Binary PCD, whose records are read directly."""

    def __init__(self, reader: PcdReader) -> None:
        super().__init__(reader.path, reader.header.points, _row_of_records(reader), reader.warnings)
        self.crs = reader.header.crs
        self._reader = reader
        self._at = 0
        self._direct = False
        self._staged = np.empty(0, reader.record)

    def begin(self, layout: RowLayout, start: int) -> None:
        self.close()
        self._reader = _open_pcd(self.path)
        self._check_same(self._reader.header.points, _row_of_records(self._reader))
        self._layout, self._at = layout, start
        self._direct = self.row == self._reader.record and layout.takes_as_is(self.row)
        if not self._direct:
            self._staged = np.empty(_BLOCK_POINTS, self._reader.record)

    def read(self, rows: NDArray[np.void]) -> int:
        count = min(len(rows), self.points - self._at)
        if self._direct:
            self._reader.read_records(self._at, rows[:count])
        else:
            for start in range(0, count, _BLOCK_POINTS):
                part = rows[start : min(start + _BLOCK_POINTS, count)]
                staged = self._staged[: len(part)]
                self._reader.read_records(self._at + start, staged)
                self._layout.put(staged, part)
        self._at += count
        return count

    def close(self) -> None:
        self._reader.close()
        self._staged = self._staged[:0].copy()


class _Stream(Source):
    """Base of sources whose formats yield blocks of columns."""

    def __init__(
        self, path: str, points: int, columns: tuple[ColumnSpec, ...], warnings: tuple[str, ...]
    ) -> None:
        super().__init__(path, points, _row_of(columns), warnings)
        self._iterator = self._blocks(0)
        self._block: Mapping[str, NDArray[Any]] = {}
        self._used = self._length = 0

    @abstractmethod
    def _blocks(self, start: int) -> Blocks:
        """Yield the columns of one block of points after another, from point ``start`` on."""

    def begin(self, layout: RowLayout, start: int) -> None:
        self.close()
        self._layout = layout
        if not start:  # else the points before were counted by the run that is resumed
            self.checks.counts.clear()
        self._iterator = self._blocks(start)
        self._used = self._length = 0

    def read(self, rows: NDArray[np.void]) -> int:
        at = 0
        while at < len(rows):
            if self._used == self._length:
                block = next(self._iterator, None)
                if block is None:
                    break
                xyz = block["xyz"]
                self._block = {**block, **{axis: xyz[:, i] for i, axis in enumerate(AXES)}}
                self._used, self._length = 0, len(xyz)
            count = min(len(rows) - at, self._length - self._used)
            part = slice(self._used, self._used + count)
            columns = {name: values[part] for name, values in self._block.items()}
            self.checks.add(columns)
            self._layout.put(columns, rows[at : at + count])
            self._used += count
            at += count
        return at

    def close(self) -> None:
        self._iterator.close()  # closes the file that the generator has open
        self._block = {}


class _StreamedPcd(_Stream):
    """PCD in ascii or binary_compressed, or with integer coordinates."""

    def __init__(self, reader: PcdReader, memory_bytes: int, scratch_dir: str) -> None:
        header = reader.header
        super().__init__(reader.path, header.points, reader.columns, reader.warnings)
        self.crs = header.crs
        self._scratch_dir = scratch_dir
        expanded = header.points * header.point_bytes
        packed = os.fstat(reader.fileno()).st_size
        self._expand = header.encoding == "binary_compressed" and expanded + packed > memory_bytes

    def _blocks(self, start: int) -> Blocks:
        with _open_pcd(self.path) as reader:
            self._check_same(reader.header.points, _row_of(reader.columns))
            if self._expand:
                yield from expanded_blocks(reader, self._scratch_dir, _BLOCK_POINTS, start)
            else:
                yield from reader.named_blocks(start)


class _OtherFormat(_Stream):
    """Source of all formats other than PCD."""

    def __init__(self, path: str, suffix: str, *, drop_noise: bool) -> None:
        self._suffix = suffix
        self._drop_noise = drop_noise
        with open_blocks(path, suffix, drop_noise=drop_noise) as reader:
            super().__init__(path, reader.points, reader.columns, reader.warnings)
            self.claimed_bounds = reader.bounds
            self.crs = reader.crs
            self.checks = reader.checks

    def _blocks(self, start: int) -> Blocks:
        with open_blocks(self.path, self._suffix, drop_noise=self._drop_noise) as reader:
            self._check_same(reader.points, _row_of(reader.columns))
            yield from reader.blocks(_READER_BLOCK_POINTS, start)
            self.warnings = reader.warnings


def _row_of_records(reader: PcdReader) -> np.dtype[np.void]:
    """Return the packed row type of a ``binary`` file, whose fields stay in the file's order."""
    return with_axes(reader.record, reader.columns[0].dtype)


def _row_of(columns: tuple[ColumnSpec, ...]) -> np.dtype[np.void]:
    """Return the packed row type of a table whose first column is ``xyz``."""
    axis = np.dtype("<f8" if columns[0].dtype.itemsize == 8 else "<f4")
    others = [
        (spec.name, spec.dtype, (spec.components,)) if spec.components > 1 else (spec.name, spec.dtype)
        for spec in columns[1:]
    ]
    return np.dtype([*((name, axis) for name in AXES), *others])
