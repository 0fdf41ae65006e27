# SPDX-License-Identifier: Apache-2.0
"""Versions of the layers of a map's cells, and the neighbouring cells that a layer uses.

The version of a layer with a halo includes its neighbours' versions.  Finding the neighbours takes about
40 us, and hashing some us.  So versions are kept in tables by cell, until one of the cells that they depend
on changes, and `LayerVersions.of_cells` takes those of many cells from a table at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.errors import BadRequest
from shmmap.geometry import Area, Box
from shmmap.large_tables import sparse_zeros
from shmmap.layers.points import LAYER
from shmmap.layers.spec import layer_spec
from shmmap.segment.version import layer_version

MAX_NEIGHBOURS: Final = 64
"""Maximum number of neighbouring files that a layer with a halo reads."""
TABLES_BYTES: Final = 64 << 20
"""Memory of all tables; each takes 8 bytes per cell of the map, but untouched pages of it take none."""
LEAST_TABLES: Final = 4
COMPUTED_PER_BATCH: Final = 1024
"""Versions that one call of `LayerVersions.of_cells` computes."""
HALO_COST: Final = 16
"""Versions that are hashed in the time in which one neighbourhood is searched."""

_SLACK_M: Final = 1e-3
"""Distance by which the search for cells exceeds the halo; `neighbours` then compares exactly."""


class ReadyLayer(Protocol):
    """A layer that the origin has computed."""

    @property
    def version(self) -> int:
        """Version of the layer."""


class Cells(Protocol):
    """The methods of a map's catalogue that are used here: its cells by index."""

    def __len__(self) -> int:
        """Return the number of cells."""

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all cells, metres, map frame; None if there are no cells."""

    @property
    def mean_size(self) -> tuple[float, float]:
        """Mean extent of the cells along x and y, metres."""

    def boxes_of(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return (K, 4) float64, ``min_x, min_y, max_x, max_y`` of these cells, metres, map frame."""

    def version(self, index: int) -> int:
        """Return the 64-bit version of a cell."""

    def ready(self, index: int, layer: str) -> ReadyLayer | None:
        """Return a layer that the origin has computed; None if it is computed here."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Return ``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def query(self, area: Area) -> tuple[NDArray[np.intp], bool]:
        """Return the cells whose box touches ``area``, ascending, and whether these are all."""


class _Kind(NamedTuple):
    """The values that a layer's versions depend on besides cells."""

    builder_version: int
    halo_m: float


@lru_cache(maxsize=4096)
def _kind(layer: str) -> _Kind:
    spec = layer_spec(layer)
    return _Kind(spec.builder_version, spec.halo_m)


