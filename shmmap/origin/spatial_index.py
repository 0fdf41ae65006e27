# SPDX-License-Identifier: Apache-2.0
"""Finds the cells that touch an area, in time that does not grow with the number of cells.

Every cell is filed under the bucket ``floor(min corner / bucket size)`` of a grid whose buckets are
as large as the largest cell; the buckets are sorted integer keys ``iy << 32 | ix``.  A cell that
touches a query has its min corner at most one cell size before the query's, so each bucket row holds
its candidates in one contiguous run that two binary searches find.  The area's exact test then runs
on the candidates, in batches if there are many.  Cells need not form a lattice.  Cells of very
different sizes are filed in several such grids, one per power of two, so that one huge cell does not widen
the search for all others.

Sorting ten million keys takes as long as reading the rest of such a map.  So the search structure can be
kept (`SpatialIndex.made`) and passed to a new index.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area, Circle

Indices = NDArray[np.intp]
Floats = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

# For fewer cells, the exact test on all of them is faster than a search.
_LINEAR_CELLS = 5000

# Candidates that are tested at a time.
_CELLS_PER_BATCH = 1 << 15

# For fewer rows of buckets, clipping each row to the circle takes longer than it saves.
_FEW_ROWS = 128

# float32 keeps 24 bits: an area test on float32-rounded values (Autoware's) may move a border by half
# a unit in the last place, 2**-24 of its magnitude; twice that on the box and on the query side.
_ROUNDING = 2.0**-22

# The square of a shorter distance underflows to 0 in an area test.
_NO_DISTANCE = 1e-150

# Upper bound of the float64 rounding error of a row's border, relative to the magnitude of the grid.
_ROW_ROUNDING = 2.0**-45

# Extent to which wider cells are clipped for the mean.
_LARGEST = float(np.finfo(np.float64).max)

# Keys hold 31 bits per axis; wider extents get larger buckets.
_MAX_BUCKETS = 2**31 - 2


class GridFrame(NamedTuple):
    """Corner of a grid, size of its largest cell and of its buckets (metres), and number of buckets."""

    min_x: float
    min_y: float
    width: float
    height: float
    bucket_x: float
    bucket_y: float
    columns: int
    rows: int


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of similar size, sorted by the bucket of their min corner.

    Attributes
    ----------
    keys
        (N,) int64, ascending: ``iy << 32 | ix``.
    cells
        (N,) int32, the cell of each key: a row of the map's boxes.
    """

    frame: GridFrame
    keys: NDArray[np.int64]
    cells: NDArray[np.int32]

    @classmethod
    def of(cls, cells: Indices, boxes: Floats) -> Grid:
        """Return the grid of ``cells``, which are rows of ``boxes`` (N, 4)."""
        lows, highs, sizes = [], [], []
        for _, (min_x, min_y, max_x, max_y) in _blocks(cells, boxes):
            lows.append((min_x.min(), min_y.min()))
            highs.append((min_x.max(), min_y.max()))
            sizes.append(((max_x - min_x).max(), (max_y - min_y).max()))
        width, height = (float(size) for size in np.max(sizes, axis=0))
        low_x, low_y = (float(low) for low in np.min(lows, axis=0))
        high_x, high_y = (float(high) for high in np.max(highs, axis=0))
        larger = max(width, height) or 1.0
        bucket_x = max(width or larger, (high_x - low_x) / _MAX_BUCKETS)
        bucket_y = max(height or larger, (high_y - low_y) / _MAX_BUCKETS)
        keys = np.empty(len(cells), np.int64)
        columns, rows = [], []
        for block, (min_x, min_y, _, _) in _blocks(cells, boxes):
            ix = np.floor((min_x - low_x) / bucket_x).astype(np.int64)
            iy = np.floor((min_y - low_y) / bucket_y).astype(np.int64)
            columns.append(int(ix.max()) + 1)
            rows.append(int(iy.max()) + 1)
            keys[block] = iy << 32 | ix
        frame = GridFrame(low_x, low_y, width, height, bucket_x, bucket_y, max(columns), max(rows))
        order = np.argsort(keys, kind="stable")
        return cls(frame, keys[order], cells.astype(np.int32)[order])

    def runs(self, bounds: Bounds, slack: float, circle: Circle | None = None) -> tuple[Indices, Indices]:
        """Return begins and ends of the runs of `cells` whose box may touch an area.

        Parameters
        ----------
        bounds, slack
            Bounds of the area, and the distance by which rounding may move a border.
        circle
            The area, if it is a circle.  If it spans many rows, each row is clipped to the circle: the
            corners of its bounds may contain a whole map, and the circle no cell.
        """
        at, nothing = self.frame, np.empty(0, np.intp)
        x0 = (bounds[0] - slack - at.width - at.min_x) / at.bucket_x
        y0 = (bounds[1] - slack - at.height - at.min_y) / at.bucket_y
        x1 = (bounds[2] + slack - at.min_x) / at.bucket_x
        y1 = (bounds[3] + slack - at.min_y) / at.bucket_y
        if x1 < 0 or y1 < 0 or x0 >= at.columns or y0 >= at.rows:
            return nothing, nothing
        # clipped before the conversion: a finite area may reach 1e308, no integer does
        ix0, ix1 = math.floor(max(x0, 0.0)), math.floor(min(x1, at.columns - 1.0))
        iy0, iy1 = math.floor(max(y0, 0.0)), math.floor(min(y1, at.rows - 1.0))
        if (iy1 - iy0 + 1) * 8 > len(self.cells):
            return np.array([0]), np.array([len(self.cells)])
        first = np.arange(iy0 << 32, (iy1 + 1) << 32, 1 << 32, dtype=np.int64)
        if circle is None or len(first) <= _FEW_ROWS:
            begins, ends = self.keys.searchsorted(first + ix0), self.keys.searchsorted(first + (ix1 + 1))
            if circle is None or int((ends - begins).sum()) <= _CELLS_PER_BATCH:
                return begins, ends
        low, high = self._within(circle, slack, iy0, iy1)
        return self.keys.searchsorted(first + low), self.keys.searchsorted(first + high + 1)

    def _within(
        self, circle: Circle, slack: float, iy0: int, iy1: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first and last column of each row whose cells may touch a circle."""
        at = self.frame
        low_y = at.min_y + np.arange(iy0, iy1 + 1) * at.bucket_y
        rounding = _ROW_ROUNDING * max(abs(at.min_y), abs(at.min_y + at.rows * at.bucket_y), at.height)
        with np.errstate(over="ignore", invalid="ignore"):
            above = low_y - rounding - circle.y
            below = circle.y - (low_y + at.bucket_y + at.height + rounding)
            away = np.maximum(np.maximum(above, below), 0.0)
            radius = circle.radius + slack
            half = np.sqrt(np.maximum((radius - away) * (radius + away), 0.0))
            half[np.isnan(half)] = np.inf
            low = (circle.x - half - slack - at.width - at.min_x) / at.bucket_x
            high = (circle.x + half + slack - at.min_x) / at.bucket_x
        low, high = np.clip(low, 0.0, at.columns), np.clip(high, -1.0, at.columns - 1.0)
        return np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)


class MadeOfBoxes(NamedTuple):
    """Search structure computed once from the boxes.

    Attributes
    ----------
    grids
        Empty if there are few cells.
    bounds
        Box around all boxes, metres, map frame; None if there are no boxes.
    mean_size
        Mean extent of the boxes along x and y, metres.
    """

    grids: Sequence[Grid]
    bounds: Bounds | None
    mean_size: tuple[float, float]

    @classmethod
    def of(cls, boxes: Floats) -> MadeOfBoxes:
        """Compute the search structure of boxes, (N, 4)."""
        if not len(boxes):
            return cls((), None, (0.0, 0.0))
        low_x, low_y = boxes[:, :2].min(axis=0).tolist()
        high_x, high_y = boxes[:, 2:].max(axis=0).tolist()
        mean_x = mean_y = 0.0
        level = np.empty(len(boxes), np.int16)
        for block, (min_x, min_y, max_x, max_y) in _blocks(np.arange(len(boxes)), boxes):
            with np.errstate(over="ignore"):
                width, height = max_x - min_x, max_y - min_y
            mean_x += float((np.minimum(width, _LARGEST) / len(boxes)).sum())
            mean_y += float((np.minimum(height, _LARGEST) / len(boxes)).sum())
            level[block] = np.frexp(np.maximum(width, height))[1]
        grids: list[Grid] = []
        # limits the extent of a grid to finite numbers
        if len(boxes) > _LINEAR_CELLS and math.isfinite(high_x - low_x) and math.isfinite(high_y - low_y):
            levels = np.flatnonzero(np.bincount(level - level.min())) + level.min()
            grids = [Grid.of(np.flatnonzero(level == one), boxes) for one in levels]
        return cls(grids, (low_x, low_y, high_x, high_y), (min(mean_x, _LARGEST), min(mean_y, _LARGEST)))


class SpatialIndex:
    """Finds the boxes of a fixed set that touch an area.

    Parameters
    ----------
    boxes
        (N, 4) float64, ``min_x, min_y, max_x, max_y``, metres, map frame, finite, min <= max.
    made
        Search structure of the same boxes, if one exists already.
    """

    def __init__(self, boxes: Floats, made: MadeOfBoxes | None = None) -> None:
        # column-major: the exact test reads one coordinate of many cells at a time
        self.boxes: Floats = np.asfortranarray(boxes)
        self.made = MadeOfBoxes.of(self.boxes) if made is None else made

    def query(self, area: Area, most: int | None = None) -> Indices:
        """Return the rows of ``boxes`` that touch ``area`` (closed borders, z range ignored), ascending.

        If more than ``most`` boxes touch it, the result may be incomplete and unordered, but still has more
        than ``most`` rows: the time to find all grows with their number.
        """
        grids = self.made.grids
        if not grids:
            return np.flatnonzero(touches(area, self.boxes))
        min_x, min_y, max_x, max_y = area.bounds
        slack = max(_NO_DISTANCE, _ROUNDING * max(abs(min_x), abs(min_y), abs(max_x), abs(max_y)))
        found, count = [], 0
        for grid in grids:
            begins, ends = grid.runs(area.bounds, slack, area if isinstance(area, Circle) else None)
            for some in _candidates(grid.cells, begins, ends):
                found.append(some[touches(area, self.boxes.T.take(some, axis=1).T)])
                count += len(found[-1])
                if most is not None and count > most:
                    return np.concatenate(found).astype(np.intp)
        hit = np.concatenate(found).astype(np.intp) if found else np.empty(0, np.intp)
        hit.sort()
        return hit


def _candidates(cells: NDArray[np.int32], begins: Indices, ends: Indices) -> Iterator[NDArray[np.int32]]:
    """Yield the cells of runs, at most `_CELLS_PER_BATCH` at a time."""
    lengths = ends - begins
    total = int(lengths.sum())
    if total <= _CELLS_PER_BATCH:
        if total:
            pairs = zip(begins.tolist(), ends.tolist(), strict=True)
            yield np.concatenate([cells[i:j] for i, j in pairs])
        return
    before = np.cumsum(lengths) - lengths
    for first in range(0, total, _CELLS_PER_BATCH):
        places = np.arange(first, min(first + _CELLS_PER_BATCH, total))
        run = before.searchsorted(places, side="right") - 1
        yield cells[begins[run] + (places - before[run])]


def _blocks(cells: Indices, boxes: Floats) -> Iterator[tuple[slice, Floats]]:
    """Yield the columns of rows ``cells`` of boxes in batches, so that no array is as long as the map."""
    for begin in range(0, len(cells), _CELLS_PER_BATCH):
        block = slice(begin, begin + _CELLS_PER_BATCH)
        yield block, boxes.T.take(cells[block], axis=1)


def touches(area: Area, boxes: Floats) -> NDArray[np.bool_]:
    """Return which of the boxes, (N, 4), touch an area; (N,) bool."""
    # squares of distances beyond 1e154 m overflow to infinity, which compares correctly
    with np.errstate(over="ignore"):
        return area.overlaps(boxes)
