# SPDX-License-Identifier: Apache-2.0
"""Heights on a ground grid in a file: only the pages in use are in memory."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.elevation_map import holes

NOTHING, MEASURED, FILLED = range(3)
_NAN_BITS: Final = np.float32(np.nan).view(np.uint32)
_LONGEST_SIDE: Final = 1 << 20  # columns: 100 km of 0.1 m
_BLOCK_BYTES: Final = 1 << 18


@dataclass(frozen=True, slots=True)
class ElevationGrid:
    """A grid of heights; row 0 is the southernmost, column 0 the westernmost.

    The file holds the bits of float32, xor the bits of NaN.  So the holes of a sparse file, which read as
    zeros, are columns without a height.

    Attributes
    ----------
    path
        The file.
    resolution
        Edge of a column, metres.
    first
        Index i, j of column [0, 0], whose corner is i · resolution, j · resolution.
    shape
        Rows and columns.
    boxes
        (N, 4) int64: i0, j0, i1, j1 (exclusive) of the ranges of columns that may have heights, any order,
        indices from the map's origin; None: all.  Columns outside cost next to nothing.
    """

    path: Path
    resolution: float
    first: tuple[int, int]
    shape: tuple[int, int]
    boxes: NDArray[np.int64] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def create(
        cls, path: Path, resolution: float, first: tuple[int, int], shape: tuple[int, int]
    ) -> ElevationGrid:
        """Create the file without heights; it occupies no disk space yet.

        Raises
        ------
        BadRequest
            The grid is implausibly large.
        """
        if max(shape) > _LONGEST_SIDE:
            raise BadRequest(
                f"an elevation map of {shape[1]} x {shape[0]} columns of {resolution:g} m is too large",
                hint="use a coarser resolution; or cells of the map lie far from the others",
            )
        with open(path, "wb") as file:
            file.truncate(4 * shape[0] * shape[1])
        return cls(path, resolution, first, shape)

    @property
    def origin(self) -> tuple[float, float]:
        """South-west corner of column [0, 0], metres, map frame."""
        return self.first[0] * self.resolution, self.first[1] * self.resolution

    @property
    def block_rows(self) -> int:
        """Number of rows best read at a time."""
        return max(1, _BLOCK_BYTES // (4 * max(1, self.shape[1])))

    def put(self, i: NDArray[np.int64], j: NDArray[np.int64], heights: NDArray[np.floating]) -> None:
        """Write heights of columns (indices from the map's origin); NaN means no height."""
        rows, columns = j - self.first[1], i - self.first[0]
        bits = heights.astype(np.float32).view(np.uint32) ^ _NAN_BITS
        bits[np.isnan(heights)] = 0
        with open(self.path, "r+b") as file:
            low, high = int(rows.min()), int(rows.max()) + 1
            left, right = int(columns.min()), int(columns.max()) + 1
            # one block of the touched rows at a time; pread and pwrite map no pages into this process
            block = np.zeros((high - low, right - left), np.uint32)
            for row in range(low, high):
                at = 4 * (row * self.shape[1] + left)
                block[row - low] = np.frombuffer(os.pread(file.fileno(), 4 * (right - left), at), np.uint32)
            block[rows - low, columns - left] = bits
            for row in range(low, high):
                os.pwrite(file.fileno(), block[row - low].tobytes(), 4 * (row * self.shape[1] + left))

    def rows(self, begin: int, end: int, left: int = 0, right: int | None = None) -> NDArray[np.float32]:
        """Return rows ``begin`` to ``end``, columns ``left`` to ``right`` (None: the last), (n, m) float32.

        Columns outside the grid or without a height are NaN.
        """
        right = self.shape[1] if right is None else right
        result = np.full((end - begin, right - left), np.nan, np.float32)
        west, east = max(left, 0), min(right, self.shape[1])
        if west < east:
            with open(self.path, "rb") as file:
                for row in range(max(begin, 0), min(end, self.shape[0])):
                    place = 4 * (row * self.shape[1] + west)
                    bits = np.frombuffer(os.pread(file.fileno(), 4 * (east - west), place), np.uint32)
                    result[row - begin, west - left : east - left] = (bits ^ _NAN_BITS).view(np.float32)
        return result

    def filled(
        self,
        begin: int,
        end: int,
        fill_radius: float,
        margin: int = 0,
        *,
        left: int = 0,
        right: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Return rows with holes filled, and the kind of each value.

        Parameters
        ----------
        begin, end
            Rows.
        fill_radius
            See `fill_holes`, metres; 0: nothing is filled.
        margin
            Number of additional rows on both sides.
        left, right
            Columns; None: to the last.

        Returns
        -------
        (n, m) float32 metres, and (n, m) uint8: `NOTHING`, `MEASURED` or `FILLED`.
        """
        right = self.shape[1] if right is None else right
        heights = np.full((end - begin + 2 * margin, right - left), np.nan, np.float32)
        kind = np.full(heights.shape, NOTHING, np.uint8)
        for west, east in self._spans(begin - margin, end + margin, left, right, fill_radius):
            part = np.s_[:, west - left : east - left]
            heights[part], kind[part] = self._filled(begin, end, fill_radius, margin, west, east)
        return heights, kind

    def _spans(
        self, begin: int, end: int, left: int, right: int, fill_radius: float
    ) -> list[tuple[int, int]]:
        """Return ranges of columns that may have heights or filled holes in some rows, from west to east."""
        if self.boxes is None:
            return [(left, right)]
        reach = math.ceil(fill_radius / self.resolution)
        i0, j0, i1, j1 = self.boxes.T - np.array([*self.first, *self.first])[:, None]
        here = (j0 - reach < end) & (j1 + reach > begin)
        low = np.maximum(i0[here] - reach, left)
        high = np.minimum(i1[here] + reach, right)
        spans: list[tuple[int, int]] = []
        for west, east in sorted(zip(low.tolist(), high.tolist(), strict=True)):
            if spans and west <= spans[-1][1]:
                spans[-1] = (spans[-1][0], max(east, spans[-1][1]))
            elif west < east:
                spans.append((west, east))
        return spans

    def _filled(
        self, begin: int, end: int, fill_radius: float, margin: int, left: int, right: int
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        radius = round(fill_radius / self.resolution, 6)  # so that 0.6 / 0.2 is exactly three columns
        reach = holes.fill_reach(radius)
        around = self.rows(begin - margin - reach, end + margin + reach, left - reach, right + reach)
        inner = (slice(reach, around.shape[0] - reach), slice(reach, around.shape[1] - reach))
        heights = around[inner]
        kind = np.where(np.isnan(heights), NOTHING, MEASURED).astype(np.uint8)
        if reach:
            heights = holes.fill_holes(around, radius)[inner]
            # nothing is filled beyond the grid
            row, column = np.arange(begin - margin, end + margin), np.arange(left, right)
            heights[(row < 0) | (row >= self.shape[0])] = np.nan
            heights[:, (column < 0) | (column >= self.shape[1])] = np.nan
            kind[(kind == NOTHING) & ~np.isnan(heights)] = FILLED
        return heights, kind

    def blocks(
        self, fill_radius: float, *, from_north: bool = False, margin: int = 0
    ) -> Iterator[tuple[int, NDArray[np.float32], NDArray[np.uint8]]]:
        """Yield blocks of rows: number of the first row, heights and kinds as in `filled`.

        If from the north, blocks and the rows within each are in this order.
        """
        starts = range(0, self.shape[0], self.block_rows)
        for begin in reversed(starts) if from_north else starts:
            end = min(begin + self.block_rows, self.shape[0])
            heights, kind = self.filled(begin, end, fill_radius, margin)
            yield (begin, heights[::-1], kind[::-1]) if from_north else (begin, heights, kind)
