# SPDX-License-Identifier: Apache-2.0
"""Which cells a viewer sees, each in how much detail; without any I/O.

A cell is shown as its layer ``voxel`` of one of a few leaves: the one that covers about two pixels where the
cell is nearest.  All cells together have a number of points that a browser draws and a network carries; where
more would be needed, every leaf is made coarser by the same factor.  A move of the eye changes only the cells
that need another leaf; a little more or less than needed changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import distance_to_boxes

LEAVES: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Edges of voxels, metres; a *level* is an index of these."""
NOT_SHOWN: Final = -1
"""Level of a cell that is not shown."""
MAX_CELLS: Final = 3000
"""Cells shown at a time, the nearest: each is a node of the browser's scene."""

_PIXELS: Final = 2.0  # a voxel covers about this many where it is nearest
_NEAREST_M: Final = (
    0.03  # what is nearest becomes coarser only where leaves are three times what they should be
)
_SLACK: Final = 1.3  # a level stays while its leaf differs by less from what another one is chosen at
_STEP: Final = 1.25  # factor between two coarsenesses
_ROOM: Final = 0.7  # leaves become finer again when this share of the points would do
_COARSEST: Final = _STEP**24
_VOXELS: Final = 1.5  # voxels per leaf^2 of a cell's area, until cells of a level are known
_SOURCE_BYTES: Final = 12  # of a point in its file, at least


def layer_of(level: int) -> str:
    """Return the layer of a level."""
    return f"voxel(leaf={LEAVES[level]})"


@dataclass(frozen=True)
class Eye:
    """Where one looks from, metres, map frame; and the angle of one pixel, radians."""

    x: float
    y: float
    z: float
    pixel: float = 1.6e-3


class Sizes:
    """Numbers of points of cells by level: known, or estimated from those of other cells.

    Parameters
    ----------
    boxes
        (N, 4): min_x, min_y, max_x, max_y, metres.
    source_bytes
        (N,): sizes of the cells' files; compressed files may have more points than this says.
    """

    def __init__(self, boxes: NDArray[np.float64], source_bytes: NDArray[np.float64]) -> None:
        areas = np.maximum((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1]), 1e-6)
        self._most = np.maximum(source_bytes / _SOURCE_BYTES, 1.0)
        self._voxels = areas[:, None] / np.square(LEAVES)
        self._known = np.full((len(boxes), len(LEAVES)), np.nan)
        self._sums = np.zeros((2, len(LEAVES)))  # of points, and of what they would be at one a square

    def note(self, cell: int, level: int, points: int) -> None:
        """Note how many points a level of a cell has."""
        if np.isnan(self._known[cell, level]):
            self._sums[:, level] += points, min(self._voxels[cell, level], self._most[cell])
        self._known[cell, level] = points

    def points(self, cells: NDArray[np.intp], levels: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the numbers of points of cells at a level each, (M,)."""
        points, squares = self._sums
        ratios = np.where(squares > 0.0, points / np.maximum(squares, 1e-9), _VOXELS)
        estimated = np.minimum(self._voxels[cells, levels], self._most[cells]) * ratios[levels]
        known = self._known[cells, levels]
        found: NDArray[np.float64] = np.where(np.isnan(known), estimated, known)
        return found


@dataclass(frozen=True)
class Choice:
    """What is to be seen.

    Attributes
    ----------
    levels
        (N,) of every cell of the map; `NOT_SHOWN` for most.
    order
        The cells that are shown, the nearest first.
    coarseness
        Factor by which leaves are larger than two pixels.
    """

    levels: NDArray[np.int8]
    order: NDArray[np.intp]
    coarseness: float = 1.0


def choose(
    eye: Eye,
    boxes: NDArray[np.float64],
    z: NDArray[np.float64],
    sizes: Sizes,
    most_points: float,
    before: Choice | None = None,
) -> Choice:
    """Choose the level of each cell for an eye.

    Parameters
    ----------
    boxes, z
        (N, 4) and (N, 2): min_x, min_y, max_x, max_y; lowest and highest z, NaN where not known; metres.
    most_points
        Points of all cells together.
    before
        The last choice: levels that still do are kept.
    """
    levels = np.full(len(boxes), NOT_SHOWN, np.int8)
    distances = _distances(eye, boxes, z)
    order = np.argsort(distances, kind="stable")[:MAX_CELLS]
    needed = np.maximum(distances[order] * eye.pixel * _PIXELS, _NEAREST_M)
    old = before.levels[order].astype(np.intp) if before is not None else None
    coarseness = before.coarseness if before is not None else 1.0

    def total(factor: float) -> float:
        return float(sizes.points(order, _levels(needed * factor, old)).sum())

    while coarseness < _COARSEST and total(coarseness) > most_points:
        coarseness *= _STEP
    while coarseness > 1.0 and total(coarseness / _STEP) <= _ROOM * most_points:
        coarseness = max(1.0, coarseness / _STEP)
    chosen = _levels(needed * coarseness, old)
    fitting = int(np.searchsorted(sizes.points(order, chosen).cumsum(), most_points, side="right"))
    order, chosen = order[: max(fitting, 1)], chosen[: max(fitting, 1)]
    levels[order] = chosen
    return Choice(levels, order, coarseness)


def _distances(eye: Eye, boxes: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far cells are, (N,) metres; unknown heights count as the eye's own."""
    low, high = np.nan_to_num(z[:, 0], nan=eye.z), np.nan_to_num(z[:, 1], nan=eye.z)
    up = np.maximum(np.maximum(low - eye.z, eye.z - high), 0.0)
    return np.hypot(distance_to_boxes(eye.x, eye.y, boxes), up)


def _levels(needed: NDArray[np.float64], old: NDArray[np.intp] | None) -> NDArray[np.intp]:
    """Return the largest leaf that is not larger than needed; the old one where it nearly is that."""
    level = _level(needed)
    if old is None:
        return level
    keeps = (old != NOT_SHOWN) & (_level(needed / _SLACK) <= old) & (old <= _level(needed * _SLACK))
    return np.where(keeps, old, level)


def _level(needed: NDArray[np.float64]) -> NDArray[np.intp]:
    return np.maximum(np.searchsorted(LEAVES, needed * (1 + 1e-9), side="right") - 1, 0)


@dataclass(frozen=True)
class Changes:
    """What differs between what is shown and what is to be seen.

    Attributes
    ----------
    gone
        Cells that are not to be seen any more.
    wanted
        Cells to fetch, with the level of each; the nearest first.
    """

    gone: list[int] = field(default_factory=list)
    wanted: list[tuple[int, int]] = field(default_factory=list)


def changes(shown: dict[int, tuple[int, int]], choice: Choice, versions: NDArray[np.uint64]) -> Changes:
    """Return the difference between what is shown and a choice.

    Parameters
    ----------
    shown
        By cell: the level, and the cell's version in the map's list at the time.
    versions
        (N,): the versions in the map's list now.
    """
    levels = choice.levels
    gone = [cell for cell in shown if levels[cell] == NOT_SHOWN]
    wanted = [
        (cell, level)
        for cell, level, version in zip(
            choice.order.tolist(), levels[choice.order].tolist(), versions[choice.order].tolist(), strict=True
        )
        if shown.get(cell) != (level, version)
    ]
    return Changes(gone, wanted)


def pixel_angle(field_of_view: float, height: int) -> float:
    """Return the angle of a pixel, radians, in the middle of a picture; the field is the vertical one."""
    return 2.0 * math.tan(min(max(field_of_view, 0.1), 3.0) / 2.0) / max(height, 100)
