# SPDX-License-Identifier: Apache-2.0
"""The cells of one state of the map, as requests see them: by index, whatever keeps the tables.

**What a partial catalogue answers.**  Of a map whose list of cells comes in pages, a view (`CatalogueView`)
answers for the cells of the pages that are here, and its `Pages` say which there are and have others fetched.

- A view is one version of the map.  `map_version`, `len`, `bounds`, `mean_size`, `id_prefix` and `frame` are
  those of the whole version, known before any page is, and never change while it is served.
- A cell's index is the first index of its page (the counts of the pages before, summed) and its row there.
  So it is fixed, whatever comes or goes: that is no other state of the map, and no event says so.
- Rows, ``find`` and ``query`` answer for pages that are here.  To ask for a row of another page is a defect
  (`KeyError`): a page stays while it has a segment, a load, a pin, a request in the making or a session's
  area in it.  The daemon alone drops pages, when `Pages.spare` names one.
- ``query`` says whether all pages of the area are here; ``find`` of an id in no page that is here is None.
- Nothing waits: not for the network, not for a disk.  Pages are decoded elsewhere (a thread, say), and taken
  into the tables in `Pages.collect`, in the serving loop, in less than a millisecond each.
- Another version is another view: `ViewOrigin.load` returns it, in a thread, with what it can share of the
  view before, which goes on changing in the serving loop meanwhile.  It is held back until `Pages.lacking`
  says that nothing is missing where the view before knows cells; until then that one is served.  What differs
  is then asked of `changes_from`, as far as both know it, in the serving loop.
- What loads read is said by `source`.  A layer that the origin has ready made is not computed here: its size
  in memory and its version are those that `ready` gives, and it looks into no other cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from shmmap.geometry import Area
from shmmap.origin.catalogue_change import CatalogueChange
from shmmap.origin.map_layout import OpenedDirectories
from shmmap.origin.map_report import MapFrame
from shmmap.segment.version import Source, Stamp

__all__ = ["CatalogueView", "PageNews", "Pages", "Ready", "ViewOrigin"]


class Ready(NamedTuple):
    """A layer that the origin has ready made: its bytes in memory, and its version."""

    nbytes: int
    version: int


class PageNews(NamedTuple):
    """News of wanted pages: ``come`` are here, ``out_of_reach`` cannot be fetched at present."""

    come: Sequence[int]
    out_of_reach: Sequence[int]


class Pages(Protocol):
    """The pages of a map's list of cells, numbered from 0 in the order of their cells' indices.

    All is asked in the serving loop and answered at once.
    """

    @property
    def fd(self) -> int:
        """Readable when there are news: call `collect` then."""

    def __len__(self) -> int:
        """How many there are, here or not."""

    def of_area(self, area: Area) -> Sequence[int]:
        """Pages that may have cells which touch an area, here or not, ascending."""

    def of_cell(self, index: int) -> int:
        """Return the page of a cell."""

    def cells(self, page: int) -> range:
        """Return the indices of a page's cells, here or not."""

    def cells_surely_in(self, area: Area) -> int:
        """How many cells the pages have that lie wholly in an area: it has as many at least."""

    @property
    def known_cells(self) -> int:
        """How many cells the pages have that are here."""

    @property
    def known_pages(self) -> int:
        """How many pages are here."""

    def is_here(self, page: int) -> bool:
        """Whether the page's cells are known."""

    def is_out_of_reach(self, page: int) -> bool:
        """Whether it could not be fetched when it was last tried: no request waits for it.

        It is tried again by itself, after a while; when it comes, that is news like any other.
        """

    def want(self, pages: Iterable[int], priority: float) -> None:
        """Fetch pages, those with the lowest ``priority`` first, as loads have it.

        That is metres from a client that asks, `shmmap.daemon.loading.loads.PREFETCH` and seconds for what
        one will ask for.  A page that is wanted already only moves forward; one that is here counts as just
        needed.
        """

    def collect(self) -> PageNews:
        """Take in what has come since the last time."""

    def lacking(self, before: Pages) -> Sequence[int]:
        """Pages that are not here, and that lie where the version ``before`` has some that are."""

    def spare(self) -> int | None:
        """Return the page that was needed least recently, if they take more memory than they may.

        This is asked at every turn of the loop: it must cost nothing.
        """

    def drop(self, page: int) -> None:
        """Forget a page's cells."""


class CatalogueView(Protocol):
    """What the daemon asks of a catalogue (`shmmap.origin.catalogue.Catalogue` is one).

    Nothing here looks at a file or asks a server: a stamp is what was known when the catalogue was made, or
    what a loader has found since.
    """

    def __len__(self) -> int:
        """How many cells the map has, known or not."""

    @property
    def pages(self) -> Pages | None:
        """The map's pages; None where all cells are known from the beginning."""

    @property
    def complete(self) -> bool:
        """Whether all cells of the map are known."""

    @property
    def map_version(self) -> int:
        """64-bit version of the whole catalogue."""

    @property
    def id_prefix(self) -> str:
        """What all ids start with."""

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
        """Directories that its cells are to be read through; None: their sources have to do."""

    def query(self, area: Area, most: int | None = None) -> tuple[NDArray[np.intp], bool]:
        """Known cells whose box touches ``area``, in id order, and whether these are all.

        Where all cells are known, id order is that of the indices.  If there are more than ``most``, some of
        them, more than ``most``, in no order.
        """

    def find(self, cell: str) -> int | None:
        """Index of a cell by its id or a unique base name; None where there is none, or none known."""

    def id(self, index: int) -> str:
        """Id of a cell."""

    def box(self, index: int) -> tuple[float, float, float, float]:
        """``min_x, min_y, max_x, max_y`` of a cell, metres, map frame."""

    def boxes_of(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        """(K, 4) float64, boxes of these cells."""

    def version(self, index: int) -> int:
        """64-bit version of a cell."""

    def source(self, index: int) -> Source:
        """Where a cell's points come from, for loaders."""

    def stamp(self, index: int) -> Stamp:
        """Stamp of a cell's source as last known."""

    def source_bytes(self, index: int) -> int:
        """Size of a cell's source as last known."""

    def ready(self, index: int, layer: str) -> Ready | None:
        """Return what is known of a layer that the origin has ready made; None: it is computed here.

        Of ``points`` it may be None, too: where their size is only guessed, and their version is `version`.
        """

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        """Correct a cell's stamp: a loader has found another one; versions follow."""

    def changes_from(self, before: CatalogueView) -> CatalogueChange:
        """Find what differs from an earlier state, as far as both know it."""


class ViewOrigin(Protocol):
    """What views come from (`shmmap.origin.catalogue.MapOrigin` is one)."""

    @property
    def path(self) -> str:
        """The map as a person would name it."""

    def load(self, *, fresh: bool = False, before: object | None = None) -> CatalogueView:
        """Find out which cells are known now; errors are those of `MapOrigin.load`.

        What has not changed since ``before``, an earlier view, may be shared with it.
        """
