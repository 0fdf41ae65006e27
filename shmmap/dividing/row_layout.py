# SPDX-License-Identifier: Apache-2.0
"""What one point of the divided map looks like: its fields, their types, and where its frame lies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError

__all__ = ["AXES", "NO_MOVE", "NO_SCALE", "RowLayout", "common_rows", "word_view"]

AXES: Final = ("x", "y", "z")
NO_MOVE: Final = (0.0, 0.0, 0.0)
NO_SCALE: Final = (1.0, 1.0)

Columns = Mapping[str, NDArray[Any]] | NDArray[np.void]


@dataclass(frozen=True, slots=True)
class RowLayout:
    """Rows of the divided map: packed, one field per PCD field.

    Attributes
    ----------
    row
        Structured dtype with x, y and z, both float32 or float64, and every other field.
    move
        Added to each point, metres (x, y, z); summed in float64 and rounded once.
    scale
        Metres per unit of the source, in the plane and in height; multiplied before.
    """

    row: np.dtype[np.void]
    move: tuple[float, float, float] = NO_MOVE
    scale: tuple[float, float] = NO_SCALE

    def takes_as_is(self, row: np.dtype[np.void]) -> bool:
        """Whether records of type ``row`` are rows of the map already, byte by byte."""
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
            with np.errstate(invalid="ignore", over="ignore"):  # signalling NaNs; too large becomes inf
                rows[name] = values


def common_rows(
    rows: Sequence[np.dtype[np.void]],
    paths: Sequence[str],
    *,
    common_only: bool,
    wanted: Sequence[str] = (),
) -> np.dtype[np.void]:
    """Fields that the rows of all inputs share, in the order of the first; axes in the widest type.

    Parameters
    ----------
    wanted
        Only these count; empty: all.

    Raises
    ------
    BadRequest
        A field that is wanted is in none of the inputs.
    MapDataError
        The inputs have different fields, and ``common_only`` does not say to leave out what some lack.
    """
    if wanted:
        known = dict.fromkeys(name for row in rows for name in row.names or ())
        if missing := [name for name in wanted if name not in known]:
            raise BadRequest(
                f"no input has a field {', '.join(missing)}", hint=f"there are: {', '.join(known)}"
            )
        rows = [_chosen(row, wanted) for row in rows]
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


def _chosen(row: np.dtype[np.void], wanted: Sequence[str]) -> np.dtype[np.void]:
    return np.dtype([(name, row[name]) for name in row.names or () if name in wanted])


def word_view(rows: NDArray[np.void]) -> NDArray[Any]:
    """The same memory as (N, words) unsigned integers, as wide as the row's size allows."""
    size = rows.dtype.itemsize
    width = next(width for width in (8, 4, 2, 1) if size % width == 0)
    return rows.view(np.uint8).view(f"<u{width}").reshape(-1, size // width)
