# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A request first becomes a `PendingRequest`: which cells in which order, minus what the client holds.  If all
of it is warm the answer leaves at once.  Otherwise loads are queued, nearest cells first, and the
answer (`cell_replies`) leaves when the last one settled or the client's patience ends, whichever is
first.  What concerns many cells is done in parts, a turn of the loop each.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_view import PageNews
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.requests import limits
from shmmap.daemon.requests.cell_replies import Answer, CellReplies
from shmmap.daemon.requests.differential import lacking, warm_difference
from shmmap.daemon.requests.pending_request import (
    LOADS_A_STEP,
    MapChanged,
    PendingRequest,
    WaitingList,
    parts,
)
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest, ShmmapError
from shmmap.geometry import Area
from shmmap.protocol import messages

__all__ = ["CellRequests"]

MAX_WAIT_S: Final = 3600.0
MOST_AT_ONCE: Final = 4096
"""Cells of an area that are compared with what a client holds in one turn, if all are in memory."""
MOST_LOOKED_AT: Final = 20_000
"""Cells of requests that are looked through before a page of the map is given up."""
PACKED_A_CELL: Final = 256
HELD_A_CELL: Final = 2
"""Bytes of packed versions, and cells held by name, of a request that waits: they take a cell's memory."""

Result = TypeVar("Result")


