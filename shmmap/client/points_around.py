# SPDX-License-Identifier: Apache-2.0
"""The map's points near a place, as views of the cells they lie in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from shmmap.client.cell import Cell
from shmmap.errors import BadRequest
from shmmap.geometry import Circle, distance_to_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["PointsAround", "points_around"]


class PointsAround:
    """Cells that touch a circle, and which of their points lie in it.

    Nothing is copied, and no point is looked at, before `gather`, `mask` or `count` is called.
    Iterating gives the ``xyz`` of each cell as a whole: the points within the radius and those of
    border cells beyond it, zero-copy.

    A cell whose box lies wholly in the circle counts with all its points.

    Attributes
    ----------
    x, y, radius : float
        The circle, metres, map frame; its border belongs to it.
    cells : tuple of Cell
        Cells whose box touches the circle.
    whole : tuple of bool
        For each of them, whether its box lies wholly in the circle.
    """

    __slots__ = ("cells", "radius", "whole", "x", "y")

    def __init__(
        self, x: float, y: float, radius: float, cells: tuple[Cell, ...], whole: tuple[bool, ...]
    ) -> None:
        self.x = x
        self.y = y
        self.radius = radius
        self.cells = cells
        self.whole = whole

    def __repr__(self) -> str:
        return f"<PointsAround ({self.x:g}, {self.y:g}), {self.radius:g} m: {len(self.cells)} cells>"

    def __len__(self) -> int:
        """How many cells."""
        return len(self.cells)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (cell.xyz for cell in self.cells)

    def views(self, column: str = "xyz") -> list[NDArray[Any]]:
        """Whole columns of the cells, one read-only view each; nothing is copied."""
        return [cell[column] for cell in self.cells]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """Which points of cell number ``index`` lie in the circle, (N,) bool.

        Distances are computed in float64, whatever the dtype of the coordinates.
        """
        cell = self.cells[index]
        if self.whole[index]:
            return np.ones(cell.points, np.bool_)
        xyz, (origin_x, origin_y, _) = cell.xyz, cell.origin
        dx = np.subtract(xyz[:, 0], self.x - origin_x, dtype=np.float64)
        dy = np.subtract(xyz[:, 1], self.y - origin_y, dtype=np.float64)
        np.multiply(dx, dx, out=dx)
        np.multiply(dy, dy, out=dy)
        np.add(dx, dy, out=dx)
        inside: NDArray[np.bool_] = dx <= self.radius * self.radius
        return inside

    def count(self) -> int:
        """How many points lie in the circle."""
        return sum(
            cell.points if whole else int(np.count_nonzero(self.mask(index)))
            for index, (cell, whole) in enumerate(zip(self.cells, self.whole, strict=True))
        )

    def gather(self, column: str = "xyz") -> NDArray[Any]:
        """Copy a column of exactly the points in the circle into one array, cell after cell.

        Several columns gathered one after the other have their rows in the same order.

        Raises
        ------
        KeyError
            A cell has no such column.
        BadRequest
            Coordinates of cells with different origins cannot be put into one array.
        """
        if column == "xyz" and len({cell.origin for cell in self.cells}) > 1:
            raise BadRequest("the cells' coordinates have different origins: use views() with cell.origin")
        parts = [
            cell[column] if whole else cell[column][self.mask(index)]
            for index, (cell, whole) in enumerate(zip(self.cells, self.whole, strict=True))
        ]
        if not parts:
            return np.empty((0, 3) if column == "xyz" else (0,), np.float32)
        return np.concatenate(parts)


def _farthest_in_boxes(x: float, y: float, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance in metres from a point to the farthest point of each box ((N, 4) float64), as (N,)."""
    dx = np.maximum(np.abs(boxes[:, 0] - x), np.abs(boxes[:, 2] - x))
    dy = np.maximum(np.abs(boxes[:, 1] - y), np.abs(boxes[:, 3] - y))
    distance: NDArray[np.float64] = np.hypot(dx, dy)
    return distance


def points_around(
    cells: Sequence[Cell], boxes: NDArray[np.float64], x: float, y: float, radius: float
) -> PointsAround:
    """Choose the cells that touch a circle.

    Parameters
    ----------
    cells
        Cells of one layer.
    boxes
        Their boxes, (N, 4) float64, metres, map frame.

    Raises
    ------
    BadRequest
        The circle makes no sense (not finite, negative radius).
    """
    Circle(x, y, radius)
    near = np.flatnonzero(distance_to_boxes(x, y, boxes) <= radius)
    whole = _farthest_in_boxes(x, y, boxes[near]) <= radius
    return PointsAround(x, y, radius, tuple([cells[i] for i in near.tolist()]), tuple(whole.tolist()))
