# SPDX-License-Identifier: Apache-2.0
"""The Gaussians of map cells, and a map of many cells without a copy, by a small table of addresses.

A kernel compiled once cannot take 256 mappings as arguments.  It takes the *table* instead: per cell
the addresses of three arrays and the cell's lattice box, 13 integers.  All cells of one leaf size share
one global lattice, so that a point's lattice index is right for every cell; the *directory* says, for
each lattice column (i, j), which cells have it.  A column on a border belongs to both cells, and their
voxels are never merged: both Gaussians count, as in Autoware.

Private memory: 210 bytes a cell, 4 bytes a lattice column, and 48 bytes a voxel where the covariances
differ from those of the cells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from shmmap import BadRequest

if TYPE_CHECKING:
    from shmmap import Cell
    from shmmap.layers import LayerTable

_COLUMNS: Final = ("table", "mean", "inverse_covariance", "scatter", "count")
Covariance = Literal["autoware", "pclomp", "pcl"]
TABLE_COLUMNS: Final = 13  # addresses of lattice, mean, inverse; then the columns of `VoxelMap.boxes`
_ADDRESSES: Final = 3
_MAX_COLUMNS: Final = 1 << 22  # 16 MiB of directory: 2 km x 2 km at 1 m


@dataclass(frozen=True, slots=True, eq=False)
class VoxelCell:
    """Voxel statistics of one cell; the arrays may be views of shared memory.

    Attributes
    ----------
    leaf
        Edge of a voxel, metres.
    origin : (3,) float64
        Origin of ``mean``, metres, map frame.
    lattice : (ni, nj, nk) int32, any strides
        Row of the voxel at each place of the cell's lattice box, -1 for no voxel.
    lattice_origin : (3,) int64
        Lattice index of ``lattice[0, 0, 0]``; the lattice itself starts at the map frame's origin.
    count : (V,) uint32
        Points in each voxel.
    mean : (V, 3) float64
        Relative to ``origin``, metres.
    scatter : (V, 6) float64
        xx xy xz yy yz zz of the sum of (x - mean)(x - mean)^T, square metres.
    inverse : (V, 6) float64
        Inverse covariance in Autoware's variant, xx xy xz yy yz zz, 1/m^2; zero where the variant refuses it.
    memory
        Owner of the arrays' memory.
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

    def __repr__(self) -> str:
        return f"<VoxelCell of {len(self.count)} voxels of {self.leaf:g} m>"

    @property
    def map_bytes(self) -> int:
        """Bytes that matching reads: lattice, means and inverse covariances."""
        return self.lattice.nbytes + self.mean.nbytes + self.inverse.nbytes


def voxel_cell(points: NDArray[np.generic], leaf: float) -> VoxelCell:
    """Compute the Gaussians of a cloud, equal to the daemon's ``ndt`` layer.

    Parameters
    ----------
    points : (N, 3) float32 or float64
        Map frame, metres; rows that are not finite are left out.
    leaf
        Edge of a voxel, metres.

    Raises
    ------
    BadRequest, MapDataError
        As `shmmap.layers.build_layer`.
    """
    from shmmap.layers import build_layer

    return cell_from_layer(build_layer(f"ndt(leaf={leaf!r})", points))


def cell_from_layer(layer: LayerTable | Cell) -> VoxelCell:
    """Return the Gaussians of an ``ndt`` layer as views of its memory.

    Parameters
    ----------
    layer
        Layer from `shmmap.layers.build_layer` or the daemon.

    Raises
    ------
    BadRequest
        The layer is not an ``ndt`` layer.
    """
    from shmmap import Cell

    lattice = layer.lattice
    if lattice is None or len(set(lattice.leaf)) != 1:
        raise BadRequest("this layer has no voxels of one edge length", hint="ask for ndt(leaf=...)")
    try:
        arrays: list[Any] = [layer[name] for name in _COLUMNS]
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


