# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of one map cell, as the matcher sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

if TYPE_CHECKING:
    from shmmap import Cell
    from shmmap.layers import LayerTable

__all__ = ["VoxelCell", "cell_from_layer", "voxel_cell"]

_COLUMNS: Final = ("table", "mean", "inverse_covariance", "scatter", "count")


@dataclass(frozen=True, slots=True, eq=False)
class VoxelCell:
    """Voxel statistics of one cell; the arrays may be views of shared memory.

    Attributes
    ----------
    leaf
        Edge of a voxel, metres.
    origin : (3,) float64
        What ``mean`` is relative to, metres, map frame.
    lattice : (ni, nj, nk) int32, any strides
        Row of the voxel at each place of the cell's lattice box, -1 where there is none.
    lattice_origin : (3,) int64
        Lattice index of ``lattice[0, 0, 0]``; the lattice itself starts at the map frame's origin.
    count : (V,) uint32
        Points in each voxel.
    mean : (V, 3) float64
        Relative to ``origin``, metres.
    scatter : (V, 6) float64
        xx xy xz yy yz zz of the sum of (x - mean)(x - mean)^T, square metres.
    inverse : (V, 6) float64
        Inverse covariance in Autoware's variant, xx xy xz yy yz zz, 1/m^2; zero where refused.
    memory
        What the arrays belong to.
    """

    leaf: float
    origin: NDArray[np.float64]
    lattice: NDArray[np.int32]
    lattice_origin: NDArray[np.int64]
    count: NDArray[np.uint32]
    mean: NDArray[np.float64]
    scatter: NDArray[np.float64]
    inverse: NDArray[np.float64]
    memory: object = None

    @property
    def map_bytes(self) -> int:
        """Bytes that matching needs of it: lattice, means and inverse covariances."""
        return self.lattice.nbytes + self.mean.nbytes + self.inverse.nbytes


def voxel_cell(points: NDArray[np.generic], leaf: float, *, min_points: int = 6) -> VoxelCell:
    """Compute the Gaussians of a cloud, as the daemon's ``ndt`` layer has them.

    Parameters
    ----------
    points : (N, 3) float32 or float64
        Map frame, metres; rows that are not finite are left out.
    leaf
        Edge of a voxel, metres.
    min_points
        Voxels with fewer points are left out.

    Raises
    ------
    BadRequest, MapDataError
        As `shmmap.layers.build_layer`.
    """
    from shmmap.layers import build_layer

    return cell_from_layer(build_layer(f"ndt(leaf={leaf!r},min_points={min_points})", points))


def cell_from_layer(layer: LayerTable | Cell) -> VoxelCell:
    """Return the Gaussians of an ``ndt`` layer, over the same memory.

    Parameters
    ----------
    layer
        As `shmmap.layers.build_layer` or the daemon gave it.

    Raises
    ------
    BadRequest
        It is no ``ndt`` layer.
    """
    from shmmap import Cell

    lattice = layer.header.lattice if isinstance(layer, Cell) else layer.lattice
    if lattice is None or len(set(lattice.leaf)) != 1:
        raise BadRequest("this layer has no voxels of one edge length", hint="ask for ndt(leaf=...)")
    try:
        arrays: list[Any] = [
            layer[name] for name in ("table", "mean", "inverse_covariance", "scatter", "count")
        ]
    except KeyError as error:
        raise BadRequest(f"this is no ndt layer: {error.args[0]}", hint="ask for ndt(leaf=...)") from None
    table, mean, inverse, scatter, count = arrays
    return VoxelCell(
        leaf=lattice.leaf[0],
        origin=np.array(layer.origin if isinstance(layer, Cell) else (0.0, 0.0, 0.0)),
        lattice=table.transpose(2, 1, 0),
        lattice_origin=np.array(lattice.first, np.int64),
        count=count,
        mean=mean,
        scatter=scatter,
        inverse=inverse,
        memory=layer,
    )