class CellRequests:
    """Answers requests for cells from the cache, and has loaded what is absent.

    Parameters
    ----------
    quota_bytes
        Most bytes one session may keep that no other session also holds.
    due
        Given a connection and what answers it, to be done in its process's turns.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self,
        cache: CellCache,
        scheduler: Scheduler,
        *,
        quota_bytes: int,
        due: Callable[[Connection, Iterator[None]], None],
        clock: Callable[[], float],
    ) -> None:
        self._cache = cache
        self._scheduler = scheduler
        self._statistics = cache.statistics
        self._due = due
        self._now_s = clock
        self._quota = limits.SessionQuota(quota_bytes, cache, clock)
        self._answers = CellReplies(cache, scheduler)
        self._open: dict[PendingRequest, None] = {}  # that are not answered yet
        self._patient = WaitingList(cache.ledger, self._answer_in_turn, self.let_go)

    def __len__(self) -> int:
        return len(self._patient)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area) -> Iterator[None]:
        """All cells that touch an area."""
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        layers = limits.admitted_layers(self._cache, message.layers)
        _note_area(session, area, layers)

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            found = self._known(wanted, area, layers)
            indices = self._cache.at_height(found.tolist(), area.z)
            wanted.cells = [(index, layer) for index in indices for layer in layers]
            yield from ()  # all at once

        wanted = PendingRequest(session, message.request, limits.layers_named(message), find, area)
        return self._serve(wanted, message.wait)

    def selected(self, session: Session, message: messages.Selected) -> Iterator[None]:
        """Cells by id, in the order asked for."""
        _check_wait(message.wait)
        cache = self._cache
        layers = limits.admitted_layers(cache, message.layers)
        limits.check_count(len(message.ids) * len(layers))

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            for number, ids in enumerate(parts(message.ids)):
                if number:
                    yield from wanted.pause(cache)
                indices = [cache.index_of(cell_id) for cell_id in ids]
                wanted.cells += [(index, layer) for index in indices if index is not None for layer in layers]
                absent = [cell_id for cell_id, index in zip(ids, indices, strict=True) if index is None]
                wanted.unknown += [(cell_id, layer) for cell_id in absent for layer in layers]
            wanted.covered = not wanted.unknown or cache.catalogue.complete

        wanted = PendingRequest(
            session, message.request, limits.layers_named(message), find, message_cells=len(message.ids)
        )
        return self._serve(wanted, message.wait)

    def differential(self, session: Session, message: messages.Differential) -> Iterator[None]:
        """Cells that touch an area, minus those the client holds."""
        limits.check_held(message)
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        cache = self._cache
        layers = limits.admitted_layers(cache, message.layers)
        _note_area(session, area, layers)
        found, covered = cache.catalogue.query(area, limits.MOST_CELLS)
        looks_around = cache.catalogue.pages is not None and cache.layers.halo_m(layers) > 0.0
        is_one = len(layers) == 1 and area.z is None
        if is_one and covered and not looks_around and len(found) <= MOST_AT_ONCE:
            warm = warm_difference(cache, message, found, layers[0])
            if warm is not None and self._quota.has_room(session, warm.residents):
                answer = Answer([resident.handle for resident in warm.residents], warm.residents)
                self._answers.reply(
                    session, message.request, answer, limits.layers_named(message),
                    removed=warm.removed, removed_packed=warm.removed_packed,
                )  # fmt: skip
                # the bookkeeping can wait until the answer is out
                self._statistics.add("hits", len(answer.handles))
                return self._answers.hand_out(session, answer, self._now_s())

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            return lacking(cache, message, self._known(wanted, area, layers), layers, wanted)

        held_cells = len(message.packed) // PACKED_A_CELL + len(message.held) // HELD_A_CELL
        wanted = PendingRequest(
            session, message.request, limits.layers_named(message), find, area, held_cells
        )
        return self._serve(wanted, message.wait)

    def _known(self, wanted: PendingRequest, area: Area, layers: tuple[str, ...]) -> NDArray[np.intp]:
        """Find the known cells of an area; note whether these are all, and which pages may have others.

        A layer that looks into the cells around needs the pages of these, too.

        Raises
        ------
        BadRequest
            They are too many.
        """
        catalogue = self._cache.catalogue
        pages = catalogue.pages
        if pages is not None:
            limits.check_count(pages.cells_surely_in(area) * len(layers))
        found, wanted.covered = catalogue.query(area, limits.MOST_CELLS)
        limits.check_count(len(found) * len(layers))
        if pages is not None:
            needed = pages.of_area(area.around(*area.center, self._cache.layers.halo_m(layers)))
            absent = [page for page in needed if not pages.is_here(page)]
            wanted.covered = not absent
            wanted.pages = {page for page in absent if not pages.is_out_of_reach(page)}
            wanted.reason = "offline" if len(wanted.pages) < len(absent) else ""
            pages.want(needed, 0.0)
        return found

    def let_go(self, residents: Iterable[Resident]) -> None:
        """Somebody dropped these."""
        self._scheduler.room.release(residents, self._now_s())

    # --- loading and waiting --------------------------------------------------------------------

    def _serve(self, wanted: PendingRequest, wait_s: float | None) -> Iterator[None]:
        """Answer a request, or have loaded what is cold of it and let it wait."""
        waits = False
        self._open[wanted] = None
        try:
            waits = yield from self._on_one_map(wanted, lambda: self._begin(wanted, wait_s))
            if not waits:
                yield from self._answer(wanted)
        finally:
            if not waits:
                self._end(wanted)

    def _end(self, wanted: PendingRequest) -> None:
        self._open.pop(wanted, None)
        self._patient.let_go(wanted)

    def _begin(self, wanted: PendingRequest, wait_s: float | None) -> Generator[None, None, bool]:
        """Have loaded what is cold of what was found; whether the request waits for that, or for more."""
        now_s = self._now_s()
        may_wait = bool(wait_s) and self._patient.has_room(wanted)
        yield from self._have_loaded(wanted, note=may_wait)
        wanted.is_new = False
        if not (may_wait and wanted.waits):
            return False
        yield from self._need(wanted)
        wanted.began_s, wanted.deadline_s = now_s, now_s + (wait_s or 0.0)
        self._patient.add(wanted)
        self._wait_for_pages(wanted)
        if wanted.outdated or not wanted.waits:  # they came while the rest was gone through
            self._answer_in_turn(wanted)
        return True

    def _have_loaded(self, wanted: PendingRequest, *, note: bool) -> Iterator[None]:
        """Find what is warm and have the rest loaded; ``note`` what is, so that its end is noticed."""
        cache, warm, now_s = self._cache, self._cache.warm.layers, self._now_s()
        wanted.refused.clear()
        cold: list[tuple[int, str]] = []
        sizes: list[int] = []
        for number, part in enumerate(parts(wanted.cells)):
            if number:
                yield from wanted.pause(cache)
            for index, layer in part:
                resident = warm[layer].get(index) if layer in warm else None
                if resident is None:
                    resident = cache.find_warm(index, layer, now_s)
                if resident is None:
                    cold.append((index, layer))
                sizes.append(cache.estimate(index, layer) if resident is None else resident.nbytes)
        if not wanted.began_s:
            self._statistics.add("hits", len(wanted.cells) - len(cold))
        yield from self._quota.check(wanted, sizes)
        if cold:
            yield from limits.check_queue(cache, self._scheduler.loads, wanted, cold)
            self._statistics.add("misses", len(cold) * (not wanted.began_s))
            yield from self._load(wanted, cold, note=note)

    def _need(self, wanted: PendingRequest) -> Iterator[None]:
        """Keep all of what is asked for from making room until the answer is out."""
        for number, part in enumerate(parts(wanted.cells)):
            if number:
                yield from wanted.pause(self._cache)
            for index, layer in part:
                self._patient.need(wanted, Key(self._cache.catalogue.id(index), layer))

    def _wait_for_pages(self, wanted: PendingRequest) -> None:
        """Let a request wait for its pages, without those that have settled since it was found."""
        pages = self._cache.catalogue.pages
        if pages is not None and wanted.pages:
            come = {page for page in wanted.pages if pages.is_here(page)}
            wanted.pages -= come | {page for page in wanted.pages if pages.is_out_of_reach(page)}
            wanted.outdated = wanted.outdated or bool(come)
            self._patient.wait_for_pages(wanted)

    def _load(self, wanted: PendingRequest, cold: list[tuple[int, str]], *, note: bool) -> Iterator[None]:
        """Ask for loads; ``note`` which ones, to be told when they end."""
        cache, now_s = self._cache, self._now_s()
        for part in parts(cold, LOADS_A_STEP):
            if len(cold) > LOADS_A_STEP:
                yield from wanted.pause(cache)  # before the first one, too: they were looked for until now
            boxes = cache.catalogue.boxes_of(np.array([index for index, _ in part], dtype=np.intp))
            for (index, layer), distance in zip(part, wanted.distances_m(boxes).tolist(), strict=True):
                key = Key(cache.catalogue.id(index), layer)
                if key in wanted.refused or cache.warm.get(index, layer) is not None:
                    continue  # it may have come for somebody else
                self._note_late(wanted, key)
                if self._scheduler.want(index, layer, distance, now_s, wanted.session.asker) and note:
                    self._patient.wait_for(wanted, key)

    def _note_late(self, wanted: PendingRequest, key: Key) -> None:
        """Count what nobody fetched ahead: if the client was on its way, it is late."""
        load = self._scheduler.loads.by_key.get(key)
        if load is None or load.prefetch:
            self._scheduler.prefetcher.note_cold(wanted.session, key)
            self._statistics.add("prefetch_overtaken", load is not None and load.running)

    def settled(self, key: Key) -> None:
        """A load ended: answer the requests it was the last one for."""
        self._patient.settled(key)

    def pages_settled(self, news: PageNews) -> None:
        """Pages of the map have come, or cannot be had at present."""
        for page in news.come:
            self._patient.page_settled(page)
        for page in news.out_of_reach:
            self._patient.page_settled(page, "offline")

    def map_changed(self) -> None:
        """Another state of the map is served, with other pages."""
        self._patient.map_changed()

    def uses(self, page: int) -> bool:
        """Whether a request that is not answered yet has cells of a page, or an area in it; or may have."""
        pages = self._cache.catalogue.pages
        if pages is None or sum(len(wanted.cells) for wanted in self._open) > MOST_LOOKED_AT:
            return True
        cells = pages.cells(page)
        for wanted in self._open:
            if any(index in cells for index, _layer in wanted.cells):
                return True
            if wanted.area is not None:
                halo_m = self._cache.layers.halo_m(wanted.layers)
                if page in pages.of_area(wanted.area.around(*wanted.area.center, halo_m)):
                    return True
        return False

    def tidy(self) -> None:
        """Do some of what requests and sessions that are over leave to do."""
        self._patient.tidy()

    def _answer_in_turn(self, wanted: PendingRequest) -> None:
        """Answer a request that waits; what it asks for stays needed until then."""
        if not wanted.due:
            wanted.due = True
            self._due(wanted.session.connection, self._answer_now(wanted))

    def _answer_now(self, wanted: PendingRequest) -> Iterator[None]:
        """Answer a request that waits, unless there is more to wait for."""
        if wanted not in self._patient:  # its session has ended
            return
        over = True
        try:
            if (yield from self._on_one_map(wanted, lambda: self._goes_on_waiting(wanted))):
                over = False
                self._patient.again(wanted)
                if wanted.outdated:  # more has come while it was gone through
                    self._answer_in_turn(wanted)
            else:
                yield from self._answer(wanted)
        except ShmmapError as error:
            wanted.session.connection.refuse(wanted.request, error)
        finally:
            if over and wanted in self._patient:
                self._patient.remove(wanted)
                self._end(wanted)

    def _answer(self, wanted: PendingRequest) -> Iterator[None]:
        return self._on_one_map(wanted, lambda: self._answers.answer(wanted, self._now_s()))

    def _on_one_map(
        self, wanted: PendingRequest, do: Callable[[], Generator[None, None, Result]]
    ) -> Generator[None, None, Result]:
        """Go through a request's cells, found again if the map has changed or more of it is known."""
        while True:
            with contextlib.suppress(MapChanged):
                if wanted.outdated or wanted.catalogue is not self._cache.catalogue:
                    yield from wanted.find_again(self._cache)
                return (yield from do())

    def _goes_on_waiting(self, wanted: PendingRequest) -> Generator[None, None, bool]:
        """Whether there is more to wait for, and time.

        That is what was found again; or a cell that had settled and is cold again, or may fit now.
        """
        in_time = self._now_s() < wanted.deadline_s
        if wanted.is_new:
            may_wait = self._patient.recount(wanted) and in_time
            yield from self._have_loaded(wanted, note=may_wait)
            if may_wait:
                yield from self._need(wanted)
                self._wait_for_pages(wanted)
            wanted.is_new = False
            return may_wait and (wanted.waits or wanted.outdated)
        if not in_time:
            return False
        for number, part in enumerate(parts(wanted.cells)):
            if number:
                yield from wanted.pause(self._cache)
            now_s = self._now_s()
            if now_s >= wanted.deadline_s:
                return False
            for index, layer in part:
                key = Key(self._cache.catalogue.id(index), layer)
                if key in wanted.refused or self._cache.find_warm(index, layer, now_s) is not None:
                    continue
                if (
                    key not in wanted.outstanding  # it may be asked for twice
                    and key not in self._scheduler.loads.failures
                    and self._scheduler.want(index, layer, 0.0, now_s, wanted.session.asker)
                ):
                    self._patient.wait_for(wanted, key)
        return wanted.waits

    def next_deadline_s(self) -> float:
        """When there is something to do: when the next client's patience ends; infinity when nobody waits."""
        return 0.0 if self._scheduler.ended else self._patient.next_deadline_s()

    def answer_overdue(self, now_s: float) -> None:
        """Answer those who waited long enough, with what there is; see to what is left to tidy."""
        for key in self._scheduler.take_ended():
            self.settled(key)
        for wanted in self._patient.overdue(now_s):
            self._answer_in_turn(wanted)
        self.tidy()

    def forget(self, session: Session) -> None:
        """The session ended: nobody waits for its requests any more."""
        for wanted in self._patient.of(session):
            self._patient.remove(wanted)
            self._end(wanted)

    def left(self, session: Session) -> None:
        """The session is no more: what it held may be free now."""
        self.forget(session)
        self._patient.left(session)

    def answer_all(self) -> None:
        """Answer everybody now (the daemon stops)."""
        for wanted in self._patient:
            wanted.deadline_s = 0.0
            for _ in self._answer_now(wanted):
                pass


def _check_wait(wait_s: float | None) -> None:
    if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
        raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")


def _note_area(session: Session, area: Area, layers: tuple[str, ...]) -> None:
    """A session asks for an area: in the middle of it is where it is, unless it says."""
    session.area, session.layers = area, layers
    if not session.says_where:
        session.intent = session.new_intent = messages.Intent(*area.center)
    session.sessions.moved[session] = None
