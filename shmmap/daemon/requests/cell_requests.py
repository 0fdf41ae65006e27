# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A reply has a bounded number of cells, and begins a bounded number of loads; with more, it says where the
client has to go on.  So an attempt to answer a request (`CellRequests._attempt`) is one step of bounded time:
it finds the cells in the map that is served now, queues loads of those that are cold, nearest first, and
either answers or lets the request wait.  When its last load has ended, a page of the map has come or its time
is over, the next attempt begins with the message again, so nothing that the last one found can be outdated.
"""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import Load
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_view import PageNews
from shmmap.daemon.records import SPACE_CODES, Absent, Key, Resident
from shmmap.daemon.requests import limits
from shmmap.daemon.requests.differential import difference, holds_few, warm_difference
from shmmap.daemon.requests.waiting_list import CellRequest, Message, WaitingList
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.turns import Walk
from shmmap.errors import BadRequest, ShmmapError
from shmmap.geometry import Area, distance_to_boxes
from shmmap.protocol import messages
from shmmap.protocol.codec import encode_cells
from shmmap.protocol.messages import Differential, FailedCell, Holder, PendingCell, Selected

MAX_CELLS: Final = 512
"""Layers of cells in one reply (a warm one takes some 5 us), and those of one more cell."""
MAX_COLD: Final = 128
"""Layers of cells among them that are not in memory (one takes some 18 us)."""
MAX_ATTEMPTS: Final = 4
"""Attempts that may end in waiting, besides those after a page of the map; the next one is the answer."""
MAX_WAIT_S: Final = 3600.0
MAX_COMPARED: Final = 4096
"""Cells of an area that are compared with those that a client holds, if all are in memory."""
MAX_LOOKED_AT: Final = 256
"""Waiting requests that are searched for a page of the map; with more, the page is kept."""
MAX_HOLDERS: Final = 16
"""Holders named beside each cell that does not fit: those with the most memory."""

_UNNAMED: Final = (Holder(0, 0, -1, "", 0, 0),)
"""Stands for the holders of memory until they are looked up."""


@dataclass(eq=False, slots=True)
class _Found:
    """What a request asks for in the map that is served now.

    Attributes
    ----------
    cells
        Catalogue index and layer of each handle to send, in reply order.
    next_id
        Id of the cell after which the client has to go on, as replies carry it; empty if these are all.
    covered, reason
        Whether all cells of the requested area are known; if not, why the request does not wait for the rest.
    pages
        Pages of the map that may list more cells of the request.
    removed, removed_packed
        Cells that the client should drop, as the reply encodes them.
    unknown
        Ids that the map does not contain, with the requested layers.
    held, held_old
        Versions that the client holds, ascending; layers of cells that it holds in an outdated version.
    """

    cells: list[tuple[int, str]] = field(default_factory=list)
    next_id: str = ""
    covered: bool = True
    reason: str = ""
    pages: set[int] = field(default_factory=set)
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    held: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(0, np.uint64))
    held_old: Collection[Key] = ()


@dataclass(eq=False, slots=True)
class _Answer:
    """Cells of a reply; ``stale`` ones are outdated, ``outstanding`` are the loads that may bring more.

    ``looked_up`` are all requested cells, absent ones too.
    """

    residents: list[Resident] = field(default_factory=list)
    stale: set[Resident] = field(default_factory=set)
    pending: list[PendingCell] = field(default_factory=list)
    failed: list[FailedCell] = field(default_factory=list)
    outstanding: set[Key] = field(default_factory=set)
    looked_up: Sequence[Resident | Absent] = ()


class CellRequests:
    """Answers requests for cells from the cache, and requests loads of absent cells.

    Parameters
    ----------
    waiting
        Requests that wait; this list observes the ends of loads.
    quota_bytes
        Limit of the bytes that one session alone holds.
    due
        Queues the next attempt to answer a request, to run in the turns of the connection's process.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self,
        cache: CellCache,
        scheduler: Scheduler,
        waiting: WaitingList,
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
        self._waiting = waiting
        self._leftovers: deque[Iterator[None]] = deque()
        self._last_area: tuple[Area, int] | None = None
        self._last_cells: NDArray[np.intp] = np.zeros(0, np.intp)

    def __len__(self) -> int:
        return len(self._waiting)

    def serve(self, session: Session, message: Message) -> None:
        """Answer a request with the cells that are in memory, or let it wait for loads and pages."""
        wait_s = message.wait
        if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
            raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")
        layers = limits.layers_of(message.layers)
        area = None
        if isinstance(message, Selected):
            limits.check_selected(message, layers)
        else:
            area = messages.area_from_message(message.area)
        if isinstance(message, Differential):
            limits.check_held(message)
            if area is not None and self._answer_warm(session, message, area, layers):
                return
        for layer in layers:
            self._cache.layers.check_reach(layer)
        if area is not None:
            _note_area(session, area, layers)
        now_s = self._now_s()
        self._attempt(CellRequest(session, message, layers, area, now_s, now_s + (wait_s or 0.0)))

    def release(self, residents: Sequence[Resident]) -> None:
        """Release segments that a client has dropped."""
        self._scheduler.room.release(residents, self._now_s())

    # --- finding --------------------------------------------------------------------------------

    def _answer_warm(
        self, session: Session, message: Differential, area: Area, layers: tuple[str, ...]
    ) -> bool:
        """Answer a differential request at once if it names versions and all cells are in memory."""
        cache = self._cache
        if len(layers) > 1 or message.start or area.z is not None or not holds_few(message):
            return False
        cells, covered = cache.catalogue.query(area, MAX_COMPARED)
        looks_around = cache.catalogue.pages is not None and cache.layers.halo_m(layers) > 0.0
        if not covered or looks_around or len(cells) > MAX_COMPARED:
            return False
        warm = warm_difference(cache, message, cells, layers[0])
        if warm is None or len(warm.residents) > MAX_CELLS:
            return False
        if not self._quota.has_room(session, warm.residents):
            return False
        _note_area(session, area, layers)
        answer = _Answer(warm.residents)
        found = _Found(removed=warm.removed, removed_packed=warm.removed_packed)
        self._reply(session, message, found, answer)
        self._statistics.add("hits", len(answer.residents))
        self._hand_out(session, answer)
        return True

    def _find(self, request: CellRequest) -> _Found:
        """Find the cells of a reply.

        Raises
        ------
        BadRequest
            The area has too many cells.
        """
        message, found = request.message, _Found()
        if isinstance(message, Selected):
            self._find_selected(message, request.layers, found)
            return found
        area, layers = messages.area_from_message(message.area), request.layers
        cells = self._cells_in(area, layers, found)
        start = self._place_after(message.start, cells)
        if isinstance(message, Differential):
            lacks = difference(
                self._cache, message, cells, layers, start=start, most=MAX_CELLS, covered=found.covered
            )
            found.cells, found.held, found.held_old = lacks.cells, lacks.held, lacks.held_old
            found.removed, found.removed_packed = lacks.removed, lacks.removed_packed
            end = start + lacks.looked_at
        else:
            end = min(len(cells), start + max(1, MAX_CELLS // len(layers)))
            found.cells = [(index, layer) for index in cells[start:end].tolist() for layer in layers]
        if end < len(cells):
            found.next_id = self._wire_id(int(cells[end - 1]))
        return found

    def _find_selected(self, message: Selected, layers: Sequence[str], found: _Found) -> None:
        for cell_id in message.ids:
            index = self._cache.index_of(cell_id)
            if index is not None:
                found.cells += [(index, layer) for layer in layers]
            else:
                found.unknown += [(cell_id, layer) for layer in layers]
        found.covered = not found.unknown or self._cache.catalogue.complete

    def _cells_in(self, area: Area, layers: Sequence[str], found: _Found) -> NDArray[np.intp]:
        """Return the known cells of an area; note whether more may exist, and the pages that may list them.

        A layer that reads neighbouring cells needs the pages of these, too.
        """
        cache, catalogue = self._cache, self._cache.catalogue
        pages = catalogue.pages
        if pages is not None:
            limits.check_count(pages.cells_surely_in(area) * len(layers))
        cells, found.covered = self._query(area)
        limits.check_count(len(cells) * len(layers))
        if pages is not None:
            needed = cache.pages_around(area, layers)
            absent = [page for page in needed if not pages.is_here(page)]
            found.covered = not absent
            found.pages = {page for page in absent if not pages.is_out_of_reach(page)}
            found.reason = "offline" if len(found.pages) < len(absent) else ""
            pages.want(needed, 0.0)
        return cells if area.z is None else cache.heights.overlapping(cells, area.z)

    def _query(self, area: Area) -> tuple[NDArray[np.intp], bool]:
        """Return the known cells of an area, and whether these are all; of too many, more than are admitted.

        Those of the last area that takes several replies are remembered, as long as the map is in this state.
        In one state only a list of cells that comes in pages changes.
        """
        catalogue = self._cache.catalogue
        asked = area, catalogue.map_version
        if catalogue.pages is None and self._last_area == asked:
            return self._last_cells, True
        cells, covered = catalogue.query(area, limits.MAX_CELLS)
        if len(cells) > MAX_CELLS:
            self._last_area, self._last_cells = asked, cells
        return cells, covered

    def _wire_id(self, index: int) -> str:
        return self._cache.wire_id(self._cache.catalogue.id(index))

    def _place_after(self, cell_id: str, cells: NDArray[np.intp]) -> int:
        """Return the place of the first cell behind an id, in id order."""
        if not cell_id:
            return 0
        name = cell_id if cell_id.startswith("/") else self._cache.id_prefix + cell_id
        of = self._cache.catalogue.id
        return bisect.bisect_right(range(len(cells)), name, key=lambda place: of(int(cells[place])))

    def _distances_m(self, request: CellRequest, cells: Sequence[tuple[int, str]]) -> list[float]:
        """Return the distances of cells from the position that the client sent.

        Without one, from the centre of the requested area; 0 for a request by ids.
        """
        intent, area = request.session.intent, request.area
        if intent is None and area is None:
            return [0.0] * len(cells)
        boxes = self._cache.catalogue.boxes_of(np.array([index for index, _ in cells], dtype=np.intp))
        x, y = (intent.x, intent.y) if intent is not None else area.center  # type: ignore[union-attr]
        distances: list[float] = distance_to_boxes(x, y, boxes).tolist()
        return distances

    # --- answering and waiting ------------------------------------------------------------------

    def _attempt(self, request: CellRequest) -> bool:
        """Answer a request, or let it wait for loads and pages; return whether it waits."""
        found, now_s = self._find(request), self._now_s()
        answer = self._look_up(request, found, now_s)
        if self._may_wait(request, found, answer, now_s):
            request.attempts += 1
            needed = set() if request.is_spare else {one.key for one in answer.looked_up}
            self._waiting.wait(request, needed, answer.outstanding, found.pages)
            return True
        if any(cell.holders is _UNNAMED for cell in answer.failed):
            most = self._cache.holders.largest(MAX_HOLDERS)
            answer.failed = [
                msgspec.structs.replace(cell, holders=most) if cell.holders is _UNNAMED else cell
                for cell in answer.failed
            ]
        self._reply(request.session, request.message, found, answer)
        self._hand_out(request.session, answer, spare=request.is_spare)
        if request in self._waiting:
            self._statistics.add_duration("wait", int((now_s - request.began_s) * 1e9))
        return False

    def _may_wait(self, request: CellRequest, found: _Found, answer: _Answer, now_s: float) -> bool:
        """Whether a request has something to wait for, and may."""
        if now_s >= request.deadline_s or request.attempts >= (1 if request.is_spare else MAX_ATTEMPTS):
            return False
        request.weigh(len(found.cells))
        if found.pages:
            return self._waiting.has_room(request)
        return bool(answer.outstanding) and not found.next_id and self._waiting.has_room(request)

    def _look_up(self, request: CellRequest, found: _Found, now_s: float) -> _Answer:
        """Find the segments of cells, and request loads of cold ones; cut the cells if these are many."""
        cache, layers = self._cache, self._cache.warm.layers
        warm = {layer: layers[layer].get for layer in request.layers if layer in layers}
        cells, cold = found.cells, 0
        looked_up: list[Resident | Absent] = []
        for place, (index, layer) in enumerate(cells):
            resident = warm[layer](index) if layer in warm else None
            resident = resident or cache.find_warm(index, layer, now_s)
            if resident is None:
                if cold == MAX_COLD:
                    self._cut(found, place)
                    break
                cold += 1
            looked_up.append(resident or cache.absent(index, layer))
        del looked_up[len(cells) :]
        absent = [one.key for one in looked_up if isinstance(one, Absent)]
        if absent:
            limits.check_queue(self._scheduler.loads, request.session.asker, absent)
        if not request.attempts:
            self._check_quota(request, cells, looked_up, now_s)
            if not request.is_spare:
                self._statistics.add("hits", len(cells) - len(absent))
                self._statistics.add("misses", len(absent))
        answer = _Answer(looked_up=looked_up)
        answer.failed = [
            FailedCell(cell_id, layer, "unknown_cell", "the map has no such cell")
            for cell_id, layer in found.unknown
        ]
        distances = self._distances_m(request, cells) if absent else [0.0] * len(cells)
        for (index, _layer), one, distance in zip(cells, looked_up, distances, strict=True):
            if isinstance(one, Resident) and not request.refused:
                answer.residents.append(one)
            else:
                self._look_up_cold(request, found, answer, index, one, distance, now_s)
        return answer

    def _check_quota(
        self,
        request: CellRequest,
        cells: Sequence[tuple[int, str]],
        looked_up: Sequence[Resident | Absent],
        now_s: float,
    ) -> None:
        """Refuse the cells that exceed the session's quota; what is refused stays so until the answer."""
        sizes = [one.nbytes for one in looked_up]
        refused = self._quota.refused(
            request.session, cells, sizes, lambda some: self._distances_m(request, some)
        )
        for key in refused - request.refused:
            self._cache.events.refused_by_quota(key, now_s)
        request.refused = refused

    def _cut(self, found: _Found, place: int) -> None:
        """Leave the cells from a place on, with all layers of the cell there, to the next request."""
        cells = found.cells
        while cells[place - 1][0] == cells[place][0]:
            place -= 1
        found.next_id = self._wire_id(cells[place - 1][0])
        del cells[place:]

    def _look_up_cold(
        self,
        request: CellRequest,
        found: _Found,
        answer: _Answer,
        index: int,
        one: Resident | Absent,
        distance: float,
        now_s: float,
    ) -> None:
        """Add a cell that is not warm, or may be refused, to the answer: as resident, pending or failed."""
        cache, loads = self._cache, self._scheduler.loads
        key, layer = one.key, one.key.layer
        wire_id = cache.wire_id(key.cell_id)
        if key in request.refused:
            session = request.session
            mine = session.as_holder(session.held_bytes, len(session.held))
            holders, box = (mine,) if mine.bytes else (), cache.catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, "over_budget", self._quota.message, holders, box))
            return
        if isinstance(one, Resident):
            answer.residents.append(one)
            return
        resident = cache.resident(key)
        if resident is not None and cache.is_current(resident):
            answer.residents.append(resident)
            return
        is_held = key in found.held_old or (resident and resident.version in found.held)
        if resident is not None and not is_held:
            answer.residents.append(resident)
            answer.stale.add(resident)
        if self._want(request, one, distance, now_s):
            answer.outstanding.add(key)
        failure = loads.failures.get(key)
        if failure is not None and not loads.is_promised(key):
            holders = _UNNAMED if failure.code in SPACE_CODES else ()
            box = cache.catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, failure.code, failure.message, holders, box))
        else:
            answer.pending.append(PendingCell(wire_id, layer))

    def _want(self, request: CellRequest, absent: Absent, distance: float, now_s: float) -> Load | None:
        """Request the load of a cold cell, unless it failed while the request waited for it."""
        loads, key, asker = self._scheduler.loads, absent.key, request.session.asker
        if request.is_spare:
            may_begin = not request.attempts
            return self._scheduler.want_spare(absent, now_s, asker) if may_begin else None
        if request.attempts and key in loads.failures and key not in loads.by_key:
            return None
        if not request.attempts:
            self._scheduler.prefetcher.note_cold(request.session, key)
        return self._scheduler.want(absent, distance, now_s, asker)

    def _reply(self, session: Session, message: Message, found: _Found, answer: _Answer) -> None:
        """Send a reply; `_hand_out` does the bookkeeping afterwards."""
        cache, stale, is_last = self._cache, answer.stale, not found.next_id
        handles = [one.stale_handle if one in stale else one.handle for one in answer.residents]
        reply = encode_cells(
            message.request, cache.epoch, cache.catalogue.map_version, handles,
            found.removed if is_last else (), found.removed_packed if is_last else b"",
            limits.layers_named(message.layers), covered=found.covered, pending=answer.pending,
            failed=answer.failed, reason=found.reason, next_id=found.next_id,
        )  # fmt: skip
        session.connection.reply(reply)

    def _hand_out(self, session: Session, answer: _Answer, *, spare: bool = False) -> None:
        """Note what a session was given."""
        self._statistics.add("handles_sent", len(answer.residents))
        if not spare:
            self._cache.hand_out(answer.residents, self._now_s())
        session.hold(answer.residents)

    # --- what happens meanwhile -----------------------------------------------------------------

    def _answer_in_turn(self, request: CellRequest) -> Iterator[None]:
        """Try again to answer a waiting request, in one turn of its process."""
        if request not in self._waiting:  # its session has ended
            return
        request.is_due = False
        waits = False
        try:
            waits = self._attempt(request)
        except ShmmapError as error:
            request.session.connection.refuse(request.message.request, error)
        finally:
            if not waits:
                self._drop(request)
        yield from ()

    def pages_finished(self, news: PageNews) -> None:
        """Handle pages of the map that have arrived, or cannot be fetched at present."""
        for page in (*news.come, *news.out_of_reach):
            self._waiting.page_finished(page)

    def map_changed(self) -> None:
        """Handle a new state of the map, whose pages differ."""
        self._waiting.map_changed()

    def uses(self, page: int) -> bool:
        """Whether a waiting request uses a page, or may use it: by its area, or by its loads."""
        if len(self._waiting) > MAX_LOOKED_AT:
            return True
        return any(
            request.area is not None and page in self._cache.pages_around(request.area, request.layers)
            for request in self._waiting
        )

    def next_s(self) -> float:
        """Return the time of the next work: now, or when a client's timeout expires; else infinity."""
        return 0.0 if self._leftovers else self._waiting.next_s()

    def answer_due(self, now_s: float) -> None:
        """Queue answers to requests that have nothing left to wait for, or no time; do some deferred work."""
        for request in self._waiting.take(now_s):
            self._due(request.session.connection, self._answer_in_turn(request))
        for _ in Walk(self._deferred()).for_a_step():
            pass

    def _deferred(self) -> Iterator[None]:
        while self._leftovers:
            yield from self._leftovers[0]
            self._leftovers.popleft()

    def on_disconnect(self, session: Session) -> None:
        """Drop the requests of a session whose connection has ended."""
        dropped = self._waiting.of(session)
        for request in dropped:
            self._waiting.remove(request)
        if dropped:
            self._leftovers.append(map(self._waiting.release, dropped))

    def cancel(self, session: Session, request: int) -> None:
        """Drop a waiting request of a session, by its id, without an answer."""
        for waiting in self._waiting.of(session):
            if waiting.message.request == request:
                self._drop(waiting)

    def _drop(self, request: CellRequest) -> None:
        if request in self._waiting:
            self._waiting.remove(request)
            self._waiting.release(request)

    def on_session_end(self, session: Session) -> None:
        """Release the segments of a session that has ended."""

        def release(version: int) -> None:
            self.release(session.drop((version,)))

        self.on_disconnect(session)
        self._leftovers.append(map(release, list(session.held)))

    def answer_all(self) -> None:
        """Answer all requests now: the daemon stops."""
        for request in self._waiting:
            request.deadline_s = 0.0
            for _ in self._answer_in_turn(request):
                pass


def _note_area(session: Session, area: Area, layers: tuple[str, ...]) -> None:
    """Note the area that a session asks for; its centre is the client's position unless it sends one."""
    session.area, session.layers = area, layers
    if not session.says_where:
        session.intent = session.new_intent = messages.Intent(*area.center)
    session.sessions.moved[session] = None
