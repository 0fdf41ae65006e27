# SPDX-License-Identifier: Apache-2.0
"""The cells that are in memory at their current version: what is answered without a load."""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.records import Resident
from shmmap.protocol.codec import encode_handle
from shmmap.protocol.messages import Handle

__all__ = ["WarmIndex"]


@dataclass(eq=False, slots=True)
class WarmIndex:
    """The same twice: to be looked up one by one, and a whole area at once.

    Attributes
    ----------
    layers : dict
        Per layer, catalogue index to resident segment.
    versions : dict
        Per layer, (cells,) uint64: the version, 0 where the cell is not in memory.
    """

    layers: dict[str, dict[int, Resident]] = field(default_factory=dict)
    versions: dict[str, NDArray[np.uint64]] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum(map(len, self.layers.values()))

    def get(self, index: int, layer: str) -> Resident | None:
        """The segment of a cell, if it is warm."""
        found = self.layers.get(layer)
        return found.get(index) if found is not None else None

    def encode(self, resident: Resident, wire_id: str, segment: str) -> None:
        """Encode a segment's handle once, fresh and stale, to be used in every reply.

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
        """A segment has the current version of its cell, one of so many ``cells`` of the map."""
        layer = resident.key.layer
        self.layers.setdefault(layer, {})[index] = resident
        versions = self.versions.get(layer)
        if versions is None:
            versions = self.versions[layer] = np.zeros(cells, np.uint64)
        versions[index] = resident.version

    def leave(self, index: int, layer: str) -> None:
        """The cell has another version now, or its segment is retired."""
        found = self.layers.get(layer)
        if found is None or found.pop(index, None) is None:
            return
        self.versions[layer][index] = 0
        if not found:  # whoever asks for ever new layers must not fill the daemon's memory
            del self.layers[layer], self.versions[layer]

    def clear(self) -> None:
        """Indices mean other cells from now on."""
        self.layers.clear()
        self.versions.clear()
