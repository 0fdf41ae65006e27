# SPDX-License-Identifier: Apache-2.0
"""The fields of a PCD file, from the lines of its header, and the columns that they become."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.source_file import refusal

MAX_FIELDS: Final = 1024
MAX_POINT_BYTES: Final = 1 << 20
MAX_NAME_BYTES: Final = 40  # bytes of a column's name in a segment
PADDING: Final = "_"
AXES: Final = ("x", "y", "z")

_DTYPES: Final[dict[tuple[bytes, bytes], np.dtype[np.generic]]] = {
    (kind.upper().encode(), str(size).encode()): np.dtype(f"<{kind}{size}")
    for kind, sizes in (("f", (4, 8)), ("u", (1, 2, 4, 8)), ("i", (1, 2, 4, 8)))
    for size in sizes
}


@dataclass(frozen=True, slots=True)
class PcdField:
    """One field of the header.

    Attributes
    ----------
    name
        Unique name: duplicates get a number, ``x``, ``y`` and ``z`` are in lower case.
    dtype
        Little-endian type of one value.
    count
        Values per point; 0 only for padding.
    """

    name: str
    dtype: np.dtype[np.generic]
    count: int = 1

    @property
    def padding(self) -> bool:
        """Whether the field is named ``_``, so that its bytes mean nothing."""
        return self.name == PADDING

    @property
    def row_bytes(self) -> int:
        """Bytes of one point's values."""
        return self.dtype.itemsize * self.count


# a block of columns; and x, y and z as contiguous arrays if available
RawBlock = tuple[tuple[NDArray[Any], ...], tuple[NDArray[Any], ...]]

_EXACT: Final = 1 << 53  # the largest integers that float64 holds exactly


class FieldTable:
    """The columns of a file, and how its fields fill them.

    Attributes
    ----------
    columns
        ``xyz`` first, then every field that is neither padding nor a coordinate, in file order.
    axes, others
        The source fields of ``xyz`` and of the other columns.
    xyz_dtype
        The smaller of float32 and float64 that holds every coordinate exactly.  64-bit integers become
        float64 too; `put_axis` refuses values beyond 2**53.
    axes_are_xyz
        Whether the coordinates have the type of ``xyz`` already.
    record
        Packed type of one point in a ``binary`` file; fields by their unique names, padding skipped.
    values
        Values per point in an ``ascii`` file, padding included.
    """

    def __init__(self, fields: tuple[PcdField, ...]) -> None:
        self.fields = fields
        by_name = {field.name: field for field in fields}
        self.axes: tuple[PcdField, ...] = tuple(by_name[axis] for axis in AXES)
        self.others: tuple[PcdField, ...] = tuple(
            field for field in fields if not field.padding and field.name not in AXES
        )
        widest = np.result_type(np.float32, *(field.dtype for field in self.axes))
        self.xyz_dtype: np.dtype[Any] = np.dtype("<f8" if widest.itemsize == 8 else "<f4")
        self.columns: tuple[ColumnSpec, ...] = (
            ColumnSpec("xyz", self.xyz_dtype, 3, "m"),
            *(ColumnSpec(field.name, field.dtype, field.count) for field in self.others),
        )
        self.axes_are_xyz = all(field.dtype == self.xyz_dtype for field in self.axes)
        self.values = sum(field.count for field in fields)
        self.record = _record_dtype(fields)

    def block_shapes(self, rows: int) -> list[tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return shape and type of each column in a block of ``rows`` rows."""
        return [
            ((rows,) if spec.components == 1 else (rows, spec.components), spec.dtype)
            for spec in self.columns
        ]

    def empty_block(self, rows: int) -> tuple[NDArray[Any], ...]:
        """Return one uninitialised array of ``rows`` rows per column."""
        return tuple(np.empty(shape, dtype) for shape, dtype in self.block_shapes(rows))

    def put_axis(self, xyz: NDArray[Any], axis: int, values: NDArray[Any], path: str) -> None:
        """Copy one coordinate into its place.

        Raises
        ------
        MapDataError
            ``coordinate_range`` if a 64-bit integer is too large for float64.
        """
        if values.dtype == xyz.dtype:
            xyz[:, axis] = values
            return
        wide = values.dtype.kind in "iu" and values.dtype.itemsize == 8 and len(values) > 0
        if wide and (int(values.max()) > _EXACT or int(values.min()) < -_EXACT):
            raise refusal("coordinate_range", f"{AXES[axis]} has integers beyond 2**53", path=path)
        with np.errstate(invalid="ignore"):  # signalling NaNs would warn
            xyz[:, axis] = values

    def put_records(self, block: tuple[NDArray[Any], ...], records: NDArray[Any], path: str) -> None:
        """Copy records, with fields by their unique names, into the columns of a block of equal length."""
        # one strided copy per axis: copying (N, 3) at once takes four times as long
        for axis, field in enumerate(self.axes):
            self.put_axis(block[0], axis, records[field.name], path)
        for column, field in zip(block[1:], self.others, strict=True):
            column[...] = records[field.name]

    def named(
        self, blocks: Iterable[tuple[NDArray[Any], ...]], start: int
    ) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield blocks as columns by name, without their first ``start`` rows."""
        names = [spec.name for spec in self.columns]
        for block in blocks:
            rows = len(block[0])
            if start < rows:
                yield dict(zip(names, (column[start:] for column in block), strict=True))
            start = max(0, start - rows)


def _record_dtype(fields: tuple[PcdField, ...]) -> np.dtype[Any]:
    names: list[str] = []
    formats: list[Any] = []
    offsets: list[int] = []
    at = 0
    for field in fields:
        if not field.padding:
            names.append(field.name)
            formats.append(field.dtype if field.count == 1 else (field.dtype, (field.count,)))
            offsets.append(at)
        at += field.row_bytes
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})


