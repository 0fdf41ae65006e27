# SPDX-License-Identifier: Apache-2.0
"""Pages of the map's list of cells: pass on those that have arrived, and drop those that nothing needs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.cache.map_switch import MapSwitch
from shmmap.daemon.loading.adoption import Adoption
from shmmap.daemon.loading.loads import BACKGROUND
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_view import CatalogueView, Pages
from shmmap.daemon.requests.cell_requests import CellRequests
from shmmap.daemon.requests.map_queries import MapQueries
from shmmap.daemon.transport.sessions import Sessions
from shmmap.daemon.turns import WatchedDescriptors

FILL_S: Final = 0.25
"""Interval of looking whether the link is idle while pages are missing, seconds."""
KEPT_S: Final = 0.02
"""Pause after a page that has to stay: one check takes about a millisecond."""
MAX_RETIRED: Final = 20_000
"""Retired segments examined; if there are more, no page is dropped."""


@dataclass(eq=False, slots=True)
class Paging:
    """Reports pages that have arrived, or cannot be fetched, and drops pages that nothing needs.

    While the link is idle, no request waits and a client has asked for something, pages that nothing needs
    yet are fetched, too.

    A page is needed while one of its cells has a segment, a load or a pin, or while an unanswered request or
    a session's area may have cells in it.  This class is a background task of the serving loop.
    """

    cache: CellCache
    scheduler: Scheduler
    map_switch: MapSwitch
    cells: CellRequests
    queries: MapQueries
    adoption: Adoption
    sessions: Sessions
    watched: WatchedDescriptors
    _fd: int = -1
    _coming_fd: int = -1
    _was_out_of_reach: bool = False
    _rests_until_s: float = -math.inf
    _fill_s: float = -math.inf
    _turn: int = 0

    def follow(self) -> None:
        """Switch to the pages of the map that is served from now on."""
        self._stop_following_the_next()
        if self._fd >= 0:
            self.watched.unwatch(self._fd)
            self.cells.map_changed()
            self.adoption.map_changed(time.monotonic())
        pages = self.cache.pages
        self._fd = pages.fd if pages is not None else -1
        if self._fd >= 0:
            self.watched.watch(self._fd, self.collect, "map")

    def is_ready(self, new: CatalogueView, try_again: Callable[[], None]) -> bool:
        """Return whether a new state of the map has all pages that the served state has.

        Otherwise fetch the missing pages, and call ``try_again`` when some have arrived.
        """
        self._stop_following_the_next()
        pages, served = new.pages, self.cache.pages
        lacking = pages.lacking(served) if pages is not None and served is not None else ()
        if pages is None or not lacking:
            return True

        def come() -> None:
            if pages.collect().come:
                try_again()

        self._coming_fd = pages.fd
        self.watched.watch(self._coming_fd, come, "map")
        pages.want(lacking, 0.0)
        return False

    def _stop_following_the_next(self) -> None:
        if self._coming_fd >= 0:
            self.watched.unwatch(self._coming_fd)
        self._coming_fd = -1

    def collect(self) -> None:
        """Start the work that waited for pages which have arrived, or cannot be fetched."""
        pages = self.cache.pages
        if pages is None:
            return
        news = pages.collect()
        if news.come and self._was_out_of_reach:  # loads that failed for lack of a page may succeed now
            self.scheduler.loads.forget_failures()
        self._fill_s = -math.inf
        self._was_out_of_reach = bool(news.out_of_reach) or (self._was_out_of_reach and not news.come)
        if news.come:
            self.adoption.pages_came(news.come, time.monotonic())
            layers, ledger = self.cache.layers, self.cache.ledger
            if layers.halo_m(ledger.layers()):
                self.map_switch.recheck()
        self.cells.pages_finished(news)
        self.scheduler.pages_finished()
        if news.come or news.out_of_reach:
            self.queries.pages_finished(time.monotonic())

    # --- a background task of the loop ------------------------------------------------------------

    @property
    def next_s(self) -> float:
        """When a page may have to be dropped, or a metadata request times out."""
        pages = self.cache.pages
        if pages is None:
            return math.inf
        spare = pages.spare() is not None
        drop_s = self._rests_until_s if spare else math.inf
        fills = not spare and len(self.sessions) and not self.cache.catalogue.complete
        return min(drop_s, self.queries.next_deadline_s, self._fill_s if fills else math.inf)

    def run_step(self, now_s: float) -> None:
        """Drop one page if there are too many and nothing needs it, or fetch one if the link is idle."""
        self.queries.answer_overdue(now_s)
        pages = self.cache.pages
        if pages is None:
            return
        self._fill(pages, now_s)
        page = pages.spare() if now_s >= self._rests_until_s else None
        if page is None:
            return
        if self.is_needed(page):
            pages.want((page,), BACKGROUND)  # move it to the end: the next step checks another page
            self._rests_until_s = now_s + KEPT_S
        else:
            pages.drop(page)
            self.scheduler.prefetcher.restart()

    def _fill(self, pages: Pages, now_s: float) -> None:
        """Fetch a page that nothing needs yet, near to one of the clients, if nothing else uses the link."""
        link = self.scheduler.link
        if now_s < self._fill_s or not len(self.sessions) or pages.spare() is not None:
            return
        self._fill_s = now_s + FILL_S
        is_waited_for = len(self.cells) > 0 or len(self.scheduler.loads) > 0
        if is_waited_for or (link is not None and not link.is_idle(now_s)):
            return
        if not any(session.requests for session in self.sessions):
            return  # what a new client asks for comes first
        areas = [session.area for session in self.sessions if session.area is not None]
        place = None
        if areas:
            min_x, min_y, max_x, max_y = areas[self._turn % len(areas)].bounds
            place = 0.5 * (min_x + max_x), 0.5 * (min_y + max_y)
            self._turn += 1
        pages.want_nearest(place)

    def is_needed(self, page: int) -> bool:
        """Whether a page has to stay in memory."""
        cache, ledger, catalogue, pages = (
            self.cache,
            self.cache.ledger,
            self.cache.catalogue,
            self.cache.pages,
        )
        if pages is None or len(ledger.retired) > MAX_RETIRED or self.cells.uses(page):
            return True
        for session in self.sessions:
            if session.area is not None and page in cache.pages_around(session.area, session.layers):
                return True
        ids = set(map(catalogue.id, pages.cells(page)))
        in_memory = (one.resident.key.cell_id for one in ledger.retired.values())
        return (
            any(key.cell_id in ids for key in self.scheduler.loads.by_key)
            or any(key.cell_id in ids for key in ledger.needed())
            or not ids.isdisjoint(in_memory)
            or any(map(ledger.of_cell, ids))
        )