class VoxelMap:
    """The cells that a scan is matched against; immutable, so that another thread can build the next map.

    Parameters
    ----------
    cells
        Cells by any key; their order is the order of summation.
    max_voxels, max_bytes
        Limits: cells nearest to ``centre`` are taken until the next would exceed one; the others are left
        out and counted.  Bytes are `VoxelCell.map_bytes`.
    centre
        (x, y), metres, map frame; by default the middle of all cells.
    previous
        A map whose derived covariances are reused for the cells in both maps.

    Attributes
    ----------
    boxes : (C, 10) int64
        For each cell in order: lattice index of its first place (i0, j0, k0), number of heights, strides
        of its lattice array along i, j and k, number of voxels, columns along i and along j.

    Raises
    ------
    BadRequest
        Cells have different leaf sizes, or lie so far apart that the directory would be too large.
    """

    def __init__(
        self,
        cells: Mapping[str, VoxelCell],
        *,
        max_voxels: int | None = None,
        max_bytes: int | None = None,
        centre: tuple[float, float] | None = None,
        previous: VoxelMap | None = None,
    ) -> None:
        leaves = {cell.leaf for cell in cells.values()}
        if len(leaves) > 1:
            raise BadRequest(f"cells of one map must have one leaf size, these have {sorted(leaves)}")
        self.leaf: float = leaves.pop() if leaves else 1.0
        kept = _within(cells, max_voxels, max_bytes, centre)
        left = [cell for key, cell in cells.items() if key not in kept]
        self.cells: dict[str, VoxelCell] = kept
        self.voxels = sum(len(cell.count) for cell in kept.values())
        self.voxels_left_out = sum(len(cell.count) for cell in left)
        self.bytes_left_out = sum(cell.map_bytes for cell in left)
        self.origins = np.array([cell.origin for cell in kept.values()]).reshape(-1, 3)
        self._derived: dict[str, dict[Covariance, NDArray[np.float64]]] = {}
        if previous is not None:
            self._derived = {
                key: previous._derived[key]
                for key, cell in kept.items()
                if previous.cells.get(key) is cell and key in previous._derived
            }
        self.boxes = _boxes(list(kept.values()))
        self.box, self.column_start, self.column_cell = _directory(self.boxes)
        self._tables: dict[Covariance, NDArray[np.int64]] = {}

    def __repr__(self) -> str:
        return f"<VoxelMap of {len(self.cells)} cells, {self.voxels} voxels of {self.leaf:g} m>"

    def inverses(self, key: str, covariance: Covariance) -> NDArray[np.float64]:
        """Return (V, 6) inverse covariances of a cell; the cell's own array if it has this kind."""
        cell = self.cells[key]
        if covariance == "autoware":
            return cell.inverse
        derived = self._derived.setdefault(key, {})
        if covariance not in derived:
            from shmmap.layers import voxel_covariances

            derived[covariance] = voxel_covariances(cell.count, cell.scatter, covariance)[1]
        return derived[covariance]

    def table(self, covariance: Covariance) -> NDArray[np.int64]:
        """Return the kernel's table, (C, `TABLE_COLUMNS`); valid as long as this map exists."""
        table = self._tables.get(covariance)
        if table is None:
            table = np.zeros((len(self.cells), TABLE_COLUMNS), np.int64)
            table[:, _ADDRESSES:] = self.boxes
            for row, (key, cell) in enumerate(self.cells.items()):
                table[row, :_ADDRESSES] = _addresses(cell, self.inverses(key, covariance))
            self._tables[covariance] = table
        return table

    @property
    def private_bytes(self) -> int:
        """Private memory of this process for the map, bytes."""
        return (
            self.column_start.nbytes
            + self.column_cell.nbytes
            + self.origins.nbytes
            + self.boxes.nbytes
            + sum(table.nbytes for table in self._tables.values())
            + sum(array.nbytes for derived in self._derived.values() for array in derived.values())
        )


