# SPDX-License-Identifier: Apache-2.0
"""Columns that several cells share: their points wait until the last of those cells has come."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["ColumnBox", "Columns", "Seams"]

# beyond its box to which a cell may have points, by rounding: metres, and what float32 coordinates add
_MARGIN: Final = 1e-3
_ROUNDING: Final = 2.0**-22


class ColumnBox(NamedTuple):
    """Columns ``i0 <= i < i1``, ``j0 <= j < j1``."""

    i0: int
    j0: int
    i1: int
    j1: int

    @classmethod
    def of_box(cls, box: tuple[float, float, float, float], resolution: float) -> ColumnBox:
        """The columns that a cell's box (metres) touches."""
        margin = _MARGIN + _ROUNDING * max(abs(value) for value in box)
        low = [math.floor((value - margin) / resolution) for value in box[:2]]
        high = [math.floor((value + margin) / resolution) + 1 for value in box[2:]]
        return cls(low[0], low[1], high[0], high[1])

    def common(self, other: ColumnBox) -> ColumnBox | None:
        """What both have, None where that is nothing."""
        box = ColumnBox(
            max(self.i0, other.i0), max(self.j0, other.j0), min(self.i1, other.i1), min(self.j1, other.j1)
        )
        return box if box.i0 < box.i1 and box.j0 < box.j1 else None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.j1 - self.j0, self.i1 - self.i0


@dataclass(slots=True)
class Columns:
    """Rows that belong to columns: ``i``, ``j`` (N,) int64, and ``values``, (N, ...)."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    values: NDArray[Any]

    def __len__(self) -> int:
        return len(self.i)

    def where(self, chosen: NDArray[np.bool_]) -> Columns:
        """The chosen rows."""
        return Columns(self.i[chosen], self.j[chosen], self.values[chosen])

    def inside(self, box: ColumnBox) -> NDArray[np.bool_]:
        """Which rows are in a box."""
        return (self.i >= box.i0) & (self.i < box.i1) & (self.j >= box.j0) & (self.j < box.j1)

    @classmethod
    def joined(cls, parts: Sequence[Columns]) -> Columns:
        """One after the other; there must be one."""
        return cls(
            np.concatenate([part.i for part in parts]),
            np.concatenate([part.j for part in parts]),
            np.concatenate([part.values for part in parts]),
        )


@dataclass(slots=True)
class Seams:
    """Holds back what later cells may add to.

    Attributes
    ----------
    boxes
        Columns that each cell touches, in the order in which cells come.
    waiting
        Rows held back, by the cell that brought them last.
    """

    boxes: Sequence[ColumnBox]
    waiting: dict[int, Columns] = field(default_factory=dict)
    _bins: dict[tuple[int, int], list[int]] = field(default_factory=dict)
    _edge: int = 1

    def __post_init__(self) -> None:
        if self.boxes:
            self._edge = int(np.median([max(box.shape) for box in self.boxes]))
        for number, box in enumerate(self.boxes):
            for place in self._places(box):
                self._bins.setdefault(place, []).append(number)

    def _places(self, box: ColumnBox) -> Iterable[tuple[int, int]]:
        edge = self._edge
        for j in range(box.j0 // edge, (box.j1 - 1) // edge + 1):
            for i in range(box.i0 // edge, (box.i1 - 1) // edge + 1):
                yield i, j

    def add(self, number: int, rows: Columns | None) -> Columns | None:
        """Take the rows of cell ``number``, the next in order; return what nobody adds to any more.

        Parameters
        ----------
        number
            Cells before it have come, those after it have not.
        rows
            All in the cell's box; None: it has none.
        """
        box = self.boxes[number]
        near = {other for place in self._places(box) for other in self._bins[place]} - {number}
        shared = [(other, self.boxes[other].common(box)) for other in near]
        parts = [] if rows is None or not len(rows) else [rows]
        for other, common in shared:
            held = self.waiting.get(other)
            if common is None or held is None:
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
            if common is not None and other > number:
                open_columns[
                    common.j0 - box.j0 : common.j1 - box.j0, common.i0 - box.i0 : common.i1 - box.i0
                ] = True
        held_back = open_columns[every.j - box.j0, every.i - box.i0]
        if held_back.any():
            self.waiting[number] = every.where(held_back)
            every = every.where(~held_back)
        return every if len(every) else None
