# SPDX-License-Identifier: Apache-2.0
"""Which cells touch an area, in time that does not grow with the number of cells.

Every cell is filed under the bucket ``floor(min corner / bucket size)`` of a grid whose buckets are
as large as the largest cell; the buckets are sorted integer keys ``iy << 32 | ix``.  A cell that
touches a query has its min corner at most one cell size before the query's, so each bucket row holds
its candidates in one contiguous run that two binary searches find.  The area's exact test then runs
on the candidates.  Cells need not form a lattice.  Cells of very different sizes go into several such
grids, one per power of two, so that one huge cell does not widen the search for all others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area

__all__ = ["SpatialIndex", "touches"]

Indices = NDArray[np.intp]
Floats = NDArray[np.float64]

# Below this many cells the exact test on all of them is faster than any search.
_LINEAR_CELLS = 5000

# Candidates that are tested at a time where it is enough to know that very many touch an area.
_AT_ONCE = 1 << 15

# float32 keeps 24 bits: an area test on float32-rounded values (Autoware's) may move a border by half
# a unit in the last place, 2**-24 of its magnitude; twice that on the box and on the query side.
_ROUNDING = 2.0**-22

# Keys hold 31 bits per axis; wider extents get larger buckets.
_MAX_BUCKETS = 2**31 - 2


class _Grid:
    """Cells of similar size, sorted by the bucket of their min corner.

    Parameters
    ----------
    cells
        Rows of ``boxes``, (N, 4), all of the map's.
    """

    def __init__(self, cells: Indices, boxes: Floats) -> None:
        lows, highs, sizes = [], [], []
        for _, (min_x, min_y, max_x, max_y) in _blocks(cells, boxes):
            lows.append((min_x.min(), min_y.min()))
            highs.append((min_x.max(), min_y.max()))
            sizes.append(((max_x - min_x).max(), (max_y - min_y).max()))
        self._width, self._height = (float(size) for size in np.max(sizes, axis=0))
        self._min_x, self._min_y = (float(low) for low in np.min(lows, axis=0))
        high_x, high_y = (float(high) for high in np.max(highs, axis=0))
        larger = max(self._width, self._height) or 1.0
        self._bucket_x = max(self._width or larger, (high_x - self._min_x) / _MAX_BUCKETS)
        self._bucket_y = max(self._height or larger, (high_y - self._min_y) / _MAX_BUCKETS)
        keys = np.empty(len(cells), np.int64)
        columns, rows = [], []
        for block, (min_x, min_y, _, _) in _blocks(cells, boxes):
            ix = np.floor((min_x - self._min_x) / self._bucket_x).astype(np.int64)
            iy = np.floor((min_y - self._min_y) / self._bucket_y).astype(np.int64)
            columns.append(int(ix.max()) + 1)
            rows.append(int(iy.max()) + 1)
            keys[block] = iy << 32 | ix
        self._columns, self._rows = max(columns), max(rows)
        order = np.argsort(keys, kind="stable")
        self._keys = keys[order]
        self._cells = cells[order]

    @property
    def nbytes(self) -> int:
        return int(self._keys.nbytes + self._cells.nbytes)

    def candidates(self, bounds: tuple[float, float, float, float]) -> Indices:
        """Cells whose box may touch ``bounds``, unordered; all of the grid's if that is about as quick."""
        x0 = (bounds[0] - self._width - self._min_x) / self._bucket_x
        y0 = (bounds[1] - self._height - self._min_y) / self._bucket_y
        x1 = (bounds[2] - self._min_x) / self._bucket_x
        y1 = (bounds[3] - self._min_y) / self._bucket_y
        if x1 < 0 or y1 < 0 or x0 >= self._columns or y0 >= self._rows:
            return self._cells[:0]
        # clipped before the conversion: a finite area may reach 1e308, no integer does
        ix0, ix1 = math.floor(max(x0, 0.0)), math.floor(min(x1, self._columns - 1.0))
        iy0, iy1 = math.floor(max(y0, 0.0)), math.floor(min(y1, self._rows - 1.0))
        if (iy1 - iy0 + 1) * 8 > len(self._cells):
            return self._cells
        rows = np.arange(iy0 << 32, (iy1 + 1) << 32, 1 << 32, dtype=np.int64)
        starts = self._keys.searchsorted(rows + ix0).tolist()
        stops = self._keys.searchsorted(rows + (ix1 + 1)).tolist()
        cells = self._cells
        return np.concatenate([cells[i:j] for i, j in zip(starts, stops, strict=True)])


