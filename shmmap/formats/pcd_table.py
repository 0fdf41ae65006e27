# SPDX-License-Identifier: Apache-2.0
"""How the fields of a PCD file become columns: which, of which type, and from which bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.columns import ColumnSpec
from shmmap.formats.causes import refusal
from shmmap.formats.pcd_header import PcdField, PcdHeader

__all__ = ["FieldTable", "coordinate_dtype"]

_AXES: Final = ("x", "y", "z")
_EXACT: Final = 1 << 53  # the largest integers that float64 holds exactly


def coordinate_dtype(dtypes: Sequence[np.dtype[Any]]) -> np.dtype[Any]:
    """Return float32 or float64, the smaller that holds every value of all ``dtypes`` exactly.

    64-bit integers become float64 too; `FieldTable.put_axis` refuses values beyond 2**53.
    """
    return np.dtype("<f8" if np.result_type(np.float32, *dtypes).itemsize == 8 else "<f4")


class FieldTable:
    """The columns of a file and how to fill them from its fields.

    Attributes
    ----------
    columns
        ``xyz`` first, then every field that is neither padding nor a coordinate, in file order.
    axes, others
        The fields behind ``xyz`` and behind the other columns.
    """

    def __init__(self, header: PcdHeader) -> None:
        self.header = header
        by_name = {field.name: field for field in header.fields}
        self.axes: tuple[PcdField, ...] = tuple(by_name[axis] for axis in _AXES)
        self.others: tuple[PcdField, ...] = tuple(
            field for field in header.fields if not field.padding and field.name not in _AXES
        )
        self.xyz_dtype = coordinate_dtype([field.dtype for field in self.axes])
        self.columns: tuple[ColumnSpec, ...] = (
            ColumnSpec("xyz", self.xyz_dtype, 3, "m"),
            *(ColumnSpec(field.name, field.dtype, field.count) for field in self.others),
        )

    def empty_block(self, rows: int) -> tuple[NDArray[Any], ...]:
        """Return one uninitialised array of ``rows`` rows per column."""
        return tuple(
            np.empty(rows if spec.components == 1 else (rows, spec.components), spec.dtype)
            for spec in self.columns
        )

    def put_axis(self, xyz: NDArray[Any], axis: int, values: NDArray[Any], path: str) -> None:
        """Copy one coordinate into its place.

        Raises
        ------
        MapDataError
            ``coordinate_range`` if a 64-bit integer is too large for float64.
        """
        wide = values.dtype.kind in "iu" and values.dtype.itemsize == 8 and len(values) > 0
        if wide and (int(values.max()) > _EXACT or int(values.min()) < -_EXACT):
            raise refusal("coordinate_range", f"{_AXES[axis]} has integers beyond 2**53", path=path)
        with np.errstate(invalid="ignore"):  # signalling NaNs, when float32 widens
            xyz[:, axis] = values
