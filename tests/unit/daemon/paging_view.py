# SPDX-License-Identifier: Apache-2.0
"""A map whose list of cells comes page by page, in memory: a partial catalogue, and an origin of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.map.catalogue_view import CatalogueView, PageNews, Pages, Ready
from shmmap.errors import Offline
from shmmap.geometry import Area
from shmmap.origin.catalogue import Catalogue, CatalogueChange
from shmmap.segment.version import Source, Stamp

Indices = NDArray[np.intp]


class MemoryPages:
    """Its pages: those that were wanted come when the test says so.

    Attributes
    ----------
    wanted : dict
        By page, the most urgent priority that it was wanted with, of those that are not here.
    needed : list
        Pages that are here, least recently needed first.
    most : int
        How many pages may be here.
    """

    def __init__(self, boxes: NDArray[np.float64], counts: Sequence[int], known: Iterable[int]) -> None:
        self.boxes, self._first = boxes, np.concatenate(([0], np.cumsum(counts))).tolist()
        self.fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.wanted: dict[int, float] = {}
        self.needed = sorted(known)
        self.most = len(boxes)
        self._lost: set[int] = set()
        self._come: list[int] = []
        self._out: list[int] = []

    def __del__(self) -> None:
        os.close(self.fd)

    def come(self, *pages: int) -> None:
        """Let these come, wanted or not."""
        self._come += pages
        os.eventfd_write(self.fd, 1)

    def fail(self, *pages: int) -> None:
        """Let these turn out to be out of reach."""
        self._out += pages
        os.eventfd_write(self.fd, 1)

    @property
    def settled(self) -> bool:
        """Whether the daemon has taken in what came."""
        return not self._come and not self._out

    def __len__(self) -> int:
        return len(self.boxes)

    def of_area(self, area: Area) -> Sequence[int]:
        found: list[int] = np.flatnonzero(area.overlaps(self.boxes)).tolist()
        return found

    def of_cell(self, index: int) -> int:
        return int(np.searchsorted(self._first, index, side="right")) - 1

    def cells(self, page: int) -> range:
        return range(self._first[page], self._first[page + 1])

    def cells_surely_in(self, area: Area) -> int:
        min_x, min_y, max_x, max_y = area.bounds
        low = (self.boxes[:, 0] >= min_x) & (self.boxes[:, 1] >= min_y)
        inside = low & (self.boxes[:, 2] <= max_x) & (self.boxes[:, 3] <= max_y)
        return sum(len(self.cells(page)) for page in np.flatnonzero(inside).tolist())

    @property
    def known_cells(self) -> int:
        return sum(len(self.cells(page)) for page in self.needed)

    @property
    def known_pages(self) -> int:
        return len(self.needed)

    def is_here(self, page: int) -> bool:
        return page in self.needed

    def is_out_of_reach(self, page: int) -> bool:
        return page in self._lost

    def want(self, pages: Iterable[int], priority: float) -> None:
        for page in pages:
            if page in self.needed:
                self.needed.remove(page)
                self.needed.append(page)
            else:
                self.wanted[page] = min(priority, self.wanted.get(page, priority))

    def want_nearest(self, place: tuple[float, float] | None) -> bool:
        """Fetch nothing that nothing needs."""
        del place
        return False

    def collect(self) -> PageNews:
        os.eventfd_read(self.fd)
        news = PageNews(tuple(self._come), tuple(self._out))
        self._come, self._out = [], []
        for page in news.come:
            self._lost.discard(page)
            self.wanted.pop(page, None)
            if page not in self.needed:
                self.needed.append(page)
        self._lost |= set(news.out_of_reach)
        return news

    def lacking(self, before: Pages) -> Sequence[int]:
        return [page for page in range(len(self)) if before.is_here(page) and not self.is_here(page)]

    def spare(self) -> int | None:
        return self.needed[0] if len(self.needed) > self.most else None

    def drop(self, page: int) -> None:
        self.needed.remove(page)


class PagedView:
    """One version of a map: `CatalogueView` by its methods, no `Catalogue`.

    Parameters
    ----------
    whole
        All cells there are.
    page_boxes
        (N, 4), of all pages: ``min_x, min_y, max_x, max_y``.  A cell is in the first page that its lower
        corner lies in; it may reach into others, so an area also asks pages one cell to the left and below.
    known
        Pages that are here.
    """

    frame_id: Final = "map"
    problems: Final = ()
    opened: Final = None

    def __init__(self, whole: Catalogue, page_boxes: NDArray[np.float64], known: Iterable[int]) -> None:
        self._whole = whole
        x, y = whole.boxes[:, 0, None], whole.boxes[:, 1, None]
        inside = (
            (page_boxes[:, 0] <= x)
            & (x < page_boxes[:, 2])
            & (page_boxes[:, 1] <= y)
            & (y < page_boxes[:, 3])
        )
        assert inside.any(axis=1).all(), "every cell has a page"
        page_of = inside.argmax(axis=1)
        self._in_whole: Indices = np.argsort(page_of, kind="stable")
        self._index: Indices = np.argsort(self._in_whole, kind="stable")
        counts = np.bincount(page_of, minlength=len(page_boxes)).tolist()
        reach = page_boxes.copy()
        for page in range(len(page_boxes)):  # as far as its cells do
            boxes = whole.boxes[page_of == page]
            if len(boxes):
                reach[page, 2:] = np.maximum(reach[page, 2:], boxes[:, 2:].max(axis=0))
        self.pages = MemoryPages(reach, counts, known)
        self.id_prefix: Final = whole.id_prefix
        self.frame: Final = whole.frame

    def _of(self, index: int) -> int:
        """Index in the whole map of a cell whose page is here."""
        if not self.pages.is_here(self.pages.of_cell(index)):
            raise KeyError(index)
        return int(self._in_whole[index])

    def __len__(self) -> int:
        return len(self._whole)

    @property
    def complete(self) -> bool:
        return len(self.pages.needed) == len(self.pages)

    @property
    def map_version(self) -> int:
        return self._whole.map_version

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        return self._whole.bounds

    @property
    def mean_size(self) -> tuple[float, float]:
        return self._whole.mean_size

    def query(self, area: Area, most: int | None = None) -> tuple[Indices, bool]:
        found = self._index[self._whole.query(area, most)[0]].tolist()
        known = [index for index in found if self.pages.is_here(self.pages.of_cell(index))]
        return np.array(known, np.intp), all(map(self.pages.is_here, self.pages.of_area(area)))

    def find(self, cell: str) -> int | None:
        found = self._whole.find(cell)
        index = int(self._index[found]) if found is not None else None
        return index if index is not None and self.pages.is_here(self.pages.of_cell(index)) else None

    def id(self, index: int) -> str:
        return self._whole.id(self._of(index))

    def box(self, index: int) -> tuple[float, float, float, float]:
        return self._whole.box(self._of(index))

    def boxes_of(self, indices: Indices) -> NDArray[np.float64]:
        return self._whole.boxes_of(np.array([self._of(index) for index in indices.tolist()], np.intp))

    def version(self, index: int) -> int:
        return self._whole.version(self._of(index))

    def source(self, index: int) -> Source:
        return self._whole.source(self._of(index))

    def stamp(self, index: int) -> Stamp:
        return self._whole.stamp(self._of(index))

    def source_bytes(self, index: int) -> int:
        return self._whole.source_bytes(self._of(index))

    def ready(self, index: int, layer: str) -> Ready | None:
        del index, layer
        return None

    def set_stamp(self, index: int, stamp: Stamp) -> None:
        self._whole.set_stamp(self._of(index), stamp)

    def changes_from(self, before: object) -> CatalogueChange:
        assert isinstance(before, PagedView)
        change = self._whole.changes_from(before._whole)
        both = set(self.pages.needed) & set(before.pages.needed)
        own, its = self._index, before._index
        known = all(
            view.pages.of_cell(int(order[index])) in both
            for indices, order, view in (
                (change.added, own, self), (change.removed, its, before), (change.changed, own, self),
                (change.moved, own, self),
            )
            for index in indices.tolist()
        )  # fmt: skip
        nothing = np.empty(0, np.intp)
        if not known:
            return CatalogueChange(
                before, self, nothing, nothing, nothing, nothing, same_numbers=False, known=False
            )
        same_numbers = change.same_numbers and np.array_equal(own, its)
        return CatalogueChange(
            before, self, np.sort(own[change.added]), np.sort(its[change.removed]),
            np.sort(own[change.changed]), np.sort(own[change.moved]), same_numbers,
        )  # fmt: skip

    def ids(self, indices: Indices) -> list[str]:
        return [self.id(index) for index in indices.tolist()]


class PagedOrigin:
    """A map in pages, of which a test says what is known at first.

    Attributes
    ----------
    whole
        The map as it is now; the next `load` has it.
    known
        Pages that are here in the first view; later ones have what the view before has.
    sharing
        Pages that a later view may have of the one before it.
    last
        The view that was loaded last.
    offline
        Whether it cannot be reached.
    """

    def __init__(self, whole: Catalogue, pages: NDArray[np.float64], known: Iterable[int]) -> None:
        self.whole, self._pages, self.known = whole, pages, set(known)
        self.sharing = set(range(len(pages)))
        self.last: PagedView | None = None
        self.offline = False
        self.path = whole.id_prefix

    def load(self, *, fresh: bool = False, before: object | None = None) -> CatalogueView:
        del fresh
        if self.offline:
            raise Offline(f"{self.path}: it does not answer")
        known = self.sharing & set(before.pages.needed) if isinstance(before, PagedView) else self.known
        self.last = PagedView(self.whole, self._pages, known)
        return self.last
