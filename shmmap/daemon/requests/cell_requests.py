# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A request first becomes a `PendingRequest`: which cells in which order, minus those that the client holds.
If all of them are warm, the answer leaves at once.  Otherwise loads are queued, nearest cells first, and the
answer leaves when the last load has ended or the client's timeout expires.  It contains a handle for each
cell in memory, and a reason for each other cell.  Work on many cells takes several turns of the loop.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, TypeVar

import msgspec

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.loads import Load
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.map.catalogue_view import PageNews
from shmmap.daemon.records import SPACE_CODES, Resident
from shmmap.daemon.requests import limits
from shmmap.daemon.requests.differential import difference, warm_difference
from shmmap.daemon.requests.pending_request import LARGE, Found, MapChanged, PendingRequest, WaitingList
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session
from shmmap.daemon.turns import Pace, batched
from shmmap.errors import BadRequest, ShmmapError
from shmmap.geometry import Area
from shmmap.protocol import messages
from shmmap.protocol.codec import PackedArray, encode_cells
from shmmap.protocol.messages import FailedCell, Holder, PendingCell

MAX_WAIT_S: Final = 3600.0
MAX_COMPARED: Final = 4096
"""Cells of an area compared in one turn with those that a client holds, if all are in memory."""
MAX_LOOKED_AT: Final = 20_000
"""Cells of unanswered requests that are searched for a page of the map; with more, the page is kept."""
PACKED_PER_CELL: Final = 256
HELD_PER_CELL: Final = 2
"""Bytes of packed versions, and cells held by name, that count as one cell of a waiting request's memory."""
MAX_HOLDERS: Final = 16
"""Holders named beside each cell that does not fit: those with the most memory."""
NOTED_PER_STEP: Final = 256
"""Cells handed out that are noted, or freed, between two looks at the time."""
PROMISED: Final = 1e9
"""Priority of a load promised by a "pending" alone: after the distances of all requested cells."""

_UNNAMED: Final = (Holder(0, 0, -1, "", 0, 0),)
"""Stands for the holders of memory until they are looked up."""

Result = TypeVar("Result")


@dataclass(eq=False, slots=True)
class _Answer:
    """Cells of a reply.

    Attributes
    ----------
    handles, pending
        Cells that `encode` has not encoded yet.
    failed
        Failed cells; the holders of memory are added later.
    """

    residents: list[Resident] = field(default_factory=list)
    handles: list[bytes] = field(default_factory=list)
    pending: list[PendingCell] = field(default_factory=list)
    failed: list[FailedCell] = field(default_factory=list)
    encoded_handles: PackedArray = field(default_factory=PackedArray)
    encoded_pending: PackedArray = field(default_factory=PackedArray)

    def encode(self) -> None:
        """Encode the cells added since the last call: encoding very many at once takes long."""
        self.encoded_handles.add_encoded(self.handles)
        self.encoded_pending.add(self.pending)
        self.handles, self.pending = [], []


