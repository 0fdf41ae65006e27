# SPDX-License-Identifier: Apache-2.0
"""Columns shared by several cells: their points are kept until the last of these cells is loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

# margin around a cell's box for rounded points: metres, and a relative part for float32 coordinates
_MARGIN: Final = 1e-3
_ROUNDING: Final = 2.0**-22


class ColumnBox(NamedTuple):
    """Columns ``i0 <= i < i1``, ``j0 <= j < j1``."""

    i0: int
    j0: int
    i1: int
    j1: int

    def common(self, other: ColumnBox) -> ColumnBox:
        """Intersect two boxes that overlap."""
        return ColumnBox(
            max(self.i0, other.i0), max(self.j0, other.j0), min(self.i1, other.i1), min(self.j1, other.j1)
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.j1 - self.j0, self.i1 - self.i0


def column_boxes(boxes: NDArray[np.float64], resolution: float) -> NDArray[np.int64]:
    """Return the columns that cells touch, (N, 4) int64, rows as `ColumnBox`; ``boxes`` (N, 4), metres."""
    margin = _MARGIN + _ROUNDING * np.abs(boxes).max(axis=1, keepdims=True)
    low = np.floor((boxes[:, :2] - margin) / resolution)
    high = np.floor((boxes[:, 2:] + margin) / resolution) + 1
    return np.hstack([low, high]).astype(np.int64)


@dataclass(slots=True)
class Columns:
    """Rows that belong to columns: ``i``, ``j`` (N,) int64, and ``values``, (N, ...)."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    values: NDArray[Any]

    def __len__(self) -> int:
        return len(self.i)

    def where(self, chosen: NDArray[np.bool_]) -> Columns:
        """Select rows by a mask, (N,)."""
        return Columns(self.i[chosen], self.j[chosen], self.values[chosen])

    def inside(self, box: ColumnBox) -> NDArray[np.bool_]:
        """Return a mask of the rows in a box."""
        return (self.i >= box.i0) & (self.i < box.i1) & (self.j >= box.j0) & (self.j < box.j1)

    @classmethod
    def joined(cls, parts: Sequence[Columns]) -> Columns:
        """Return the concatenation of these columns, of which there must be at least one."""
        return cls(
            np.concatenate([part.i for part in parts]),
            np.concatenate([part.j for part in parts]),
            np.concatenate([part.values for part in parts]),
        )


class Seams:
    """Storage of rows in columns to which later cells may add.

    Parameters
    ----------
    boxes
        (N, 4) int64: the `ColumnBox` of each cell, in loading order.

    Attributes
    ----------
    waiting
        Rows kept back, by the last cell that contributed to them.
    """

    def __init__(self, boxes: NDArray[np.int64]) -> None:
        self.waiting: dict[int, Columns] = {}
        self._boxes = boxes
        self._by_row = np.argsort(boxes[:, 1], kind="stable")
        self._rows = boxes[self._by_row, 1]
        self._tallest = int((boxes[:, 3] - boxes[:, 1]).max(initial=0))

    def _near(self, number: int, box: ColumnBox) -> list[tuple[int, ColumnBox]]:
        """Return the other cells that share columns with a cell, and these columns."""
        begin, end = np.searchsorted(self._rows, (box.j0 - self._tallest, box.j1))
        some = self._by_row[begin:end]
        i0, j0, i1, j1 = self._boxes[some].T
        some = some[(i0 < box.i1) & (i1 > box.i0) & (j0 < box.j1) & (j1 > box.j0) & (some != number)]
        return [(n, ColumnBox(*self._boxes[n].tolist()).common(box)) for n in some.tolist()]

    def add(self, number: int, rows: Columns | None) -> Columns | None:
        """Add the rows of cell ``number``, the next in order; return the rows of columns now complete.

        Parameters
        ----------
        number
            Number of the cell; all before it have been added.
        rows
            Rows, all in the cell's box; None: the cell has none.
        """
        box = ColumnBox(*self._boxes[number].tolist())
        shared = self._near(number, box)
        parts = [] if rows is None or not len(rows) else [rows]
        for other, _ in shared:
            held = self.waiting.get(other)
            if held is None:
                continue
            mine = held.inside(box)
            if mine.any():
                parts.append(held.where(mine))
                left = held.where(~mine)
                if len(left):
                    self.waiting[other] = left
                else:
                    del self.waiting[other]
        if not parts:
            return None
        every = Columns.joined(parts)
        open_columns = np.zeros(box.shape, np.bool_)
        for other, common in shared:
            if other > number:
                open_columns[
                    common.j0 - box.j0 : common.j1 - box.j0, common.i0 - box.i0 : common.i1 - box.i0
                ] = True
        held_back = open_columns[every.j - box.j0, every.i - box.i0]
        if held_back.any():
            self.waiting[number] = every.where(held_back)
            every = every.where(~held_back)
        return every if len(every) else None
