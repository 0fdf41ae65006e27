# SPDX-License-Identifier: Apache-2.0
"""Versions of computed layers: the cell's own, and for a layer with a halo its neighbours' as well."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from xxhash import xxh3_64_intdigest

from shmmap.geometry import Area, Box
from shmmap.layers.spec import layer_spec

__all__ = ["MAX_NEIGHBOURS", "Cells", "LayerVersions"]

MAX_NEIGHBOURS: Final = 64
"""Most files that a layer with a halo reads beside its own."""
MOST_REMEMBERED: Final = 1 << 18
"""Versions, about 200 bytes each; whoever asks for ever new layers must not fill the daemon's memory."""


class Cells(Protocol):
    """What is asked of a map's catalogue: its cells by index."""

    def version(self, index: int) -> int:
        """64-bit version of a cell."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def query(self, area: Area) -> NDArray[np.intp]:
        """Cells whose box touches ``area``, ascending."""


@lru_cache(maxsize=4096)
def _halo_m(layer: str) -> float:
    """How far beyond a cell a layer looks, metres."""
    return layer_spec(layer).halo_m


class LayerVersions:
    """Answers for the layers of one daemon's map.

    Parameters
    ----------
    catalogue
        Returns the map's current catalogue.
    """

    def __init__(self, catalogue: Callable[[], Cells]) -> None:
        self._catalogue = catalogue
        self._versions: dict[tuple[int, str], int] = {}

    def version(self, index: int, layer: str) -> int:
        """Current version of one layer of a cell.

        It is the cell's own (`shmmap.origin.stamp.cell_version`) unless the layer has a halo: then
        the XXH3-64 of it and of the neighbours' versions in id order, as u64.
        """
        if not _halo_m(layer):
            return self._catalogue().version(index)
        version = self._versions.get((index, layer))
        if version is None:
            own = self._catalogue().version
            cells = [index, *self.neighbours(index, layer)]
            version = xxh3_64_intdigest(struct.pack(f"<{len(cells)}Q", *map(own, cells)))
            if len(self._versions) >= MOST_REMEMBERED:
                self._versions.clear()
            self._versions[index, layer] = version
        return version

    def neighbours(self, index: int, layer: str) -> list[int]:
        """Catalogue indices of the cells that a layer of this one looks into, ascending."""
        halo = _halo_m(layer)
        if not halo:
            return []
        min_x, min_y, max_x, max_y = self._catalogue().box(index)
        area = Box(min_x - halo, min_y - halo, max_x + halo, max_y + halo)
        return [found for found in self._catalogue().query(area).tolist() if found != index]

    def forget(self) -> None:
        """A stamp or the catalogue has changed."""
        self._versions.clear()