def _within(
    cells: Mapping[str, VoxelCell],
    max_voxels: int | None,
    max_bytes: int | None,
    centre: tuple[float, float] | None,
) -> dict[str, VoxelCell]:
    most = np.array([np.inf if limit is None else limit for limit in (max_voxels, max_bytes)])
    sizes = np.array([(len(cell.count), cell.map_bytes) for cell in cells.values()]).reshape(-1, 2)
    if (sizes.sum(axis=0) <= most).all():
        return dict(cells)
    keys = list(cells)
    low = np.array([cell.lattice_origin[:2] for cell in cells.values()], np.float64)
    size = np.array([cell.lattice.shape[:2] for cell in cells.values()], np.float64)
    middle = (low + size / 2) * next(iter(cells.values())).leaf
    target = np.array(centre) if centre is not None else middle.mean(axis=0)
    nearest = np.argsort(((middle - target) ** 2).sum(axis=1), kind="stable")
    fits = (np.cumsum(sizes[nearest], axis=0) <= most).all(axis=1)
    chosen = {keys[index] for index in nearest[np.logical_and.accumulate(fits)]}
    return {key: cell for key, cell in cells.items() if key in chosen}


def _boxes(cells: Sequence[VoxelCell]) -> NDArray[np.int64]:
    if not cells:
        return np.zeros((0, TABLE_COLUMNS - _ADDRESSES), np.int64)
    shapes = np.array([cell.lattice.shape for cell in cells], np.int64)
    steps = np.array([cell.lattice.strides for cell in cells], np.int64) // cells[0].lattice.itemsize
    voxels = np.array([[len(cell.count)] for cell in cells], np.int64)
    first = np.concatenate([cell.lattice_origin for cell in cells]).astype(np.int64, copy=False)
    return np.concatenate([first.reshape(-1, 3), shapes[:, 2:], steps, voxels, shapes[:, :2]], axis=1)


def _directory(
    all_boxes: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]:
    """Return (i0, j0, ni, nj), the start of each column's cells, and these cells."""
    boxes = [
        (index, i, j, di, dj)
        for index, (i, j, _, _, _, _, _, voxels, di, dj) in enumerate(all_boxes.tolist())
        if voxels
    ]
    if not boxes:
        return np.zeros(4, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)
    i0, j0 = (min(box[axis] for box in boxes) for axis in (1, 2))
    ni, nj = (max(box[axis] + box[axis + 2] for box in boxes) - low for axis, low in ((1, i0), (2, j0)))
    if ni * nj > _MAX_COLUMNS:
        raise BadRequest(
            f"the cells span {ni} x {nj} voxels, more than a map for matching may have",
            hint="match against the cells around the pose, not against a whole city",
        )
    blocks = [
        (index, slice(i - i0, i - i0 + di), slice(j - j0, j - j0 + dj)) for index, i, j, di, dj in boxes
    ]
    number = np.zeros((ni, nj), np.int32)
    for _, across, along in blocks:
        number[across, along] += 1
    start = np.zeros(ni * nj + 1, np.int32)
    np.cumsum(number.ravel(), out=start[1:])
    free = start[:-1].reshape(ni, nj).copy()
    column_cell = np.zeros(max(1, int(start[-1])), np.int32)
    for index, across, along in blocks:
        column_cell[free[across, along]] = index
        free[across, along] += 1
    return np.array([i0, j0, ni, nj], np.int64), start, column_cell


def _addresses(cell: VoxelCell, inverse: NDArray[np.float64]) -> tuple[int, int, int]:
    for array, dtype in ((cell.lattice, np.int32), (cell.mean, np.float64), (inverse, np.float64)):
        if array.dtype != dtype:
            raise BadRequest(f"a cell's array has dtype {array.dtype}, not {np.dtype(dtype)}")
    if not (cell.mean.flags.c_contiguous and inverse.flags.c_contiguous):
        raise BadRequest("a cell's arrays must be contiguous")
    return cell.lattice.ctypes.data, cell.mean.ctypes.data, inverse.ctypes.data