class FieldProblem(Exception):
    """Contradictory or invalid field lines: which line, why, and the error's cause."""

    def __init__(self, key: bytes, message: str, cause: str = "bad_header") -> None:
        super().__init__(message)
        self.key = key
        self.message = message
        self.cause = cause


@lru_cache(maxsize=64)  # cells of a map share these lines, and so one table
def parse_fields(
    names: tuple[bytes, ...],
    sizes: tuple[bytes, ...],
    types: tuple[bytes, ...],
    counts: tuple[bytes, ...] | None,
) -> tuple[FieldTable, tuple[str, ...]]:
    """Combine the words of FIELDS, SIZE, TYPE and COUNT (None if missing: all 1).

    Returns
    -------
    The table of the fields in file order, and warnings.

    Raises
    ------
    FieldProblem
        If the lines contradict each other, or there is no usable x, y and z.
    """
    if not 0 < len(names) <= MAX_FIELDS:
        raise FieldProblem(b"FIELDS", f"{len(names)} fields; 1 to {MAX_FIELDS} can be read")
    counts = (b"1",) * len(names) if counts is None else counts
    for key, words in ((b"SIZE", sizes), (b"TYPE", types), (b"COUNT", counts)):
        if len(words) != len(names):
            raise FieldProblem(key, f"{len(names)} FIELDS, but {len(words)} values in {key.decode()}")
    decoded = [_decode(name) for name in names]
    unique, warnings = _unique_names(decoded)
    fields = []
    for file_name, name, size, kind, count in zip(decoded, unique, sizes, types, counts, strict=True):
        dtype = _DTYPES.get((kind.upper(), size))
        if dtype is None:
            text = (kind[:8] + size[:8]).decode("latin-1")
            raise FieldProblem(
                b"TYPE", f"field {file_name!r} is of type {text!r}, which PCD does not have", "bad_type"
            )
        fields.append(PcdField(name, dtype, _count(count, 0 if name == PADDING else 1)))
    _check_xyz(fields)
    point_bytes = sum(field.row_bytes for field in fields)
    if point_bytes > MAX_POINT_BYTES:
        raise FieldProblem(b"COUNT", f"a point of {point_bytes} bytes; the limit is {MAX_POINT_BYTES}")
    return FieldTable(tuple(fields)), tuple(warnings)


def _decode(name: bytes) -> str:
    try:
        text = name.decode()
    except UnicodeDecodeError:
        text = name.decode("latin-1")
    if not text.isprintable():
        raise FieldProblem(b"FIELDS", f"field name {text[:40]!r} has unprintable characters")
    return text


def _count(word: bytes, low: int) -> int:
    if not word.isdigit() or len(word) > 9:
        raise FieldProblem(b"COUNT", f"COUNT {word[:40].decode('latin-1')!r} is not a number of values")
    if int(word) < low:
        raise FieldProblem(b"COUNT", f"COUNT {int(word)} for a field that is not padding")
    return int(word)


def _unique_names(names: list[str]) -> tuple[list[str], list[str]]:
    """Lower-case x, y and z, number duplicates, and cut names to the length that a segment can store.

    Returns
    -------
    One name per field, unique but for padding, and a warning for each change.
    """
    renamed, warnings = list(names), []
    for axis in AXES:
        if axis not in names and axis.upper() in names:
            renamed[names.index(axis.upper())] = axis
            warnings.append(f"field {axis.upper()!r} is taken as {axis!r}")
    original = set(renamed)
    taken = {"xyz"}  # name of the column that x, y and z form
    for index, name in enumerate(renamed):
        if name == PADDING:
            continue
        new = short = _cut(name, MAX_NAME_BYTES)
        number = 1
        while new in taken or (new != name and new in original):
            number += 1
            suffix = f"_{number}"
            new = _cut(short, MAX_NAME_BYTES - len(suffix)) + suffix
        taken.add(new)
        renamed[index] = new
        if new != name:
            warnings.append(f"field {name[:80]!r} renamed {new!r}: the name is in use or too long")
    return renamed, warnings


def _cut(name: str, limit_bytes: int) -> str:
    return name.encode()[:limit_bytes].decode(errors="ignore")


def _check_xyz(fields: list[PcdField]) -> None:
    counts = {field.name: field.count for field in fields if field.name in AXES}
    missing = [axis for axis in AXES if axis not in counts]
    if missing:
        raise FieldProblem(
            b"FIELDS", f"no field {', '.join(missing)}: not a cloud of points in space", "no_xyz"
        )
    if any(count != 1 for count in counts.values()):
        raise FieldProblem(b"COUNT", "x, y and z need COUNT 1", "no_xyz")
