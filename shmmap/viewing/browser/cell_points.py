# SPDX-License-Identifier: Apache-2.0
"""Cells as a browser draws them: colours, and coordinates about a centre of their own.

A point is 9 bytes: three float16 and a colour.  float16 has 11 bits, so a block of points reaches from its
centre only so far that these resolve a fraction of a leaf.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Box
from shmmap.viewing.page import HEIGHT, HEIGHT_COLOURS, SHARES, VALUE_COLOURS
from shmmap.viewing.rendering import GroundGrid, Surface
from shmmap.viewing.sources import BoxTuple

POINT_BYTES: Final = 9
BLOCK_BYTES: Final = 1024
"""What the message of a block takes besides its points, about."""

_REACH: Final = 128.0  # leaves from the centre of a block: there a step of float16 is an eighth of one
_BLOCK_POINTS: Final = 150_000  # a browser that takes a message does nothing else
_KEPT: Final = 1000  # points of a cell that its ground is found by
_AROUND_M: Final = 30.0  # ground beside a cell that is looked at
_BESIDE_M: Final = 4.0  # ground beside a place
_SETTLED: Final = (1, 4, 16, 64)  # numbers of cells after which the ends of the colours are looked at
_ALIKE: Final = 0.15  # of their span: ends that differ by less stay
_LOW: Final = 20.0  # percentile of the heights around a place

Points = NDArray[np.float64]


class Block(NamedTuple):
    """Points about a centre (metres, map frame): (N, 3) float16 and (N, 3) uint8."""

    centre: tuple[float, float, float]
    points: NDArray[np.float16]
    colours: NDArray[np.uint8]


def blocks(xyz: Points, colours: NDArray[np.uint8], leaf: float) -> Iterator[Block]:
    """Divide points, (N, 3) metres in the map frame, into blocks."""
    if not len(xyz):
        return
    low, span = xyz.min(axis=0), np.maximum(np.ptp(xyz, axis=0), 1e-3)
    side = 2.0 * _REACH * leaf
    if len(xyz) > _BLOCK_POINTS:
        side = min(side, float(np.sqrt(span[0] * span[1] * _BLOCK_POINTS / len(xyz))))
    counts = np.ceil(span / side).astype(np.int64)
    sides = span / counts
    place = np.minimum(((xyz - low) / sides).astype(np.int64), counts - 1)
    number = (place[:, 2] * counts[1] + place[:, 1]) * counts[0] + place[:, 0]
    order = np.argsort(number, kind="stable")
    borders = np.flatnonzero(np.diff(number[order], prepend=-1, append=-1))
    for first, last in pairwise(borders.tolist()):
        rows = order[first:last]
        part = xyz[rows]
        centre = (part.min(axis=0) + part.max(axis=0)) / 2.0
        x, y, z = centre.tolist()
        yield Block((x, y, z), (part - centre).astype(np.float16), colours[rows])


class Ground:
    """Heights of the ground, from points of the cells seen so far."""

    def __init__(self) -> None:
        self._points: dict[int, Points] = {}
        self._boxes: dict[int, BoxTuple] = {}

    def add(self, cell: int, xyz: Points) -> None:
        """Add a cell's points, or replace them."""
        some = xyz[:: max(1, -(-len(xyz) // _KEPT))]
        if len(some):
            self._points[cell] = some
            (min_x, min_y), (max_x, max_y) = some[:, :2].min(axis=0), some[:, :2].max(axis=0)
            self._boxes[cell] = float(min_x), float(min_y), float(max_x), float(max_y)

    def forget(self) -> None:
        """Forget all cells: their numbers mean other cells now."""
        self._points.clear()
        self._boxes.clear()

    def surface(self, box: BoxTuple) -> Surface | None:
        """Return the ground of an area; None where no point is known."""
        wide = (box[0] - _AROUND_M, box[1] - _AROUND_M, box[2] + _AROUND_M, box[3] + _AROUND_M)
        near = self._near(wide)
        if near is None:
            return None
        grid = GroundGrid(wide)
        grid.add(*near.T)
        return grid.surface()

    def _near(self, box: BoxTuple) -> Points | None:
        """Return the points that are kept of an area, (N, 3); None if there are none."""
        boxes = np.array(list(self._boxes.values())).reshape(-1, 4)
        cells = [cell for cell, near in zip(self._boxes, Box(*box).overlaps(boxes), strict=True) if near]
        if not cells:
            return None
        xyz = np.concatenate([self._points[cell] for cell in cells])
        x, y = xyz[:, 0], xyz[:, 1]
        xyz = xyz[(x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])]
        return xyz if len(xyz) else None

    def height(self, x: float, y: float, unknown: float) -> float:
        """Return about the height of the ground at a place, metres; ``unknown`` where no point is known."""
        near = self._near((x - _BESIDE_M, y - _BESIDE_M, x + _BESIDE_M, y + _BESIDE_M))
        if near is None:
            return unknown
        return float(np.percentile(near[:, 2], _LOW))


class Colours:
    """Colours of points, as in a picture.  What they mean is settled by the first cells.

    Attributes
    ----------
    by
        `shmmap.viewing.page.HEIGHT`, ``"z"``, or a column.
    low, high
        Values at the ends of the colours; equal until the first points.
    """

    def __init__(self, by: str) -> None:
        self.by = by
        self.low = self.high = 0.0
        self._seen: list[NDArray[np.float64]] = []
        self._cells = 0
        self.ramp = HEIGHT_COLOURS if by == HEIGHT else VALUE_COLOURS

    @property
    def column(self) -> str:
        """The column whose values are needed; empty if it is none."""
        return "" if self.by in (HEIGHT, "z") else self.by

    def values(
        self, xyz: Points, column: NDArray[Any] | None, surface: Surface | None
    ) -> NDArray[np.float64]:
        """Return what the colours mean for each point, (N,)."""
        if column is not None:
            return column.astype(np.float64)
        ground = surface.at(xyz[:, 0], xyz[:, 1]) if surface is not None and self.by == HEIGHT else 0.0
        above: NDArray[np.float64] = xyz[:, 2] - ground
        return above

    def settle(self, values: NDArray[np.float64]) -> bool:
        """Take the ends of the colours from the first cells; return whether they have changed much."""
        seen = values[np.isfinite(values)]
        if self._cells >= _SETTLED[-1] or not len(seen):
            return False
        self._cells += 1
        self._seen.append(seen[:: max(1, -(-len(seen) // _KEPT))])
        if self._cells not in _SETTLED:
            return False
        low, high = np.percentile(np.concatenate(self._seen), SHARES).tolist()
        if self.by == HEIGHT:
            low, high = 0.0, max(high, 1.0)
        high = max(high, low + 1e-6 * max(abs(low), 1.0))
        if max(abs(low - self.low), abs(high - self.high)) <= _ALIKE * (self.high - self.low):
            return False
        self.low, self.high = low, high
        return True

    def of(self, values: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the colours of values, (N, 3)."""
        return self.ramp.colours((values - self.low) / max(self.high - self.low, 1e-9)).astype(np.uint8)
