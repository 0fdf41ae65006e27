# SPDX-License-Identifier: Apache-2.0
"""Points of a voxel into one."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.dividing.kernels import assign_cells
from shmmap.dividing.lattice import CellLattice
from shmmap.dividing.row_layout import AXES
from shmmap.errors import BadRequest

__all__ = ["BYTES_PER_POINT", "reduce_voxels"]

BYTES_PER_POINT: Final = 96
"""What reducing takes for each point, beside two copies of the points."""

_MOST_KEYS: Final = (1 << 63) - 1
_PACKED_COLOURS: Final = frozenset({"rgb", "rgba"})  # PCL keeps four bytes in a float32
_AMOUNTS: Final = frozenset({"intensity", "red", "green", "blue", "nir"})  # integers that have a mean


def reduce_voxels(rows: NDArray[np.void], voxels: CellLattice) -> NDArray[np.void]:
    """Return one row for each voxel that has points, in the order of x, y, z of the voxels.

    The coordinates are the centroid, summed in float64.  Float fields are means too; integers that say
    how much (intensity, colours) are rounded means; all others (labels, rings, packed colours) are those
    of the voxel's first point, so that they stay values that occur.

    Parameters
    ----------
    rows
        (N,) finite points.
    voxels
        Lattice in x and y; z has the same step about 0.

    Raises
    ------
    BadRequest
        A point is too far from the origin of the lattice, or the points too far from each other, for voxels
        to be numbered.
    """
    if not len(rows):
        return rows
    keys = _keys(rows, voxels)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    starts = np.flatnonzero(np.concatenate(([True], ordered[1:] != ordered[:-1])))
    counts = np.diff(starts, append=len(rows)).astype(np.float64)
    out = np.empty(len(starts), rows.dtype)
    for name in rows.dtype.names or ():
        kind = rows.dtype[name].base.kind
        if (kind == "f" and name not in _PACKED_COLOURS) or name in _AMOUNTS:
            values = rows[name][order].astype(np.float64)
            with np.errstate(invalid="ignore"):
                means = np.add.reduceat(values, starts) / counts.reshape(-1, *[1] * (values.ndim - 1))
            out[name] = means if kind == "f" else np.rint(means)
        else:
            out[name] = rows[name][order[starts]]
    return out


def _keys(rows: NDArray[np.void], voxels: CellLattice) -> NDArray[np.int64]:
    """A number for each point's voxel, ascending in x, then y, then z."""
    flat = CellLattice(voxels.step, 0, 0, voxels.scale)
    ix, iy, iz = (np.empty(len(rows), np.int32) for _ in AXES)
    extremes = np.zeros((2, 3))
    x, y, z = (rows[axis] for axis in AXES)
    level, low_x, high_x, low_y, high_y = assign_cells(x, y, z, _numbers(voxels), ix, iy, extremes)
    spare = np.empty(len(rows), np.int32)
    upright, low_z, high_z, _, _ = assign_cells(z, z, z, _numbers(flat), iz, spare, extremes)
    spans = (high_x - low_x + 1, high_y - low_y + 1, high_z - low_z + 1)
    if level < 0 or upright < 0 or math.prod(spans) > _MOST_KEYS:
        raise BadRequest(
            f"the points span too many voxels of {voxels.size:g} m to number them",
            hint="larger --leaf, or look for a damaged coordinate with `shmmap inspect`",
        )
    keys: NDArray[np.int64] = ix.astype(np.int64) - low_x
    for index, low, high in ((iy, low_y, high_y), (iz, low_z, high_z)):
        keys *= high - low + 1
        keys += index
        keys -= low
    return keys


def _numbers(lattice: CellLattice) -> Any:
    return (
        lattice.size, *lattice.origin, lattice.step, lattice.origin_x, lattice.origin_y, lattice.scale,
    )  # fmt: skip
