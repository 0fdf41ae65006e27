# SPDX-License-Identifier: Apache-2.0
"""Map the fields of a PCD file to columns: names, types, and source bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.pcd.fields import AXES, PcdField
from shmmap.formats.source_file import refusal

__all__ = ["FieldTable", "RawBlock", "coordinate_dtype", "field_table"]

# a block of columns; and x, y and z as contiguous arrays if available
RawBlock = tuple[tuple[NDArray[Any], ...], tuple[NDArray[Any], ...]]

_EXACT: Final = 1 << 53  # the largest integers that float64 holds exactly


def coordinate_dtype(dtypes: Sequence[np.dtype[Any]]) -> np.dtype[Any]:
    """Return the smaller of float32 and float64 that holds every value of all ``dtypes`` exactly.

    64-bit integers become float64 too; `FieldTable.put_axis` refuses values beyond 2**53.
    """
    return np.dtype("<f8" if np.result_type(np.float32, *dtypes).itemsize == 8 else "<f4")


class FieldTable:
    """The columns of a file, and how its fields fill them.

    Attributes
    ----------
    columns
        ``xyz`` first, then every field that is neither padding nor a coordinate, in file order.
    axes, others
        The source fields of ``xyz`` and of the other columns.
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
        self.xyz_dtype = coordinate_dtype([field.dtype for field in self.axes])
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


_TABLES_LIMIT: Final = 64
_tables: Final[dict[int, FieldTable]] = {}


def field_table(fields: tuple[PcdField, ...]) -> FieldTable:
    """Return the table for ``fields``; cells of a map share one table.

    The headers of a map share the tuple object, and looking up its id is faster than hashing it.
    """
    table = _tables.get(id(fields))
    if table is None or table.fields is not fields:
        table = FieldTable(fields)
        if len(_tables) >= _TABLES_LIMIT:
            _tables.clear()
        _tables[id(fields)] = table
    return table
