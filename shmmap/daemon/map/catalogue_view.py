# SPDX-License-Identifier: Apache-2.0
"""The cells of one state of the map, as requests see them: by index, whatever keeps the tables."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area
from shmmap.segment.version import Stamp

__all__ = ["CatalogueView"]


class CatalogueView(Protocol):
    """What the daemon asks of a catalogue (`shmmap.origin.catalogue.Catalogue` is one).

    Nothing here looks at a file: a stamp is what was known when the catalogue was made, or what a loader
    has found since.
    """

    def __len__(self) -> int:
        """How many cells there are."""

    @property
    def map_version(self) -> int:
        """64-bit version of the whole catalogue."""

    @property
    def frame_id(self) -> str:
        """Name of the map frame."""

    @property
    def id_prefix(self) -> str:
        """What all ids start with."""

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all cells, metres, map frame; None where there are none."""

    @property
    def mean_size(self) -> tuple[float, float]:
        """Mean extent of the cells along x and y, metres."""

    @property
    def boxes(self) -> NDArray[np.float64]:
        """(N, 4) float64, ``min_x, min_y, max_x, max_y``, metres, map frame."""

    def query(self, area: Area, most: int | None = None) -> NDArray[np.intp]:
        """Cells whose box touches ``area``, ascending (which is id order).

        If there are more than ``most``, some of them, more than ``most``, in no order.
        """

    def find(self, cell: str) -> int | None:
        """Index of a cell by its id or a unique base name; None where there is none."""

    def id(self, index: int) -> str:
        """Id of a cell."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def version(self, index: int) -> int:
        """64-bit version of a cell."""

    def stamp(self, index: int) -> Stamp:
        """Stamp of a cell's source as last known."""

    def source_bytes(self, index: int) -> int:
        """Size of a cell's source as last known."""