class SpatialIndex:
    """Answers which of a fixed set of boxes touch an area.

    Parameters
    ----------
    boxes
        (N, 4) float64, ``min_x, min_y, max_x, max_y``, metres, map frame, finite, min <= max.
    """

    def __init__(self, boxes: Floats) -> None:
        # column-major: the exact test reads one coordinate of many cells at a time
        self.boxes: Floats = np.asfortranarray(boxes)
        self._grids: list[_Grid] = []
        if len(boxes) > _LINEAR_CELLS and _has_extent(boxes):
            level = np.empty(len(boxes), np.int16)
            for block, (min_x, min_y, max_x, max_y) in _blocks(np.arange(len(boxes)), self.boxes):
                level[block] = np.frexp(np.maximum(max_x - min_x, max_y - min_y))[1]
            for exponent in np.unique(level):
                self._grids.append(_Grid(np.flatnonzero(level == exponent), self.boxes))

    @cached_property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all boxes, metres, map frame; None where there are none."""
        if not len(self.boxes):
            return None
        min_x, min_y = self.boxes[:, :2].min(axis=0).tolist()
        max_x, max_y = self.boxes[:, 2:].max(axis=0).tolist()
        return min_x, min_y, max_x, max_y

    @cached_property
    def mean_size(self) -> tuple[float, float]:
        """Mean extent of the boxes along x and y, metres."""
        if not len(self.boxes):
            return 0.0, 0.0
        min_x, min_y, max_x, max_y = self.boxes.T
        return float((max_x - min_x).mean()), float((max_y - min_y).mean())

    @property
    def nbytes(self) -> int:
        """Memory of the boxes and the search structure."""
        return int(self.boxes.nbytes) + sum(grid.nbytes for grid in self._grids)

    def query(self, area: Area, most: int | None = None) -> Indices:
        """Rows of ``boxes`` that touch ``area`` (closed borders, its z range ignored), ascending.

        If there are more than ``most``, some of them, more than ``most``, in no order: to find all takes
        time that grows with their number.
        """
        if not self._grids:
            return np.flatnonzero(touches(area, self.boxes))
        min_x, min_y, max_x, max_y = area.bounds
        slack = _ROUNDING * max(abs(min_x), abs(min_y), abs(max_x), abs(max_y))
        bounds = (min_x - slack, min_y - slack, max_x + slack, max_y + slack)
        found = [grid.candidates(bounds) for grid in self._grids]
        candidates = found[0] if len(found) == 1 else np.concatenate(found)
        if most is not None and len(candidates) > _AT_ONCE:
            hit = self._touching(area, candidates, most)
            if len(hit) > most:
                return hit
        else:
            hit = candidates[touches(area, self.boxes.T.take(candidates, axis=1).T)]
        hit.sort()
        return hit

    def _touching(self, area: Area, candidates: Indices, most: int) -> Indices:
        """Those of many candidates that touch an area, until they are more than ``most``."""
        found, count = [], 0
        for begin in range(0, len(candidates), _AT_ONCE):
            some = candidates[begin : begin + _AT_ONCE]
            found.append(some[touches(area, self.boxes.T.take(some, axis=1).T)])
            count += len(found[-1])
            if count > most:
                break
        return np.concatenate(found)


def _blocks(cells: Indices, boxes: Floats) -> Iterator[tuple[slice, Floats]]:
    """Return the columns of rows ``cells`` of boxes, some at a time: nothing as long as the map is made."""
    for begin in range(0, len(cells), _AT_ONCE):
        block = slice(begin, begin + _AT_ONCE)
        yield block, boxes.T.take(cells[block], axis=1)


def _has_extent(boxes: Floats) -> bool:
    """Whether a number says how far the outermost corners are apart: no grid spans more."""
    with np.errstate(over="ignore"):
        return bool(np.isfinite(boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)).all())


def touches(area: Area, boxes: Floats) -> NDArray[np.bool_]:
    """Which of boxes, (N, 4), touch an area; (N,) bool."""
    # squares of distances beyond 1e154 m overflow to infinity, which compares as it should
    with np.errstate(over="ignore"):
        return area.overlaps(boxes)
