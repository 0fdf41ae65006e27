# SPDX-License-Identifier: Apache-2.0
"""The map's points near a place, as views of the cells they lie in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from shmmap.client.cell import Cell
from shmmap.client.cell_set import gather
from shmmap.errors import NoColumn
from shmmap.geometry import Circle, distance_to_boxes

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PointsAround:
    """Cells that touch a circle, and the selection of their points that lie in it.

    Nothing is copied, and no point is read, before `gather`, `mask` or `count` is called.
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
        For each cell, whether its box lies wholly in the circle.
    covered : bool
        Whether these are all cells that the map has in the circle.  False if the circle reaches beyond the
        area of the window's last answer or touches a cell that has failed, or while cells of the window are
        being loaded: see `MapWindow.covers`.
    """

    __slots__ = ("cells", "covered", "radius", "whole", "x", "y")

    def __init__(
        self,
        x: float,
        y: float,
        radius: float,
        cells: tuple[Cell, ...],
        whole: tuple[bool, ...],
        covered: bool,
    ) -> None:
        self.x = x
        self.y = y
        self.radius = radius
        self.cells = cells
        self.covered = covered
        self.whole = whole

    def __repr__(self) -> str:
        return f"<PointsAround ({self.x:g}, {self.y:g}), {self.radius:g} m: {len(self.cells)} cells>"

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.cells)

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (cell.xyz for cell in self.cells)

    def _check_points(self) -> None:
        """Raise `NoColumn` for layers whose rows are not points."""
        for cell in self.cells[:1]:
            if "xyz" not in cell.column_names:
                raise NoColumn(
                    f"layer {cell.layer} has no column 'xyz': which of its rows lie in a circle is not known",
                    hint=f"take whole cells, views(column) with {', '.join(cell.column_names)};"
                    " or ask for another layer, points_around(..., layer='points')",
                )

    def views(self, column: str = "xyz") -> list[NDArray[Any]]:
        """Return a column of each cell as a whole, as read-only views; nothing is copied.

        Raises
        ------
        NoColumn
            A cell has no such column.
        """
        return [cell[column] for cell in self.cells]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """Return which points of cell number ``index`` lie in the circle, (N,) bool.

        Distances are computed in float64, whatever the dtype of the coordinates.

        Raises
        ------
        NoColumn
            The layer's rows are not points: it has no column ``xyz``.
        """
        self._check_points()
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
        """Return the number of points in the circle.

        Raises
        ------
        NoColumn
            The layer's rows are not points: it has no column ``xyz``.
        """
        self._check_points()
        return sum(
            cell.points if whole else int(np.count_nonzero(self.mask(index)))
            for index, (cell, whole) in enumerate(zip(self.cells, self.whole, strict=True))
        )

    @overload
    def gather(self, column: str = "xyz", /) -> NDArray[Any]: ...

    @overload
    def gather(self, column: str, other: str, /, *others: str) -> dict[str, NDArray[Any]]: ...

    def gather(self, column: str = "xyz", /, *others: str) -> NDArray[Any] | dict[str, NDArray[Any]]:
        """Copy columns of exactly the points in the circle, cell after cell.

        ::

            points = near.gather()  # (N, 3)
            columns = near.gather("xyz", "intensity")  # {"xyz": (N, 3), "intensity": (N,)}

        Parameters
        ----------
        column, *others
            Names of columns.

        Returns
        -------
        array or dict of array
            For one column its values; for several a dict by name, with corresponding rows.

        Raises
        ------
        NoColumn
            A cell has no such column, or the layer's rows are no points: it has no column ``xyz``.
        BadRequest
            Coordinates of cells with different origins cannot be put into one array.
        """
        self._check_points()
        masks = (None if whole else self.mask(index) for index, whole in enumerate(self.whole))
        gathered = gather(self.cells, (column, *others), masks)
        return gathered if others else gathered[column]


def _farthest_in_boxes(x: float, y: float, boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance from a point to the farthest point of each box ((N, 4) float64), (N,) metres."""
    dx = np.maximum(np.abs(boxes[:, 0] - x), np.abs(boxes[:, 2] - x))
    dy = np.maximum(np.abs(boxes[:, 1] - y), np.abs(boxes[:, 3] - y))
    distance: NDArray[np.float64] = np.hypot(dx, dy)
    return distance


def points_around(
    cells: Sequence[Cell],
    boxes: NDArray[np.float64],
    x: float,
    y: float,
    radius: float,
    *,
    covered: bool,
) -> PointsAround:
    """Choose the cells that touch a circle.

    Parameters
    ----------
    cells
        Cells of one layer.
    boxes
        Their boxes, (N, 4) float64, metres, map frame.
    x, y, radius
        The circle, metres, map frame.
    covered
        Whether these are all the cells that the map has in the circle.

    Raises
    ------
    BadRequest
        The circle is invalid (not finite, negative radius).
    """
    Circle(x, y, radius)
    near = np.flatnonzero(distance_to_boxes(x, y, boxes) <= radius)
    whole = _farthest_in_boxes(x, y, boxes[near]) <= radius
    return PointsAround(
        x, y, radius, tuple([cells[i] for i in near.tolist()]), tuple(whole.tolist()), covered
    )
