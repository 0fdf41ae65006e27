# SPDX-License-Identifier: Apache-2.0
"""Grounds of a map near a place: one, or levels above each other, as of bridges, tunnels and car parks.

The ``ground`` layer has one height a column, the lowest, and knows no level above another.  The voxels of the
``ndt`` layer do: a voxel whose points are flat and lie level is a piece of a ground, a floor, a ceiling or a
roof.  Many such pieces at one height are a level.  Crowns of trees are not flat; a roof is a level at which
the scan does not fit, and costs a search.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap_clients.ndt_scan_matcher import VoxelCell

STOREY_M: Final = 1.8
"""Least distance of two levels, metres: less than the headroom of any car park."""

_SAME_HEIGHT_M: Final = 0.3
_TILT: Final = math.cos(math.radians(20.0))  # steeper than any ramp
_THICKNESS_M: Final = 0.3  # standard deviation across: a slab of which both sides are in the map
_HEADROOM_M: Final = (0.6, 1.8)  # nothing lies there above a ground; crowns of trees go on
_WIDTH: Final = 0.15  # least standard deviation along, of the voxel's edge; 0.29 where it is full
_BAND_M: Final = 0.5
_FEWEST: Final = 4
_HERE_M: Final = 4.0  # as far as the median of the ground layer
_SHARE: Final = 0.25  # of the columns: less is a car, a wall or noise
_NEARER: Final = 0.6


@dataclass(frozen=True, slots=True)
class Ground:
    """A level of the map near a place.

    Attributes
    ----------
    heights
        Heights at which a search of this level begins, metres, map frame; the first is the level's.
    """

    heights: tuple[float, ...]

    @property
    def z(self) -> float:
        """Height of the level, metres, map frame."""
        return self.heights[0]


def flat_pieces(
    cells: Iterable[VoxelCell], x: float, y: float, reach_m: float
) -> tuple[NDArray[np.float64], int]:
    """Return flat, level, free voxels near a place.

    Returns
    -------
    pieces : (K, 2) float64
        Height and distance from the place, metres.
    columns
        Number of columns in which they lie.
    """
    means: list[NDArray[np.float64]] = []
    flats: list[NDArray[np.bool_]] = []
    indices: list[NDArray[np.int64]] = []
    for cell in cells:
        low = cell.lattice_origin[:2] * cell.leaf
        high = low + np.array(cell.lattice.shape[:2]) * cell.leaf
        if np.hypot(*(np.clip((x, y), low, high) - (x, y))) > reach_m:
            continue
        mean = cell.mean + cell.origin
        near = np.hypot(mean[:, 0] - x, mean[:, 1] - y) <= reach_m
        mean, count = mean[near], cell.count[near].astype(np.float64)
        scatter = cell.scatter[near][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
        variances, axes = np.linalg.eigh(scatter / np.maximum(count - 1.0, 1.0)[:, None, None])
        deviations = np.sqrt(np.maximum(variances, 0.0))
        flat = deviations[:, 0] <= min(_THICKNESS_M, _WIDTH * cell.leaf)
        flat &= deviations[:, 1] >= _WIDTH * cell.leaf
        flat &= np.abs(axes[:, 2, 0]) >= _TILT
        means.append(mean)
        flats.append(flat)
        indices.append(np.floor(mean[:, :2] / cell.leaf).astype(np.int64))
    if not means:
        return np.empty((0, 2)), 0
    mean, flat, column = np.concatenate(means), np.concatenate(flats), np.concatenate(indices)
    z, distance = mean[:, 2], np.hypot(mean[:, 0] - x, mean[:, 1] - y)
    column = np.unique(column, axis=0, return_inverse=True)[1].ravel()
    above = z[None, :] - z[flat, None]
    least, most = _HEADROOM_M
    blocked = (above > least) & (above < most) & (column[None, :] == column[flat, None])
    free = np.flatnonzero(flat)[~blocked.any(axis=1)]
    return np.column_stack([z[free], distance[free]]), len(np.unique(column[free]))


def levels_of(pieces: NDArray[np.float64], columns: int) -> list[float]:
    """Return the heights of levels at the place, that of the most pieces first, from `flat_pieces`."""
    fewest = max(_FEWEST, _SHARE * columns)
    left = pieces[np.argsort(pieces[:, 0])]
    levels: list[float] = []
    while len(left):
        z = left[:, 0]
        counts = np.searchsorted(z, z + _BAND_M, side="right") - np.arange(len(z))
        first = int(np.argmax(counts))
        if counts[first] < fewest:
            break
        level = left[first : first + counts[first]]
        here = level[level[:, 1] <= _HERE_M]
        levels.append(float(np.median((here if len(here) >= _FEWEST else level)[:, 0])))
        left = left[np.abs(z - levels[-1]) >= STOREY_M]
    return levels


def grounds_of(median: float | None, lowest: float | None, levels: Sequence[float]) -> list[Ground]:
    """Return the grounds, lowest first, of the ``ground`` layer's two heights and of levels.

    Parameters
    ----------
    median, lowest
        Heights by `shmmap.layers.ground_height`, exact to centimetres, but of one level a column; None: no
        ground.
    levels
        Heights by `levels_of`.
    """
    known = [z for z in (median, lowest) if z is not None]
    heights: list[list[float]] = []
    for z in [*known, *levels]:
        same = next((one for one in heights if abs(one[0] - z) < STOREY_M), None)
        if same is None:
            heights.append([z])
        elif z in known and abs(same[0] - z) >= _SAME_HEIGHT_M:
            same.append(z)
    return sorted((Ground(tuple(one)) for one in heights), key=lambda ground: ground.z)


def ground_at(grounds: Sequence[Ground], z: float) -> Ground | None:
    """Return the ground that a height means, or None where it is about as near to another."""
    nearest, *others = sorted(grounds, key=lambda ground: abs(ground.z - z))
    if others and abs(nearest.z - z) > _NEARER * abs(others[0].z - z):
        return None
    return nearest
