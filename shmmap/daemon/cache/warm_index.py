# SPDX-License-Identifier: Apache-2.0
"""Index of the cells in memory at their current version: requests for these need no load."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Key, Resident
from shmmap.large_tables import ShardedDict, sparse_zeros
from shmmap.protocol.codec import encode_handle
from shmmap.protocol.messages import Handle

TABLES_BYTES: Final = 64 << 20
"""Memory of all tables; each takes 8 bytes per cell of the map, but untouched pages of it take none."""
LEAST_TABLES: Final = 4
RETIRED_REMEMBERED: Final = 1 << 14
"""Retired versions remembered; a client that holds an older one has to drop it, as after a restart."""


class Heights:
    """Lowest and highest z of cells by catalogue index, metres, where known.

    Parameters
    ----------
    cells
        Number of cells.
    """

    def __init__(self, cells: int) -> None:
        self._z = sparse_zeros((cells, 2), np.float64)
        self._known = sparse_zeros(cells, np.bool_)

    def learn(self, index: int, z_min: float, z_max: float) -> None:
        """Note the heights of a cell that was loaded."""
        self._z[index] = z_min, z_max
        self._known[index] = True

    def forget(self, indices: NDArray[np.intp]) -> None:
        """Forget the heights of cells that have changed."""
        self._known[indices] = False

    def get(self, index: int) -> tuple[float, float] | None:
        """Return the lowest and highest z of a cell, metres; None if they are not known."""
        if not self._known[index]:
            return None
        z_min, z_max = self._z[index].tolist()
        return z_min, z_max

    def overlapping(self, cells: NDArray[np.intp], z: tuple[float, float]) -> NDArray[np.intp]:
        """Return the cells that may overlap a height range: all but those known to lie outside it."""
        z_min, z_max = self._z[cells].T
        outside = self._known[cells] & ((z_max < z[0]) | (z_min > z[1]))
        inside: NDArray[np.intp] = cells[~outside]
        return inside


@dataclass(eq=False, slots=True)
class WarmIndex:
    """Two indices of the same segments: one for single cells, one for a whole area at once.

    The index for areas takes a table as long as the map, so only the layers with the most segments have one.

    Attributes
    ----------
    layers : dict
        Resident segment by catalogue index, per layer.
    tables : dict
        Version by catalogue index, (cells,) uint64, 0 for a cell not in memory; for layers with a table.
    of_version : ShardedDict
        Cell and layer by version, for current and earlier versions that were handed out.
    retired : OrderedDict
        Retired versions among these.
    """

    layers: dict[str, ShardedDict[int, Resident]] = field(default_factory=dict)
    tables: dict[str, NDArray[np.uint64]] = field(default_factory=dict)
    of_version: ShardedDict[int, Key] = field(default_factory=ShardedDict)
    retired: OrderedDict[int, None] = field(default_factory=OrderedDict)
    _count: int = 0

    def __len__(self) -> int:
        return self._count

    def get(self, index: int, layer: str) -> Resident | None:
        """Return the segment of a cell, if it is warm."""
        found = self.layers.get(layer)
        return found.get(index) if found is not None else None

    def versions(self, layer: str, cells: NDArray[np.intp]) -> list[int] | None:
        """Return the versions of cells, 0 for a cell not in memory; None if the layer has no segment."""
        table = self.tables.get(layer)
        if table is not None:
            return cast("list[int]", table[cells].tolist())
        found = self.layers.get(layer)
        if found is None:
            return None
        residents = map(found.get, cells.tolist())
        return [resident.version if resident is not None else 0 for resident in residents]

    def encode(self, resident: Resident, wire_id: str, segment: str) -> None:
        """Encode a segment's handle, fresh and stale, for reuse in every reply.

        Parameters
        ----------
        wire_id, segment
            Cell id and segment name, both without their prefixes.
        """
        handle = Handle(
            wire_id, resident.version, resident.key.layer, segment, 0, resident.nbytes, resident.points,
            *resident.box,
        )  # fmt: skip
        resident.handle = encode_handle(handle)
        resident.stale_handle = encode_handle(msgspec.structs.replace(handle, stale=True))

    def enter(self, resident: Resident, index: int, cells: int) -> None:
        """Enter a segment with its cell's current version; ``cells`` is the number of cells in the map."""
        layer = resident.key.layer
        found = self.layers.get(layer)
        if found is None:
            found = self.layers[layer] = ShardedDict()
        self._count += index not in found
        found[index] = resident
        table = self.tables.get(layer)
        if table is not None:
            table[index] = resident.version
        else:
            self._make_table(layer, cells)

    def _make_table(self, layer: str, cells: int) -> None:
        """Make a layer's table if there is room, or if a layer with a quarter as many segments has one."""
        found = self.layers[layer]
        if len(found).bit_count() != 1:
            return  # tried again when their number has doubled
        if len(self.tables) >= max(LEAST_TABLES, TABLES_BYTES // (8 * cells)):
            smallest = min(self.tables, key=lambda other: len(self.layers[other]))
            if 4 * len(self.layers[smallest]) > len(found):
                return
            del self.tables[smallest]
        table = self.tables[layer] = sparse_zeros(cells, np.uint64)
        for index, resident in found.items():
            table[index] = resident.version

    def note_version(self, resident: Resident) -> None:
        """Remember the cell and layer of a segment's version."""
        self.of_version[resident.version] = resident.key
        self.retired.pop(resident.version, None)

    def note_retired(self, resident: Resident) -> None:
        """Note that a segment is retired; its version is forgotten after `RETIRED_REMEMBERED` others."""
        self.retired[resident.version] = None
        if len(self.retired) > RETIRED_REMEMBERED:
            oldest, _ = self.retired.popitem(last=False)
            self.of_version.pop(oldest, None)

    def leave(self, index: int, layer: str) -> None:
        """Remove a cell whose version has changed, or whose segment is retired."""
        found = self.layers.get(layer)
        if found is None or found.pop(index, None) is None:
            return
        self._count -= 1
        table = self.tables.get(layer)
        if table is not None:
            table[index] = 0
        if not found:
            del self.layers[layer]
            self.tables.pop(layer, None)

    def successor(self) -> WarmIndex:
        """Return an empty index for a catalogue that numbers cells differently; known versions stay."""
        return WarmIndex(of_version=self.of_version, retired=self.retired)
