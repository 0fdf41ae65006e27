# SPDX-License-Identifier: Apache-2.0
"""View of the cells of one state of the map: access by index, however the tables are stored.

**Partial catalogues.**  If a map's list of cells is paged, its view (`CatalogueView`) answers for the cells
of the pages in memory.  Its `Pages` list all pages and fetch missing ones.

- A view is one version of the map.  `map_version`, `len`, `bounds`, `mean_size`, `id_prefix` and `frame`
  describe the complete version; they are known before any page and do not change while the view is served.
- A cell's index is the first index of its page (the sum of the counts of the pages before) plus its row.  So
  it is fixed, whichever pages are in memory: loading or dropping a page is no new state and causes no event.
- Rows, ``find`` and ``query`` answer for pages in memory.  Asking for a row of another page is a defect
  (`KeyError`): a page stays while one of its cells has a segment, a load, a pin, a request being answered or
  a session's area in it.  Only the daemon drops pages, when `Pages.spare` names one.
- ``query`` reports whether all pages of the area are in memory; ``find`` returns None for an id on a missing
  page.
- Nothing blocks on the network or a disk.  Pages are decoded elsewhere (in a thread, for example) and merged
  into the tables by `Pages.collect`, in the serving loop, in less than a millisecond each.
- Another version is another view.  `ViewOrigin.load` returns it, in a thread, and shares what it can with the
  previous view, which the serving loop keeps changing.  The new view is held back until `Pages.lacking`
  reports no missing page where the previous view knows cells; until then the previous view is served.  Then
  the serving loop calls `changes_from` for the difference, as far as both views know their cells.
- `source` names what loads read.  A layer that the origin has ready-made is not computed here: `ready` gives
  its size in memory and its version, and it reads no other cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area
from shmmap.origin.catalogue import CatalogueChange
from shmmap.origin.map_layout import OpenedDirectories
from shmmap.origin.map_report import MapFrame
from shmmap.segment.version import Source, Stamp


class Ready(NamedTuple):
    """A layer that the origin has ready-made: its bytes in memory, and its version."""

    nbytes: int
    version: int


class PageNews(NamedTuple):
    """Results for wanted pages: ``come`` are in memory now, ``out_of_reach`` cannot be fetched at present."""

    come: Sequence[int]
    out_of_reach: Sequence[int]


class Pages(Protocol):
    """The pages of a map's list of cells, numbered from 0 in the order of their cells' indices.

    All methods are called in the serving loop and return at once.
    """

    @property
    def fd(self) -> int:
        """Readable when there are results: call `collect` then."""

    def __len__(self) -> int:
        """Return the number of pages, in memory or not."""

    def of_area(self, area: Area) -> Sequence[int]:
        """Return pages that may have cells which intersect an area, in memory or not, ascending."""

    def of_cell(self, index: int) -> int:
        """Return the page of a cell."""

    def cells(self, page: int) -> range:
        """Return the indices of a page's cells, in memory or not."""

    def cells_surely_in(self, area: Area) -> int:
        """Return how many cells are on pages wholly in an area: a lower bound of the area's cells."""

    @property
    def known_cells(self) -> int:
        """Number of cells on pages in memory."""

    @property
    def known_pages(self) -> int:
        """Number of pages in memory."""

    def is_here(self, page: int) -> bool:
        """Whether a page is in memory."""

    def is_out_of_reach(self, page: int) -> bool:
        """Whether the last attempt to fetch a page failed: requests do not wait for it.

        The page is fetched again automatically after a while; its arrival is reported like any other.
        """

    def want(self, pages: Iterable[int], priority: float) -> None:
        """Fetch pages, those with the lowest ``priority`` first, with priorities as for loads.

        The priority is the distance from the asking client in metres, or for prefetching
        `shmmap.daemon.loading.loads.PREFETCH` plus seconds.  A page that is already wanted only moves
        forward; a page in memory counts as just needed.
        """

    def want_nearest(self, place: tuple[float, float] | None) -> bool:
        """Fetch the missing page that is nearest to a place; return whether one is begun."""

    def collect(self) -> PageNews:
        """Merge pages that have arrived since the last call."""

    def lacking(self, before: Pages) -> Sequence[int]:
        """Return the missing pages in the places where the version ``before`` has pages in memory."""

    def spare(self) -> int | None:
        """Return the page that was needed least recently if pages exceed their memory limit, else None.

        This is called in every turn of the loop, so it must be cheap.
        """

    def drop(self, page: int) -> None:
        """Forget a page's cells."""