class LayerVersions:
    """Computes and caches layer versions of one daemon's map.

    Parameters
    ----------
    catalogue
        Returns the map's current catalogue.
    """

    def __init__(self, catalogue: Callable[[], Cells]) -> None:
        self._catalogue = catalogue
        self._tables: dict[str, NDArray[np.uint64]] = {}  # by layer, then by cell; 0: not computed yet

    def version(self, index: int, layer: str) -> int:
        """Return the current version of one layer of a cell, see `shmmap.segment.version`.

        0 if it is not known yet, because a cell that the layer uses is not known.
        """
        catalogue = self._catalogue()
        cell = catalogue.version
        if layer == LAYER:
            return cell(index)
        if (ready := catalogue.ready(index, layer)) is not None:
            return ready.version
        kind = _kind(layer)
        if not kind.halo_m:
            return layer_version(cell(index), layer, kind.builder_version)
        table = self._table(layer)
        version = int(table[index])
        if not version:
            around, complete = self._around(index, kind.halo_m)
            if not complete:
                return 0
            near = [cell(one) for one in around[: MAX_NEIGHBOURS + 1].tolist()]
            version = layer_version(cell(index), layer, kind.builder_version, near)
            table[index] = version
        return version

    def of_cells(
        self, cells: NDArray[np.intp], layers: Sequence[str]
    ) -> tuple[NDArray[np.uint64], int, bool]:
        """Return the current versions of many cells' layers, as far as they can be found in milliseconds.

        Returns
        -------
        versions
            (N, L) uint64, 0 for a version that is not known yet.
        count
            Number of leading cells whose versions were looked for; at least one, if there is one.
        complete
            Whether all versions are known.
        """
        cost = sum(HALO_COST if _kind(layer).halo_m else 1 for layer in layers)
        count, most = len(cells), max(1, COMPUTED_PER_BATCH // max(1, cost))
        versions = np.empty((count, len(layers)), np.uint64)
        for column, layer in enumerate(layers):
            table = self._table(layer)
            found = table[cells]
            unknown = np.flatnonzero(found == 0)
            for place in unknown[:most].tolist():
                index = int(cells[place])
                found[place] = table[index] = self.version(index, layer)
            if len(unknown) > most:
                count = min(count, int(unknown[most]))
            versions[:, column] = found
        return versions, count, bool(versions.all())

    def _table(self, layer: str) -> NDArray[np.uint64]:
        table = self._tables.get(layer)
        if table is None:
            cells = len(self._catalogue())
            if len(self._tables) >= max(LEAST_TABLES, TABLES_BYTES // (8 * max(1, cells))):
                del self._tables[next(iter(self._tables))]
            table = self._tables[layer] = sparse_zeros(cells, np.uint64)
        return table

    def neighbours(self, index: int, layer: str) -> list[int]:
        """Return the catalogue indices of the neighbouring cells that a cell's layer uses, in id order.

        At most `MAX_NEIGHBOURS` + 1 are returned: a layer with more than `MAX_NEIGHBOURS` cannot be made.
        """
        halo_m = _kind(layer).halo_m
        if not halo_m or self._catalogue().ready(index, layer) is not None:
            return []
        around: list[int] = self._around(index, halo_m)[0][: MAX_NEIGHBOURS + 1].tolist()
        return around

    def halo_m(self, layers: Iterable[str]) -> float:
        """Return the largest halo of several layers, metres."""
        return max((_kind(layer).halo_m for layer in layers if layer != LAYER), default=0.0)

    def is_computed(self, index: int, layer: str) -> bool:
        """Whether a layer of a cell is computed here, which may take long."""
        return layer != LAYER and self._catalogue().ready(index, layer) is None

    def looks_into(self, index: int, layer: str) -> Box | None:
        """Return the box of points that a cell's layer uses; None if it uses only that cell."""
        halo_m = _kind(layer).halo_m if self.is_computed(index, layer) else 0.0
        return self._reach(index, halo_m) if halo_m else None

    def _reach(self, index: int, halo_m: float) -> Box:
        min_x, min_y, max_x, max_y = self._catalogue().box(index)
        return Box(min_x - halo_m, min_y - halo_m, max_x + halo_m, max_y + halo_m)

    def _around(self, index: int, halo_m: float) -> tuple[NDArray[np.intp], bool]:
        """Return the known cells around a cell, in id order, and whether these are all."""
        found, known = self._catalogue().query(self._reach(index, halo_m))
        return np.delete(found, found == index), known

    def check_reach(self, layer: str) -> None:
        """Refuse a layer that would use too many neighbouring cells of this map.

        The number is estimated from the mean size of a cell, as if cells filled the map's bounds.  A single
        cell with too many neighbours passes this check, but cannot be loaded.

        Raises
        ------
        BadRequest
            A cell would have more than `MAX_NEIGHBOURS` neighbours.
        """
        halo_m = _kind(layer).halo_m
        if not halo_m:
            return
        cells = self._catalogue()
        bounds = cells.bounds
        if bounds is None:
            return
        around = float(len(cells))
        for low, high, mean in zip(bounds[:2], bounds[2:], cells.mean_size, strict=True):
            if high > low:
                around *= min(1.0, 2 * (mean + halo_m) / (high - low))
        if around > MAX_NEIGHBOURS + 1:
            raise BadRequest(
                f"{layer} would look into about {around:.0f} cells around each one of this map;"
                f" {MAX_NEIGHBOURS} is the most",
                hint="use a smaller radius, or larger cells",
            )

    # --- changes --------------------------------------------------------------------------------

    def dependents(self, index: int, layers: Iterable[str]) -> Iterator[tuple[str, list[int]]]:
        """Yield, for each of these layers, the cells whose version depends on a cell, itself first."""
        halos = [(layer, _kind(layer).halo_m) for layer in layers]
        widest_m = max((halo_m for _, halo_m in halos), default=0.0)
        around = self._around(index, widest_m + _SLACK_M)[0] if widest_m else np.zeros(0, np.intp)
        boxes, (min_x, min_y, max_x, max_y) = self._catalogue().boxes_of(around), self._catalogue().box(index)
        for layer, halo_m in halos:
            near = around[:0]
            if halo_m:
                looks = (boxes[:, 0] - halo_m <= max_x) & (boxes[:, 2] + halo_m >= min_x)
                near = around[looks & (boxes[:, 1] - halo_m <= max_y) & (boxes[:, 3] + halo_m >= min_y)]
            yield layer, [index, *near.tolist()]

    def cell_changed(self, index: int) -> None:
        """Drop the versions in the tables that depend on a cell, which has changed."""
        for layer, cells in self.dependents(index, list(self._tables)):
            self._tables[layer][cells] = 0

    def forget(self) -> list[NDArray[np.uint64]]:
        """Drop all tables, as indices now name other cells; return them, since freeing them takes time."""
        tables, self._tables = list(self._tables.values()), {}
        return tables
