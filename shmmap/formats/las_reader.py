# SPDX-License-Identifier: Apache-2.0
"""LAS, LAZ and COPC through laspy, block by block (laspy with lazrs, optional dependencies).

The format is that of the ASPRS LAS specification 1.4 R15; COPC is LAZ with its points in the order
of an octree.  Coordinates are stored as scaled integers and come out as float64.  Every dimension
becomes a column: bit fields such as ``return_number`` one byte each, extra dimensions with their
scale applied.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec, column_names
from shmmap.errors import MapDataError, PackageMissing
from shmmap.formats.causes import refusal
from shmmap.formats.degrees import GEOGRAPHIC_SYSTEM, is_geographic
from shmmap.formats.source_file import open_regular

__all__ = ["LAS_SUFFIXES", "LasReader"]

LAS_SUFFIXES: Final = (".las", ".laz")  # COPC files end in .copc.laz

_SIGNATURE: Final = b"LASF"
_SHORTEST_HEADER_BYTES: Final = 227  # LAS 1.0 to 1.2
_LEGACY_COUNT: Final = struct.Struct("<I4xBHI")  # at 96: offset to points, format, record bytes, points
_LONG_COUNT_AT: Final = 247  # uint64, from LAS 1.4 on
_LAZ_BIT: Final = 0x80


class LasReader:
    """A LAS or LAZ file, opened and its header checked.

    Attributes
    ----------
    points
        Points in the file.
    columns
        ``xyz`` (N, 3) float64 in metres (or whatever unit the file's coordinate system has), then every
        other dimension with its own dtype, in file order.
    bounds
        (min_xyz, max_xyz) as the header claims, float64.
    compressed
        Whether it is LAZ.
    version
        Of the LAS format, such as ``1.4``.
    warnings
        Oddities of the file.

    Raises
    ------
    MapDataError
        ``truncated``, ``bad_las`` and the causes of files that cannot be opened.
    PackageMissing
        laspy is not installed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self.compressed = _check_start(self.path)
        laspy = _laspy(self.path)
        try:
            self._reader = laspy.open(self.path)
        except Exception as error:
            raise refusal("bad_las", f"laspy refuses it: {_first_line(error)}", path=self.path) from error
        header = self._reader.header
        self.points = int(header.point_count)
        self.version = str(header.version)
        self.encoding = ""
        self.bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = (
            np.array(header.mins, np.float64),
            np.array(header.maxs, np.float64),
        )
        self.warnings: tuple[str, ...] = (GEOGRAPHIC_SYSTEM,) if is_geographic(header) else ()
        self._names = [name for name in header.point_format.dimension_names if name not in ("X", "Y", "Z")]
        empty = laspy.ScaleAwarePointRecord.zeros(0, header=header)
        self._columns = column_names(self._names)
        self.columns: tuple[ColumnSpec, ...] = (
            ColumnSpec("xyz", np.dtype("<f8"), 3, "m"),
            *(
                _spec(column, np.asarray(empty[name]))
                for column, name in zip(self._columns, self._names, strict=True)
            ),
        )

    def __enter__(self) -> LasReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def blocks(self, block_points: int, start: int = 0) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns of the points from ``start`` on, at most ``block_points`` rows at a time.

        Raises
        ------
        MapDataError
            ``bad_las`` or ``truncated`` if the data contradicts the header.
        """
        at = start
        if at >= self.points:
            return
        try:
            self._reader.seek(start)
            while at < self.points:
                record = self._reader.read_points(min(block_points, self.points - at))
                if not len(record):
                    break
                at += len(record)
                yield self._block(record)
        except MapDataError:
            raise
        except Exception as error:
            raise refusal(
                "bad_las", f"after {at} points laspy refuses it: {_first_line(error)}", path=self.path
            ) from error
        if at < self.points:
            raise refusal("truncated", f"{self.points} points announced, {at} are there", path=self.path)

    def _block(self, record: Any) -> dict[str, NDArray[Any]]:
        xyz = np.empty((len(record), 3), np.float64)
        for axis, name in enumerate("xyz"):
            xyz[:, axis] = np.asarray(getattr(record, name))
        block: dict[str, NDArray[Any]] = {"xyz": xyz}
        for column, name in zip(self._columns, self._names, strict=True):
            block[column] = np.asarray(record[name])
        return block


def _check_start(path: str) -> bool:
    """Refuse what is no LAS or is cut short, before laspy allocates for it; returns whether it is LAZ."""
    try:
        with open(open_regular(path), "rb") as file:
            head = file.read(_LONG_COUNT_AT + 8)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise refusal("unreadable", f"cannot be read: {error.strerror}", path=path) from error
    if not head:
        raise refusal("empty_file", "no bytes at all", path=path)
    if not head.startswith(_SIGNATURE):
        raise refusal("bad_las", "not a LAS file: it does not start with LASF", path=path, offset=0)
    if len(head) < _SHORTEST_HEADER_BYTES:
        raise refusal("truncated", "the file ends within its header", path=path, offset=len(head))
    data_at, form, record_bytes, points = _LEGACY_COUNT.unpack_from(head, 96)
    if head[25] >= 4 and len(head) >= _LONG_COUNT_AT + 8:
        points = int.from_bytes(head[_LONG_COUNT_AT:], "little")
    compressed = bool(form & _LAZ_BIT)
    # LAZ needs more than a bit a point; every LAS point its record
    needed = data_at if compressed else data_at + points * record_bytes
    if size < needed or (compressed and points > (size - data_at) * 256):
        raise refusal(
            "truncated", f"{points} points announced need {needed} bytes, {size} are there", path=path
        )
    return compressed


def _laspy(path: str) -> Any:
    try:
        import laspy
    except ImportError as error:
        raise PackageMissing(
            f"{path}: LAS and LAZ need the Python package laspy, which cannot be loaded: {error}",
            hint="pip install 'laspy[lazrs]', or convert the file to PCD",
        ) from error
    return laspy


def _spec(name: str, values: NDArray[Any]) -> ColumnSpec:
    return ColumnSpec(name, values.dtype, 1 if values.ndim == 1 else values.shape[1])


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
