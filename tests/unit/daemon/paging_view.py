# SPDX-License-Identifier: Apache-2.0
"""A map whose cells become known page by page, and an origin that may be out of reach."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.map.catalogue_view import CatalogueView, Ready
from shmmap.errors import Offline
from shmmap.geometry import Area, Box
from shmmap.origin.catalogue import Catalogue
from shmmap.origin.catalogue_change import CatalogueChange
from shmmap.segment.source import Source
from shmmap.segment.version import Stamp

__all__ = ["PagingOrigin", "PagingView"]

Indices = NDArray[np.intp]


class PagingView:
    """The cells of the pages that are known; `CatalogueView` by its methods, no `Catalogue`.

    Parameters
    ----------
    whole
        All cells there are.
    pages
        (N, 4) all pages: ``min_x, min_y, max_x, max_y``; every cell touches one.
    known
        Which of them are known.
    """

    frame_id: Final = "map"

    def __init__(self, whole: Catalogue, pages: NDArray[np.float64], known: frozenset[int]) -> None:
        self._pages = pages
        self._known = known
        indices = sorted({i for page in known for i in whole.query(Box(*pages[page].tolist()))[0].tolist()})
        self._cells = Catalogue(
            id_prefix=whole.id_prefix,
            names=whole.names[indices],
            boxes=whole.boxes[indices],
            stamps=whole.stamps[indices],
        )
        self.id_prefix: Final = whole.id_prefix
        self.problems: Final = ()
        self.pages: Final = None
        self.tables: Final = None
        self.opened: Final = None
        self.frame: Final = whole.frame

    @property
    def complete(self) -> bool:
        return len(self._known) == len(self._pages)

    def query(self, area: Area, most: int | None = None) -> tuple[Indices, bool]:
        needed = np.flatnonzero(area.overlaps(self._pages)).tolist()
        return self._cells.query(area, most)[0], self._known.issuperset(needed)

    def __len__(self) -> int:
        return len(self._cells)

    @property
    def map_version(self) -> int:
        return self._cells.map_version

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        return self._cells.bounds

    @property
    def mean_size(self) -> tuple[float, float]:
        return self._cells.mean_size

    def source_bytes(self, index: int) -> int:
        return self._cells.source_bytes(index)

    def boxes_of(self, indices: Indices) -> NDArray[np.float64]:
        return self._cells.boxes_of(indices)

    def ready(self, index: int, layer: str) -> Ready | None:
        del index, layer
        return None

    def changes_from(self, before: object) -> CatalogueChange:
        assert isinstance(before, PagingView)
        return self._cells.changes_from(before._cells)

    def find(self, cell: str) -> int | None:
        return self._cells.find(cell)

    def id(self, index: int) -> str:
        return self._cells.id(index)

    def box(self, index: int) -> tuple[float, float, float, float]:
        return self._cells.box(index)

    def version(self, index: int) -> int:
        return self._cells.version(index)

    def source(self, index: int) -> Source:
        return self._cells.source(index)

    def stamp(self, index: int) -> Stamp:
        return self._cells.stamp(index)

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        self._cells.set_stamp(index, stamp)


class PagingOrigin:
    """Knows a map's pages as far as a test says.

    Attributes
    ----------
    known
        Pages that the next `load` knows.
    offline
        Whether it cannot be reached.
    """

    def __init__(self, whole: Catalogue, pages: NDArray[np.float64], known: set[int]) -> None:
        self._whole = whole
        self._pages = pages
        self.known = known
        self.offline = False
        self.path = whole.id_prefix

    def load(self, *, fresh: bool = False, before: object | None = None) -> CatalogueView:
        del fresh, before
        if self.offline:
            raise Offline(f"{self.path}: it does not answer")
        return PagingView(self._whole, self._pages, frozenset(self.known))
