# SPDX-License-Identifier: Apache-2.0
"""Read LAS, LAZ and COPC block by block, through laspy with lazrs (optional dependencies).

The format is that of the ASPRS LAS specification 1.4 R15; COPC is LAZ with its points in the order
of an octree.  Coordinates are stored as scaled integers and come out as float64.  Every dimension
becomes a column: bit fields such as ``return_number`` one byte each, extra dimensions with their
scale applied.  Points that are flagged withheld have no place (NaN), so that all that reads them leaves them
out, as it does with points that are not finite.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import TracebackType
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec, column_names
from shmmap.errors import MapDataError, PackageMissing
from shmmap.formats.las_header import LasHeader, read_las_header
from shmmap.formats.laz_chunks import check_laz
from shmmap.formats.point_checks import LasChecks, las_left_out
from shmmap.formats.source_file import refusal

LAS_SUFFIXES: Final = (".las", ".laz")  # COPC files end in .copc.laz

_PANICS: Final = "pyo3_runtime"  # module of exceptions that stand for panics in Rust

Bound3 = tuple[NDArray[np.float64], NDArray[np.float64]]


class LasReader:
    """A LAS or LAZ file, opened and its header checked.

    Parameters
    ----------
    drop_noise
        Whether points of the classes 7 and 18 have no place, either.

    Attributes
    ----------
    points
        Points in the file.
    columns
        ``xyz`` (N, 3) float64 in metres (or whatever unit the file's coordinate system has), then every
        other dimension with its own dtype, in file order.
    bounds
        (min_xyz, max_xyz) from the header, float64; None if the header's bounds are impossible.
    crs
        The coordinate system that the file names; None if it names none.
    compressed
        Whether the file is LAZ.
    version
        Version of the LAS format, such as ``1.4``.
    warnings
        Oddities of the file.
    checks
        Counts of points that are marked; what reads points adds them.

    Raises
    ------
    MapDataError
        ``truncated``, ``bad_las`` and the causes of files that cannot be opened.
    PackageMissing
        laspy is not installed.
    """

    def __init__(self, path: str | os.PathLike[str], *, drop_noise: bool = False) -> None:
        self.path = os.fspath(path)
        self._drop_noise = drop_noise
        self.checks = LasChecks(drop_noise=drop_noise)
        checked = read_las_header(self.path)
        self.points = checked.points
        self.compressed = checked.compressed
        self.crs = checked.crs
        laspy = _laspy(self.path, compressed=self.compressed)
        chunks = None
        backends: dict[str, Any] = {}
        with ExitStack() as undo, _refused(self.path, ""):
            if self.compressed:
                chunks = check_laz(
                    self.path,
                    checked.laszip,
                    point_format=checked.point_format,
                    record_bytes=checked.record_bytes,
                    data_at=checked.data_at,
                )
            if chunks is not None and not chunks.small:
                backends = {"laz_backend": laspy.LazBackend.Lazrs}  # serial: point by point
            counted = self.points
            if chunks is not None and chunks.points is not None and not checked.warnings:
                counted = chunks.points
            if counted < self.points:
                message = f"{self.points} points announced, {counted} are there"
                raise refusal("truncated", message, path=self.path, offset=os.stat(self.path).st_size)
            if counted > self.points:
                checked.warnings.append(
                    f"the header counts {self.points} points, the compressed data {counted}"
                )
            source = _Source(checked.head, undo.enter_context(open(self.path, "rb")))
            self._reader = laspy.LasReader(source, **backends)
            source.to_points(checked.data_at)
            self._read_header(laspy, checked)
            undo.pop_all()
        self.warnings: tuple[str, ...] = tuple(checked.warnings)

    def _read_header(self, laspy: Any, checked: LasHeader) -> None:
        header = self._reader.header
        header.offset_to_point_data = checked.data_at
        header.point_count = checked.points  # laspy trusts a wide count of 0
        self.version = str(header.version)
        self.encoding = ""
        low, high = np.array(header.mins, np.float64), np.array(header.maxs, np.float64)
        sound = np.isfinite([low, high]).all() and (low <= high).all() and np.any([low, high])
        self.bounds: Bound3 | None = (low, high) if sound else None
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
        with _refused(self.path, f"from point {at} on "):
            self._reader.seek(start)
        while at < self.points:
            with _refused(self.path, f"after {at} points "):
                record = self._reader.read_points(min(block_points, self.points - at))
                block = self._block(record)
            if not len(record):
                break
            at += len(record)
            yield block
        if at < self.points:
            raise refusal("truncated", f"{self.points} points announced, {at} are there", path=self.path)

    def _block(self, record: Any) -> dict[str, NDArray[Any]]:
        xyz = np.empty((len(record), 3), np.float64)
        for axis, name in enumerate("xyz"):
            xyz[:, axis] = np.asarray(getattr(record, name))
        block: dict[str, NDArray[Any]] = {"xyz": xyz}
        for column, name in zip(self._columns, self._names, strict=True):
            block[column] = np.asarray(record[name])
        left_out = las_left_out(block, drop_noise=self._drop_noise)
        if left_out.any():
            xyz[left_out] = np.nan
        return block


class _Source:
    """A file for laspy, which reads a header from memory first, and then the file."""

    def __init__(self, head: bytes, file: IO[bytes]) -> None:
        self._file = file
        self._read_from: IO[bytes] = io.BytesIO(head)

    def to_points(self, data_at: int) -> None:
        """Continue in the file, at its points."""
        self._file.seek(data_at)
        self._read_from = self._file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._read_from, name)


@contextmanager
def _refused(path: str, when: str) -> Iterator[None]:
    """Convert any exception of laspy to an error; a panic of its decompressor is not an `Exception`."""
    try:
        yield
    except MapDataError:
        raise
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__module__ != _PANICS:
            raise
        raise refusal("bad_las", f"{when}laspy refuses it: {_first_line(error)}", path=path) from error


def _laspy(path: str, *, compressed: bool) -> Any:
    """Import laspy, and its decompressor where the file needs it."""
    package = "laspy"
    try:
        import laspy

        if compressed:
            package = "lazrs"
            import lazrs  # noqa: F401
    except ImportError as error:
        raise PackageMissing(
            f"{path}: LAS and LAZ need the Python package {package}, which cannot be loaded: {error}",
            hint="pip install 'laspy[lazrs]>=2.7' 'lazrs>=0.8.1', or convert the file to PCD",
        ) from error
    return laspy


def _spec(name: str, values: NDArray[Any]) -> ColumnSpec:
    return ColumnSpec(name, values.dtype, 1 if values.ndim == 1 else values.shape[1])


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
