# SPDX-License-Identifier: Apache-2.0
r"""Rules by which the map explains a point: Autoware's three rules, and their layers.

The rules are those of autoware_compare_map_segmentation, in float64 and across cell borders:

``voxel``
    A voxel of d x d x d·ratio, the point's own or one of the 26 around it, has a centroid c with
    \|c - p\| < d along x, < d along y and < d·ratio along z.  A voxel on the border of two cells
    has a centroid in each cell, and either counts.  (No other voxel can have a centroid that near, so the
    rule is that such a centroid exists.)
``voxel-distance``
    The point's own voxel contains a map point, or a map point lies within d.
``distance``
    A map point lies within d (Euclidean, closed).

A point that is not finite is never explained.  `explain` is the comparison in numpy, for machines without
numba, and as a reference for the compiled kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest
from shmmap_clients.compare_map_filter.search_table import TILE_COLUMNS, SearchCell, SearchTable

MODES: Final = ("voxel", "voxel-distance", "distance")
VOXEL, VOXEL_DISTANCE, DISTANCE = range(3)
SLACK: Final = 1e-6
"""Margin of the search for candidates, metres, against rounding; the rule itself decides."""
_PAIRS: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class CompareRule:
    """A rule and its distances.

    Attributes
    ----------
    mode
        ``voxel``, ``voxel-distance`` or ``distance``.
    distance
        d, metres (Autoware's ``distance_threshold``).
    z_ratio
        Height of a voxel over d (``downsize_ratio_z_axis``); ignored by ``distance``.

    Raises
    ------
    BadRequest
        The mode is unknown or a number is not positive.
    """

    mode: str = "voxel"
    distance: float = 0.5
    z_ratio: float = 0.5

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise BadRequest(f"compare mode {self.mode!r} is unknown", hint=f"use one of {', '.join(MODES)}")
        if not (math.isfinite(self.distance) and self.distance > 0):
            raise BadRequest(f"the distance must be positive, not {self.distance!r} m")
        if not (math.isfinite(self.z_ratio) and self.z_ratio > 0):
            raise BadRequest(f"the z ratio must be positive, not {self.z_ratio!r}")

    @property
    def code(self) -> int:
        """The mode as a number, for kernels."""
        return MODES.index(self.mode)

    @property
    def distance_z(self) -> float:
        """Height of a voxel, metres."""
        return self.distance * self.z_ratio

    @property
    def layer(self) -> str:
        """Layer for this rule; see `shmmap.layers.ground`."""
        d = self.distance
        if self.mode == "voxel":
            return f"search(leaf={d!r},of=voxel(leaf_x={d!r},leaf_y={d!r},leaf_z={self.distance_z!r}))"
        return f"search(leaf={d!r})"


def to_map(points: NDArray[Any], T_map_sensor: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a scan's points, (N, 3) float64, in the map frame, with the compiled kernel's order of sums."""
    x, y, z = (points[:, axis].astype(np.float64) for axis in range(3))
    T = T_map_sensor
    return np.stack([T[row, 0] * x + T[row, 1] * y + T[row, 2] * z + T[row, 3] for row in range(3)], axis=1)


def explain(
    points: NDArray[Any], T_map_sensor: NDArray[np.float64], rule: CompareRule, table: SearchTable
) -> NDArray[np.bool_]:
    """Return for each point whether the map explains it.

    Parameters
    ----------
    points
        (N, 3) float32 or float64, sensor frame, metres.
    T_map_sensor
        (4, 4) float64.
    rule, table
        Rule, and table of the cells.

    Returns
    -------
    (N,) bool; False for points that are not finite.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        places = to_map(points, T_map_sensor)
        good = np.flatnonzero(
            (np.abs(places[:, 0]) < 1e9) & (np.abs(places[:, 1]) < 1e9) & np.isfinite(places[:, 2])
        )
    explained = np.zeros(len(points), np.bool_)
    for cell in table.cells:
        left = good[~explained[good]]
        explained[left] = _explained_by(cell, places[left], rule)
    return explained


def _explained_by(cell: SearchCell, places: NDArray[np.float64], rule: CompareRule) -> NDArray[np.bool_]:
    inverse, reach = 1.0 / cell.leaf, rule.distance + SLACK
    low, high, own = (
        np.floor((places[:, :2] + by) * inverse).astype(np.int64) for by in (-reach, reach, 0.0)
    )
    low, high = np.maximum(low, cell.first), np.minimum(high, np.array(cell.columns_end) - 1)
    near = np.flatnonzero((low <= high).all(axis=1))
    explained = np.zeros(len(places), np.bool_)
    if not len(near):
        return explained
    sides = high[near] - low[near]
    for y in range(int(sides[:, 1].max()) + 1):
        for x in range(int(sides[:, 0].max()) + 1):
            column = low[near] + (x, y)
            some = near[(column <= high[near]).all(axis=1)]
            some = some[~explained[some]]
            explained[some] = _in_column(cell, places[some], low[some] + (x, y), own[some], rule)
    return explained


def _in_column(
    cell: SearchCell,
    places: NDArray[np.float64],
    column: NDArray[np.int64],
    own: NDArray[np.int64],
    rule: CompareRule,
) -> NDArray[np.bool_]:
    """Return whether each position is explained by a point of its given column."""
    right, up = (column - np.array(cell.first)).T
    tile = cell.tile[up // TILE_COLUMNS, right // TILE_COLUMNS].astype(np.int64)
    at = tile * TILE_COLUMNS**2 + up % TILE_COLUMNS * TILE_COLUMNS + right % TILE_COLUMNS
    begin = np.where(tile >= 0, cell.start[np.maximum(at, 0)], 0).astype(np.int64)
    count = np.where(tile >= 0, cell.start[np.maximum(at, 0) + 1] - begin, 0)
    explained = np.zeros(len(places), np.bool_)
    which = np.flatnonzero(count)
    ends = np.cumsum(count[which])
    first = 0
    while first < len(which):  # all pairs of position and point, a million at a time
        before = int(ends[first - 1]) if first else 0
        last = max(int(np.searchsorted(ends, before + _PAIRS, side="right")), first + 1)
        part = which[first:last]
        place = np.repeat(part, count[part])
        steps = np.arange(len(place)) - np.repeat(ends[first:last] - count[part] - before, count[part])
        row = np.repeat(begin[part], count[part]) + steps
        away = cell.xyz[row].astype(np.float64) - places[place]
        if rule.code == VOXEL:
            hit = (np.abs(away[:, :2]) < rule.distance).all(axis=1) & (np.abs(away[:, 2]) < rule.distance_z)
        else:
            squares = away[:, 0] * away[:, 0] + away[:, 1] * away[:, 1] + away[:, 2] * away[:, 2]
            hit = squares <= rule.distance * rule.distance
            if rule.code == VOXEL_DISTANCE:
                inverse_z = 1.0 / rule.distance_z
                level = np.floor(cell.xyz[row, 2].astype(np.float64) * inverse_z)
                same = level == np.floor(places[place, 2] * inverse_z)
                hit |= same & (column[place] == own[place]).all(axis=1)
        explained[place[hit]] = True
        first = last
    return explained