class CatalogueView(Protocol):
    """Interface of a catalogue for the daemon (`shmmap.origin.catalogue.Catalogue` implements it).

    No method accesses a file or a server: a stamp is the one known when the catalogue was made, or one that a
    loader has found since.
    """

    def __len__(self) -> int:
        """Return the number of cells in the map, known or not."""

    @property
    def pages(self) -> Pages | None:
        """The map's pages; None if all cells are known from the beginning."""

    @property
    def complete(self) -> bool:
        """Whether all cells of the map are known."""

    @property
    def map_version(self) -> int:
        """64-bit version of the whole catalogue."""

    @property
    def id_prefix(self) -> str:
        """Common prefix of all ids."""

    @property
    def frame_id(self) -> str:
        """Name of the map frame."""

    @property
    def frame(self) -> MapFrame:
        """Position of the map frame in the world."""

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """Box around all cells, metres, map frame; None if there are no cells."""

    @property
    def mean_size(self) -> tuple[float, float]:
        """Mean extent of the cells along x and y, metres."""

    @property
    def problems(self) -> Sequence[str]:
        """Oddities found while reading the map, one sentence each."""

    @property
    def opened(self) -> OpenedDirectories | None:
        """Directories through which its cells are read; None: the sources' paths are used."""

    def query(self, area: Area, most: int | None = None) -> tuple[NDArray[np.intp], bool]:
        """Return known cells whose box intersects ``area``, in id order, and whether these are all.

        If all cells are known, id order is index order.  If there are more than ``most``, the result is some
        of them, more than ``most``, unordered.
        """

    def find(self, cell: str) -> int | None:
        """Return a cell's index by its id or a unique base name; None if no such cell is known."""

    def id(self, index: int) -> str:
        """Return the id of a cell."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Return ``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def boxes_of(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the boxes of these cells, (K, 4) float64."""

    def version(self, index: int) -> int:
        """Return the 64-bit version of a cell."""

    def source(self, index: int) -> Source:
        """Return the source of a cell's points, for loaders."""

    def stamp(self, index: int) -> Stamp:
        """Return the last known stamp of a cell's source."""

    def source_bytes(self, index: int) -> int:
        """Return the last known size of a cell's source."""

    def ready(self, index: int, layer: str) -> Ready | None:
        """Return size and version of a layer that the origin has ready-made; None if it is computed here.

        For ``points`` it may also be None if their size is only estimated; their version is then `version`.
        """

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        """Replace a cell's stamp by the one that a loader found; versions follow."""

    def changes_from(self, before: CatalogueView) -> CatalogueChange:
        """Return the difference from an earlier state, as far as both know their cells."""


class ViewOrigin(Protocol):
    """Source of views: a map's files, a cloud, or a published map."""

    @property
    def path(self) -> str:
        """The map's name for people."""

    def load(self, *, fresh: bool = False, before: object | None = None) -> CatalogueView:
        """Load the cells that are known now.

        ``fresh`` reads every file's stamp instead of using a cached catalogue.  Parts that have not changed
        since ``before``, an earlier view, may be shared with it.

        Raises
        ------
        MapMissing, MapDataError
            The map does not exist, or cannot be served.
        Offline
            The map's storage cannot be reached at present.
        """
