# SPDX-License-Identifier: Apache-2.0
"""Index of a map to be published: the objects of its cells, divided into shards."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest, MapDataError
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.remote.published_index import (
    MAX_METRES,
    MAX_SHARD_BYTES,
    LayerObjects,
    Shard,
    is_relative_path,
    shard_keys,
)
from shmmap.publishing.messages import CellSent

_CELLS_ALONG_A_SHARD: Final = 32
_MAX_CELLS: Final = 8192
_OTHER_SIZE: Final = 4.0
_FIXED_BYTES: Final = 64
_LAYER_BYTES: Final = 72


class CellObjects:
    """The objects of all cells, filled in as they are sent; row *i* is cell *i* of the catalogue."""

    def __init__(self, cells: int, layers: Sequence[str]) -> None:
        self.z = np.full((cells, 2), np.nan)
        self.points = np.zeros(cells, np.uint32)
        self.layers = {
            layer: LayerObjects(
                np.zeros(cells, np.uint32),
                np.zeros(cells, np.uint32),
                np.zeros((cells, 32), np.uint8),
                np.zeros((cells, 32), np.uint8),
            )
            for layer in layers
        }

    def set(self, row: int, cell: CellSent) -> None:
        """Fill in the objects of a cell."""
        if cell.points:
            self.z[row] = cell.z_min, cell.z_max
        self.points[row] = cell.points
        for objects, layer in zip(self.layers.values(), cell.layers, strict=True):
            objects.sizes[row], objects.raws[row] = layer.size, layer.raw
            objects.hashes[row] = np.frombuffer(layer.sha256, np.uint8)
            objects.contents[row] = np.frombuffer(layer.content, np.uint8)

    @property
    def nbytes(self) -> int:
        """Total bytes of all objects; an object that several cells share counts once for each cell."""
        return sum(int(objects.sizes.sum(dtype=np.uint64)) for objects in self.layers.values())


def check_cells(catalogue: Catalogue) -> None:
    """Refuse cells that no reader would take.

    Raises
    ------
    BadRequest
        The name of a cell is not valid text.
    MapDataError
        A cell lies too far out.
    """
    for name in catalogue.names.tolist():
        if not is_relative_path(name):
            raise BadRequest(f"a cell named {name!r} cannot be published", hint="rename its file")
    far = np.flatnonzero(~(np.abs(catalogue.boxes) <= MAX_METRES).all(axis=1))
    if len(far):
        raise MapDataError(
            f"cell {catalogue.id(int(far[0]))} is farther out than {MAX_METRES:g} m",
            cause="too_large",
            hint="correct the map's metadata",
        )


def shard_side(catalogue: Catalogue, layers: int, before: float | None) -> float:
    """Return the side of a shard in metres, for about 32 cells; that of the last version while suitable.

    Raises
    ------
    MapDataError
        Too many cells begin at the same position, or a cell is too far away.
    """
    mean_x, mean_y = catalogue.mean_size
    ideal = _rounded(_CELLS_ALONG_A_SHARD * (max(mean_x, mean_y) or 1.0))
    side = ideal if before is None or not 1 / _OTHER_SIZE <= before / ideal <= _OTHER_SIZE else before
    longest = max(map(len, catalogue.names.tolist()))
    most = min(_MAX_CELLS, MAX_SHARD_BYTES // (_FIXED_BYTES + longest + layers * _LAYER_BYTES))
    for _ in range(40):
        keys = shard_keys(catalogue.boxes, side)
        if np.abs(keys).max() >= 2**31:
            break
        if np.unique(keys, axis=0, return_counts=True)[1].max() <= most:
            return side
        side = _rounded(side / 2)
    raise MapDataError(
        f"more than {most:,} cells begin within {side:g} m, or a cell lies too far out for shards so small",
        cause="too_large",
    )


def _rounded(length: float) -> float:
    """Round a length to three digits, so that it does not depend on the last bit of a mean."""
    return float(f"{length:.3g}") if math.isfinite(length) and length > 0 else 1.0


def divide_into_shards(
    catalogue: Catalogue, objects: CellObjects, side: float
) -> Iterator[tuple[tuple[int, int], Shard]]:
    """Yield the key (row, column) of each shard, ascending, and the shard."""
    keys = shard_keys(catalogue.boxes, side).astype(np.int64)
    order = np.lexsort((np.arange(len(keys)), keys[:, 1], keys[:, 0]))  # cells of a shard stay in name order
    ordered = keys[order]
    begins = np.flatnonzero(np.r_[True, (ordered[1:] != ordered[:-1]).any(axis=1)])
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(order)], strict=True):
        rows = order[begin:end]
        names = tuple(catalogue.names[rows].tolist())
        row, column = ordered[begin].tolist()
        yield (
            (row, column),
            Shard(
                names,
                catalogue.boxes[rows],
                objects.z[rows],
                objects.points[rows],
                {layer: _taken(all_cells, rows) for layer, all_cells in objects.layers.items()},
            ),
        )


def _taken(objects: LayerObjects, rows: NDArray[Any]) -> LayerObjects:
    return LayerObjects(objects.sizes[rows], objects.raws[rows], objects.hashes[rows], objects.contents[rows])
