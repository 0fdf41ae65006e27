# SPDX-License-Identifier: Apache-2.0
"""The cells of one state of the map, as requests see them: by index, whatever keeps the tables.

Of a map that comes in pages, a view has the cells that are known by now.  Where it knows all of an area it
says so.  More cells are another state of the map: a reload brings a view that has them, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area
from shmmap.origin.catalogue_change import Tables
from shmmap.origin.map_frame import MapFrame
from shmmap.origin.opened_directories import OpenedDirectories
from shmmap.segment.version import Stamp

__all__ = ["CatalogueView", "ViewOrigin"]


class CatalogueView(Tables, Protocol):
    """What the daemon asks of a catalogue (`shmmap.origin.catalogue.Catalogue` is one).

    Nothing here looks at a file or asks a server: a stamp is what was known when the catalogue was made, or
    what a loader has found since.
    """

    def __len__(self) -> int:
        """How many cells there are."""

    @property
    def map_version(self) -> int:
        """64-bit version of the whole catalogue: another one when more cells are known."""

    @property
    def complete(self) -> bool:
        """Whether all cells of the map are known."""

    @property
    def frame_id(self) -> str:
        """Name of the map frame."""

    @property
    def frame(self) -> MapFrame:
        """Where the map frame lies in the world."""

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all cells, metres, map frame; None where there are none."""

    @property
    def mean_size(self) -> tuple[float, float]:
        """Mean extent of the cells along x and y, metres."""

    @property
    def problems(self) -> Sequence[str]:
        """Oddities found while reading the map, one sentence each."""

    @property
    def opened(self) -> OpenedDirectories | None:
        """Directories that its cells are to be read through; None: their paths have to do."""

    def query(self, area: Area, most: int | None = None) -> tuple[NDArray[np.intp], bool]:
        """Cells whose box touches ``area``, ascending (which is id order), and whether these are all.

        If there are more than ``most``, some of them, more than ``most``, in no order.
        """

    def find(self, cell: str) -> int | None:
        """Index of a cell by its id or a unique base name; None where there is none, or none known."""

    def id(self, index: int) -> str:
        """Id of a cell."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def version(self, index: int) -> int:
        """64-bit version of a cell."""

    def path(self, index: int) -> str:
        """What a loader reads for a cell."""

    def stamp(self, index: int) -> Stamp:
        """Stamp of a cell's source as last known."""

    def source_bytes(self, index: int) -> int:
        """Size of a cell's source as last known."""

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        """Correct a cell's stamp: a loader has found another one; versions follow."""


class ViewOrigin(Protocol):
    """What views come from (`shmmap.origin.map_origin.MapOrigin` is one)."""

    @property
    def path(self) -> str:
        """The map as a person would name it."""

    def load(self, *, fresh: bool = False, before: Tables | None = None) -> CatalogueView:
        """Find out which cells are known now; errors are those of `MapOrigin.load`."""
