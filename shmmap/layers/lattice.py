# SPDX-License-Identifier: Apache-2.0
"""Points sorted into the voxels of a global lattice, rows numbered with x fastest, then y, then z."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import MapDataError
from shmmap.segment.layout import Lattice

__all__ = ["MAX_TABLE_VOXELS", "Grouping", "dense_table", "group_points"]

MAX_TABLE_VOXELS: Final = 1 << 24
"""Voxels of a dense table that is written out: 64 MiB of int32, a 512 m cube at 2 m."""

_INDEX_LIMIT: Final = float(1 << 31)
_DENSE_POINTS: Final = 64
_SMALL_TABLE: Final = 1 << 21


@dataclass(slots=True)
class Grouping:
    """Which voxel each point lies in.

    Attributes
    ----------
    rows
        (N,) int32: row of each point's voxel; -1 for a point that is not finite, or whose voxel has
        too few points.
    counts
        (V,) int32: points of each row's voxel.
    indices
        (V, 3) int64: lattice index x, y, z of each row.
    leaf
        Edge lengths of a voxel, metres.
    """

    rows: NDArray[np.int32]
    counts: NDArray[np.int32]
    indices: NDArray[np.int64]
    leaf: tuple[float, float, float]

    @property
    def lattice(self) -> Lattice:
        """The lattice, and the box of it that the rows occupy."""
        if not len(self.indices):
            return Lattice(self.leaf, (0, 0, 0), (0, 0, 0))
        low = self.indices.min(axis=0)
        shape = self.indices.max(axis=0) - low + 1
        return Lattice(
            self.leaf,
            (int(low[0]), int(low[1]), int(low[2])),
            (int(shape[0]), int(shape[1]), int(shape[2])),
        )


def group_points(xyz: NDArray[np.generic], leaf: tuple[float, float, float], *, least: int = 1) -> Grouping:
    """Sort points into voxels.

    Parameters
    ----------
    xyz
        (N, 3) float32 or float64, C-contiguous, metres; the lattice index is computed in this
        precision.
    leaf
        Edge lengths of a voxel, metres; infinite: that axis is not divided.
    least
        Voxels of fewer points get no row.

    Raises
    ------
    MapDataError
        If coordinates are too large for the lattice (cause ``coordinate_range``).
    """
    from shmmap.layers.lattice_kernels import bounds, count_points, number_voxels

    real = xyz.dtype.type
    inverse_x, inverse_y, inverse_z = (real(1.0) / real(edge) for edge in leaf)
    found = np.empty(6)
    kept = bounds(xyz, inverse_x, inverse_y, inverse_z, found)
    if not kept:
        return Grouping(
            np.full(len(xyz), -1, np.int32), np.empty(0, np.int32), np.empty((0, 3), np.int64), leaf
        )
    if not np.all(np.abs(found) < _INDEX_LIMIT):
        raise MapDataError(
            f"coordinates are too large for a lattice of {min(leaf):g} m",
            cause="coordinate_range",
            hint="use a larger leaf, or remove the stray points",
        )
    first = found[:3].astype(np.int64)
    shape = found[3:6].astype(np.int64) - first + 1
    voxels = math.prod(shape.tolist())
    if voxels > max(_SMALL_TABLE, min(_DENSE_POINTS * kept, MAX_TABLE_VOXELS * 4)):
        rows, counts, indices = _by_sorting(xyz, np.array([inverse_x, inverse_y, inverse_z], real), least)
    else:
        place = np.empty(len(xyz), np.int32)
        table = np.zeros(voxels, np.int32)
        occupied = count_points(xyz, inverse_x, inverse_y, inverse_z, first, shape, place, table)
        counts, places = np.empty(occupied, np.int32), np.empty(occupied, np.int32)
        row_count = number_voxels(table, least, counts, places)
        counts, places = counts[:row_count], places[:row_count].astype(np.int64)
        rows = table[place]  # -1 reads the last entry
        if kept < len(xyz):
            rows[place < 0] = -1
        indices = np.empty((row_count, 3), np.int64)
        indices[:, 0] = places % shape[0]
        indices[:, 1] = places // shape[0] % shape[1]
        indices[:, 2] = places // (shape[0] * shape[1])
        indices += first
    return Grouping(rows, counts, indices, leaf)


def _by_sorting(
    xyz: NDArray[Any],
    inverse: NDArray[Any],
    least: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
    """Group points that lie far apart: no table over all of their box."""
    finite = np.isfinite(xyz).all(axis=1)
    index = np.floor(xyz[finite] * inverse).astype(np.int64)
    order = np.lexsort((index[:, 0], index[:, 1], index[:, 2]))
    ordered = index[order]
    starts = np.flatnonzero(np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)]))
    counts = np.diff(np.append(starts, len(ordered))).astype(np.int32)
    number = np.full(len(counts), -1, np.int32)
    wanted = np.flatnonzero(counts >= least)
    number[wanted] = np.arange(len(wanted), dtype=np.int32)
    inner = np.empty(len(ordered), np.int32)
    inner[order] = np.repeat(number, counts)
    rows = np.full(len(xyz), -1, np.int32)
    rows[finite] = inner
    return rows, counts[wanted], ordered[starts[wanted]]


def dense_table(grouping: Grouping) -> NDArray[np.int32]:
    """Return the row of each voxel of the occupied box, (nz, ny, nx) int32, -1 where there is none.

    Raises
    ------
    MapDataError
        If the box is too large for a table (cause ``coordinate_range``).
    """
    lattice = grouping.lattice
    nx, ny, nz = lattice.shape
    if nx * ny * nz > MAX_TABLE_VOXELS:
        raise MapDataError(
            f"its voxels span {nx} x {ny} x {nz}, more than {MAX_TABLE_VOXELS}",
            cause="coordinate_range",
            hint="use a larger leaf or smaller cells, or remove stray points",
        )
    table = np.full((nz, ny, nx), -1, np.int32)
    at = grouping.indices - np.array(lattice.first, np.int64)
    table[at[:, 2], at[:, 1], at[:, 0]] = np.arange(len(at), dtype=np.int32)
    return table