class CellRequests:
    """Answers requests for cells from the cache, and requests loads of absent cells.

    Parameters
    ----------
    waiting
        Requests that wait; this list observes the ends of loads.
    quota_bytes
        Limit of the bytes that one session alone holds.
    due
        Queues the steps that answer a request, to run in the turns of the connection's process.
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
        self._statistics, self._holders = cache.statistics, cache.holders
        self._due = due
        self._now_s = clock
        self._quota = limits.SessionQuota(quota_bytes, cache, clock)
        self._open: dict[PendingRequest, None] = {}  # not answered yet
        self._waiting = waiting

    def __len__(self) -> int:
        return len(self._waiting)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area) -> Iterator[None]:
        """Answer with all cells that intersect an area."""
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        layers = self._layers(message.layers)
        _note_area(session, area, layers)

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            known = yield from self._known(wanted, layers)
            for indices in batched(known):
                yield from wanted.pause()
                wanted.found.cells += [(index, layer) for index in indices for layer in layers]

        return self._serve(self._pending(session, message, find, area), message.wait)

    def selected(self, session: Session, message: messages.Selected) -> Iterator[None]:
        """Answer with cells by id, in the order of the request."""
        _check_wait(message.wait)
        layers = self._layers(message.layers)
        limits.check_count(len(message.ids) * len(layers))

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            found = wanted.found
            for ids in batched(message.ids):
                yield from wanted.pause()
                for cell_id in ids:
                    index = self._cache.index_of(cell_id)
                    if index is not None:
                        found.cells += [(index, layer) for layer in layers]
                    else:
                        found.unknown += [(cell_id, layer) for layer in layers]
            found.covered = not found.unknown or self._cache.catalogue.complete

        wanted = self._pending(session, message, find, None, len(message.ids))
        wanted.spare = message.spare
        return self._serve(wanted, message.wait)

    def differential(self, session: Session, message: messages.Differential) -> Iterator[None]:
        """Answer with the cells that intersect an area, minus those that the client holds."""
        limits.check_held(message)
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        layers = limits.layers_of(message.layers)
        catalogue, versions = self._cache.catalogue, self._cache.layers
        cells, covered = catalogue.query(area, MAX_COMPARED)
        looks_around = catalogue.pages is not None and versions.halo_m(layers) > 0.0
        is_one = len(layers) == 1 and area.z is None
        if is_one and covered and not looks_around and len(cells) <= MAX_COMPARED:
            warm = warm_difference(self._cache, message, cells, layers[0])
            if warm is not None and self._quota.has_room(session, warm.residents):
                _note_area(session, area, layers)
                answer = _Answer(warm.residents, [resident.handle for resident in warm.residents])
                found = Found(removed=warm.removed, removed_packed=warm.removed_packed)
                self._reply(session, message.request, limits.layers_named(message.layers), answer, found)
                # the bookkeeping can wait until the answer is out
                self._statistics.add("hits", len(answer.residents))
                return self._hand_out(session, answer, Pace())
        self._check_reach(layers)
        _note_area(session, area, layers)

        def find(wanted: PendingRequest) -> Generator[None, None, None]:
            yield from wanted.pause(now=len(cells) > MAX_COMPARED)  # finding them all takes a turn
            known = yield from self._known(wanted, layers)
            yield from difference(wanted, message, known, layers)

        held_cells = len(message.packed) // PACKED_PER_CELL + len(message.held) // HELD_PER_CELL
        return self._serve(self._pending(session, message, find, area, held_cells), message.wait)

    def _pending(
        self,
        session: Session,
        message: messages.Area | messages.Differential | messages.Selected,
        find: Callable[[PendingRequest], Iterator[None]],
        area: Area | None,
        message_cells: int = 0,
    ) -> PendingRequest:
        layers = limits.layers_named(message.layers)
        return PendingRequest(self._cache, session, message.request, layers, find, area, message_cells)

    def _layers(self, specs: tuple[str, ...]) -> tuple[str, ...]:
        layers = limits.layers_of(specs)
        self._check_reach(layers)
        return layers

    def _check_reach(self, layers: tuple[str, ...]) -> None:
        versions = self._cache.layers
        for layer in layers:
            versions.check_reach(layer)

    def _known(self, wanted: PendingRequest, layers: tuple[str, ...]) -> Generator[None, None, list[int]]:
        """Find the known cells of an area; note whether more may exist, and the pages that may list them.

        A layer that reads neighbouring cells needs the pages of these, too.

        Raises
        ------
        BadRequest
            The area has too many cells.
        MapChanged, NoSession
            See `PendingRequest.pause`.
        """
        area, found, catalogue = wanted.area, wanted.found, self._cache.catalogue
        assert area is not None  # noqa: S101  only requests by ids have no area
        pages = catalogue.pages
        if pages is not None:
            limits.check_count(pages.cells_surely_in(area) * len(layers))
        indices, found.covered = catalogue.query(area, limits.MAX_CELLS)
        limits.check_count(len(indices) * len(layers))
        if pages is not None:
            needed = self._cache.pages_around(area, layers)
            absent = [page for page in needed if not pages.is_here(page)]
            found.covered = not absent
            found.pages = {page for page in absent if not pages.is_out_of_reach(page)}
            found.reason = "offline" if len(found.pages) < len(absent) else ""
            pages.want(needed, 0.0)
        yield from wanted.pause(now=len(indices) > LARGE)
        known: list[int] = indices.tolist()
        return known if area.z is None else self._cache.heights.overlapping(known, area.z)

    def release(self, residents: Iterable[Resident]) -> None:
        """Release segments that a client has dropped."""
        self._scheduler.room.release(residents, self._now_s())

    # --- loading and waiting --------------------------------------------------------------------

    def _serve(self, wanted: PendingRequest, wait_s: float | None) -> Iterator[None]:
        """Answer a request, or request loads of its cold cells and let it wait."""
        waits = False
        self._open[wanted] = None
        try:
            waits = yield from self._on_one_map(wanted, lambda: self._begin(wanted, wait_s))
            if not waits:
                yield from self._on_one_map(wanted, lambda: self._answer(wanted, may_wait=False))
        finally:
            if not waits:
                self._end(wanted)

    def _end(self, wanted: PendingRequest) -> None:
        self._open.pop(wanted, None)
        self._waiting.release(wanted)

    def _on_one_map(
        self, wanted: PendingRequest, do: Callable[[], Generator[None, None, Result]]
    ) -> Generator[None, None, Result]:
        """Run a step over a request's cells; find them again and repeat it if the map has changed."""
        while True:
            with contextlib.suppress(MapChanged):
                yield from wanted.find_again()
                return (yield from do())

    def _begin(self, wanted: PendingRequest, wait_s: float | None) -> Generator[None, None, bool]:
        """Load the cold cells of a request; return whether it waits for them, or for pages of the map."""
        now_s = self._now_s()
        may_wait = bool(wait_s) and self._waiting.has_room(wanted)
        yield from self._have_loaded(wanted, note=may_wait)
        if not (may_wait and wanted.waits):
            return False
        yield from self._need(wanted)
        wanted.began_s, wanted.deadline_s = now_s, now_s + (wait_s or 0.0)
        self._waiting.add(wanted)
        self._wait_for_pages(wanted)
        if wanted.outdated or not wanted.waits:  # finished while the other cells were handled
            self._answer_in_turn(wanted)
        return True

    def _have_loaded(self, wanted: PendingRequest, *, note: bool) -> Iterator[None]:
        """Request loads of the cold cells; with ``note``, the request waits for them."""
        cache, warm, found, now_s = self._cache, self._cache.warm.layers, wanted.found, self._now_s()
        found.refused.clear()
        cold: list[tuple[int, str]] = []
        sizes: list[int] = []
        for cells in batched(found.cells):
            yield from wanted.pause()
            for cell in cells:
                index, layer = cell
                resident = warm[layer].get(index) if layer in warm else None
                resident = resident or cache.find_warm(index, layer, now_s)
                if resident is None:
                    cold.append(cell)
                sizes.append(cache.estimate(index, layer) if resident is None else resident.nbytes)
        counts = not wanted.began_s and not wanted.spare
        if counts:
            self._statistics.add("hits", len(found.cells) - len(cold))
        yield from wanted.pause(now=wanted.is_large)
        yield from self._quota.check(wanted, sizes)
        if cold:
            yield from limits.check_queue(self._scheduler.loads, wanted, cold)
            self._statistics.add("misses", len(cold) * counts)
            yield from self._load(wanted, cold, note=note)
        found.requested = True

    def _load(self, wanted: PendingRequest, cold: list[tuple[int, str]], *, note: bool) -> Iterator[None]:
        """Request loads of the ``cold`` cells; with ``note``, the request waits for them."""
        warm, prefetcher, now_s = self._cache.warm, self._scheduler.prefetcher, self._now_s()
        for cells in batched(cold):
            yield from wanted.pause()
            for (index, layer), distance in zip(cells, wanted.distances_m(cells), strict=True):
                key = self._cache.key(index, layer)
                if key in wanted.found.refused or warm.get(index, layer) is not None:
                    continue  # another client may have had it loaded in the meantime
                load: Load | None
                if wanted.spare:
                    load = self._scheduler.want_spare(index, layer, now_s, wanted.session.asker)
                else:
                    prefetcher.note_cold(wanted.session, key)
                    load = self._scheduler.want(index, layer, distance, now_s, wanted.session.asker)
                if load and note:
                    self._waiting.wait_for(wanted, key)

    def _need(self, wanted: PendingRequest) -> Iterator[None]:
        """Protect all requested cells from eviction until the answer has left, except spare ones."""
        if wanted.spare:
            return
        for cells in batched(wanted.found.cells):
            yield from wanted.pause()
            for index, layer in cells:
                self._waiting.need(wanted, self._cache.key(index, layer))

    def _wait_for_pages(self, wanted: PendingRequest) -> None:
        """Let a request wait for its pages, except those that have finished since its cells were found."""
        found, pages = wanted.found, self._cache.pages
        if pages is not None and found.pages:
            come = {page for page in found.pages if pages.is_here(page)}
            found.pages -= come | {page for page in found.pages if pages.is_out_of_reach(page)}
            wanted.outdated = wanted.outdated or bool(come)
            self._waiting.wait_for_pages(wanted)

    def _answer_in_turn(self, wanted: PendingRequest) -> None:
        """Queue the answer to a waiting request; its cells stay protected from eviction until then."""
        if self._waiting.take(wanted):
            self._due(wanted.session.connection, self._answer_now(wanted))

    def _answer_now(self, wanted: PendingRequest) -> Iterator[None]:
        """Answer a waiting request, unless it has to wait for more."""
        if wanted not in self._waiting:  # its session has ended
            return
        wanted.pace.begin()
        waits = False
        try:
            waits = yield from self._on_one_map(wanted, lambda: self._look_again(wanted))
            if waits:
                self._waiting.put_back(wanted)
                if wanted.outdated:  # pages arrived while its cells were handled
                    self._answer_in_turn(wanted)
        except ShmmapError as error:
            wanted.session.connection.refuse(wanted.request, error)
        finally:
            if not waits and wanted in self._waiting:
                self._waiting.remove(wanted)
                self._end(wanted)

    def _look_again(self, wanted: PendingRequest) -> Generator[None, None, bool]:
        """Answer a request, or return True if it has to wait for more.

        It waits for cells that were found again, or for a cell whose load has ended and that is cold again or
        may fit now.
        """
        may_wait = self._now_s() < wanted.deadline_s
        if not wanted.found.requested:
            may_wait = self._waiting.recount(wanted) and may_wait
            yield from self._have_loaded(wanted, note=may_wait)
            if may_wait:
                yield from self._need(wanted)
                self._wait_for_pages(wanted)
                if wanted.waits or wanted.outdated:
                    return True
        return (yield from self._answer(wanted, may_wait=may_wait))

    # --- answers --------------------------------------------------------------------------------

    def _answer(self, wanted: PendingRequest, *, may_wait: bool) -> Generator[None, None, bool]:
        """Send the cells that are in memory; with ``may_wait``, return True instead if more may arrive.

        Raises
        ------
        MapChanged, NoSession
            See `PendingRequest.pause`; nothing has been sent.
        """
        cache, warm, found, now_s = self._cache, self._cache.warm.layers, wanted.found, self._now_s()
        if wanted.area is not None and wanted.area.z is not None:
            inside = set(cache.heights.overlapping([index for index, _ in found.cells], wanted.area.z))
            found.cells = [cell for cell in found.cells if cell[0] in inside]
        answer = _Answer()
        yield from wanted.pause(now=wanted.is_large)
        for unknown in batched(found.unknown):
            yield from wanted.pause()
            for cell_id, layer in unknown:
                answer.failed.append(FailedCell(cell_id, layer, "unknown_cell", "the map has no such cell"))
        for cells in batched(found.cells):
            yield from wanted.pause()
            for index, layer in cells:
                resident = warm[layer].get(index) if layer in warm else None
                resident = resident or cache.find_warm(index, layer, now_s)
                if resident is not None and not found.refused:
                    if not wanted.spare:
                        resident.last_use_s = now_s  # the other bookkeeping follows when the answer has left
                    answer.residents.append(resident)
                    answer.handles.append(resident.handle)
                elif resident is not None or not (may_wait and self._waits_for(wanted, index, layer, now_s)):
                    self._answer_cold(wanted, index, layer, answer, now_s)
            answer.encode()
        if may_wait and wanted.waits:
            return True
        failed = yield from self._failed(wanted, answer.failed)
        yield from wanted.pause(now=wanted.is_large)
        self._reply(wanted.session, wanted.request, wanted.layers, answer, found, failed)
        if wanted.began_s:
            self._statistics.add_duration("wait", int((now_s - wanted.began_s) * 1e9))
        yield from self._hand_out(wanted.session, answer, wanted.pace, spare=wanted.spare)
        while found.cells:  # freeing very many takes time, too
            del found.cells[-NOTED_PER_STEP:]
            yield from wanted.pace.pause()
        return False

    def _waits_for(self, wanted: PendingRequest, index: int, layer: str, now_s: float) -> bool:
        """Whether a cold cell is being loaded, again if its load had ended, so that the request waits."""
        key, loads = self._cache.key(index, layer), self._scheduler.loads
        if key in wanted.outstanding:
            return True
        if wanted.spare or key in wanted.found.refused or key in loads.failures:
            return False
        if not self._scheduler.want(index, layer, 0.0, now_s, wanted.session.asker):
            return False
        self._waiting.wait_for(wanted, key)
        return True

    def _answer_cold(
        self, wanted: PendingRequest, index: int, layer: str, answer: _Answer, now_s: float
    ) -> None:
        """Add a cell that is not warm to the answer: as resident, pending or failed."""
        cache, found, loads = self._cache, wanted.found, self._scheduler.loads
        key, catalogue = cache.key(index, layer), cache.catalogue
        wire_id = cache.wire_id(key.cell_id)
        failure, promised = loads.failures.get(key), loads.is_promised(key)
        refused = key in found.refused
        resident = cache.resident(key)
        current = resident is not None and cache.is_current(resident)
        if resident is not None and not refused and (current or key not in found.held_old):
            answer.residents.append(resident)
            answer.handles.append(resident.handle if current else resident.stale_handle)
        if refused:
            mine = wanted.session.as_holder(wanted.session.held_bytes, len(wanted.session.held))
            holders, box = (mine,) if mine.bytes else (), catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, "over_budget", self._quota.message, holders, box))
        elif not current and failure is not None and not promised:
            holders = _UNNAMED if failure.code in SPACE_CODES else ()
            box = catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, failure.code, failure.message, holders, box))
        elif not current:
            if not promised and not wanted.spare:  # evicted, or no longer out of room: a load is promised
                self._scheduler.want(index, layer, PROMISED, now_s, wanted.session.asker)
            answer.pending.append(PendingCell(wire_id, layer))

    def _failed(self, wanted: PendingRequest, failed: list[FailedCell]) -> Generator[None, None, PackedArray]:
        """Encode the failed cells; name the holders of memory beside cells that do not fit in memory."""
        packed, most = PackedArray(), tuple[Holder, ...]()
        if any(cell.holders is _UNNAMED for cell in failed):
            holders: list[Holder] = []
            for _ in self._holders.look(holders):
                yield from wanted.pause()
            most = tuple(islice(holders, MAX_HOLDERS))
        for cells in batched(failed):
            yield from wanted.pause()
            packed.add(
                [
                    msgspec.structs.replace(cell, holders=most) if cell.holders is _UNNAMED else cell
                    for cell in cells
                ]
            )
        return packed

    def _reply(
        self,
        session: Session,
        request: int,
        layers: tuple[str, ...],
        answer: _Answer,
        found: Found,
        failed: PackedArray | None = None,
    ) -> None:
        """Send a reply; `_hand_out` does the bookkeeping afterwards."""
        cache = self._cache
        map_version = cache.catalogue.map_version
        answer.encode()
        reply = encode_cells(
            request, cache.epoch, map_version, answer.encoded_handles, found.removed, found.removed_packed,
            layers, found.covered, answer.encoded_pending, failed or PackedArray(), reason=found.reason,
        )  # fmt: skip
        session.connection.reply(reply)

    def _hand_out(
        self, session: Session, answer: _Answer, pace: Pace, *, spare: bool = False
    ) -> Iterator[None]:
        """Note what a session was given; the first cells at once, before the client can have left."""
        residents = answer.residents
        self._statistics.add("handles_sent", len(residents))
        for begin in range(0, len(residents), NOTED_PER_STEP):
            some = residents[begin : begin + NOTED_PER_STEP]
            if not spare:
                self._cache.hand_out(some, self._now_s())
            session.hold(some)
            yield from pace.pause()
            if not session.is_connected:
                return
        if len(residents) > LARGE:  # freeing these lists takes time, too
            yield

    # --- what happens meanwhile -----------------------------------------------------------------

    def pages_finished(self, news: PageNews) -> None:
        """Handle pages of the map that have arrived, or cannot be fetched at present."""
        for page in news.come:
            self._waiting.page_finished(page)
        for page in news.out_of_reach:
            self._waiting.page_finished(page, "offline")

    def map_changed(self) -> None:
        """Handle a new state of the map, whose pages differ."""
        self._waiting.map_changed()

    def uses(self, page: int) -> bool:
        """Whether an unanswered request uses a page, or may use it: by its cells or by its area."""
        pages = self._cache.pages
        if pages is None or sum(len(wanted.found.cells) for wanted in self._open) > MAX_LOOKED_AT:
            return True
        cells = pages.cells(page)
        return any(
            any(index in cells for index, _layer in wanted.found.cells)
            or (wanted.area is not None and page in self._cache.pages_around(wanted.area, wanted.layers))
            for wanted in self._open
        )

    def next_deadline_s(self) -> float:
        """Return the time of the next work: now, or when a client's timeout expires; else infinity."""
        return self._waiting.next_deadline_s()

    def answer_finished(self) -> None:
        """Answer requests whose last load or page has arrived; do some of the deferred work."""
        for wanted in self._waiting.tidy():
            self._answer_in_turn(wanted)

    def answer_overdue(self, now_s: float) -> None:
        """Answer requests whose timeout has expired."""
        self.answer_finished()
        for wanted in self._waiting.overdue(now_s):
            self._answer_in_turn(wanted)

    def on_disconnect(self, session: Session) -> None:
        """Drop the requests of a session whose connection has ended."""
        for wanted in self._waiting.of(session):
            self._drop(wanted)

    def cancel(self, session: Session, request: int) -> None:
        """Drop a waiting request of a session, by its id, without an answer."""
        for wanted in self._waiting.of(session):
            if wanted.request == request:
                self._drop(wanted)

    def _drop(self, wanted: PendingRequest) -> None:
        self._waiting.remove(wanted)
        self._end(wanted)

    def on_session_end(self, session: Session) -> None:
        """Release the segments of a session that has ended."""

        def steps() -> Iterator[None]:
            for resident in session.residents():
                session.drop_segment(resident)
                self.release((resident,))
                yield

        self.on_disconnect(session)
        self._waiting.do_later(steps())

    def answer_all(self) -> None:
        """Answer all requests now: the daemon stops."""
        for wanted in self._waiting:
            wanted.deadline_s = 0.0
            for _ in self._answer_now(wanted):
                pass


def _check_wait(wait_s: float | None) -> None:
    if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
        raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")


def _note_area(session: Session, area: Area, layers: tuple[str, ...]) -> None:
    """Note the area that a session asks for; its centre is the client's position unless it sends one."""
    session.area, session.layers = area, layers
    if not session.says_where:
        session.intent = session.new_intent = messages.Intent(*area.center)
    session.sessions.moved[session] = None
