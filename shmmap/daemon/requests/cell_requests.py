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

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler
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
from shmmap.errors import BadRequest, NoSession
from shmmap.geometry import Area
from shmmap.protocol import messages

__all__ = ["CellRequests"]

MAX_WAIT_S: Final = 3600.0
MOST_AT_ONCE: Final = 4096
"""Cells of an area that are compared with what a client holds in one turn, if all are in memory."""

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
        scheduler.on_settled = self.settled
        self._statistics = cache.statistics
        self._due = due
        self._now_s = clock
        self._quota = limits.SessionQuota(quota_bytes, cache, clock)
        self._answers = CellReplies(cache, scheduler)
        self._patient = WaitingList(cache.ledger, self._answer_in_turn, self.let_go)

    def __len__(self) -> int:
        return len(self._patient)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area) -> Iterator[None]:
        """All cells that touch an area."""
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        cache = self._cache
        layers = limits.admitted_layers(cache, message.layers)
        _note_area(session, area, layers)
        found, covered = cache.catalogue.query(area, limits.MOST_CELLS)
        limits.check_count(len(found) * len(layers))
        cells = [(index, layer) for index in cache.at_height(found.tolist(), area.z) for layer in layers]
        wanted = PendingRequest(
            session, message.request, cells, cache.catalogue, limits.layers_named(message), covered, area=area
        )
        return self._serve(wanted, message.wait)

    def selected(self, session: Session, message: messages.Selected) -> Iterator[None]:
        """Cells by id, in the order asked for."""
        _check_wait(message.wait)
        cache = self._cache
        layers = limits.admitted_layers(cache, message.layers)
        limits.check_count(len(message.ids) * len(layers))
        wanted = PendingRequest(session, message.request, [], cache.catalogue, limits.layers_named(message))
        for number, ids in enumerate(parts(message.ids)):
            if number:
                yield
                yield from wanted.follow(cache)
            indices = [cache.index_of(cell_id) for cell_id in ids]
            wanted.cells += [(index, layer) for index in indices if index is not None for layer in layers]
            absent = [cell_id for cell_id, index in zip(ids, indices, strict=True) if index is None]
            wanted.unknown += [(cell_id, layer) for cell_id in absent for layer in layers]
        wanted.covered = not wanted.unknown or cache.catalogue.complete
        yield from self._serve(wanted, message.wait)

    def differential(self, session: Session, message: messages.Differential) -> Iterator[None]:
        """Cells that touch an area, minus those the client holds."""
        limits.check_held(message)
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        cache = self._cache
        layers = limits.admitted_layers(cache, message.layers)
        _note_area(session, area, layers)
        found, covered = cache.catalogue.query(area, limits.MOST_CELLS)
        limits.check_count(len(found) * len(layers))
        if len(layers) == 1 and area.z is None and covered and len(found) <= MOST_AT_ONCE:
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
        return self._serve_lacking(lacking(cache, session, message, area, layers), message.wait)

    def let_go(self, residents: Iterable[Resident]) -> None:
        """Somebody dropped these."""
        self._scheduler.room.let_go(residents, self._now_s())

    # --- loading and waiting --------------------------------------------------------------------

    def _serve_lacking(
        self, lacks: Generator[None, None, PendingRequest], wait_s: float | None
    ) -> Iterator[None]:
        yield from self._serve((yield from lacks), wait_s)

    def _serve(self, wanted: PendingRequest, wait_s: float | None) -> Iterator[None]:
        """Answer a request, or have loaded what is cold of it and let it wait."""
        waits = False
        try:
            waits = yield from self._on_one_map(wanted, lambda: self._begin(wanted, wait_s))
            if not waits:
                yield from self._answer(wanted)
        finally:
            if not waits:
                self._patient.let_go(wanted)

    def _begin(self, wanted: PendingRequest, wait_s: float | None) -> Generator[None, None, bool]:
        """Find what is warm and have the rest loaded; whether the request waits for that."""
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
        self._statistics.add("hits", len(wanted.cells) - len(cold))
        yield from self._quota.check(wanted, sizes)
        if not cold:
            return False
        yield from limits.check_queue(cache, self._scheduler.loads, wanted, cold)
        self._statistics.add("misses", len(cold))
        waits = bool(wait_s) and self._patient.has_room(wanted)
        yield from self._load(wanted, cold, note=waits)
        if not (waits and wanted.outstanding):
            return False
        for number, part in enumerate(parts(wanted.cells)):
            if number:
                yield from wanted.pause(cache)
            for index, layer in part:
                self._patient.need(wanted, Key(cache.catalogue.id(index), layer))
        wanted.began_s, wanted.deadline_s = now_s, now_s + (wait_s or 0.0)
        self._patient.add(wanted)
        if not wanted.outstanding:  # they came while the rest was gone through
            self._answer_in_turn(wanted)
        return True

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
            self._scheduler.prefetcher.cold.append((wanted.session, key))
            self._statistics.add("prefetch_overtaken", load is not None and load.running)

    def settled(self, key: Key) -> None:
        """A load ended: answer the requests it was the last one for."""
        self._patient.settled(key)

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
            else:
                yield from self._answer(wanted)
        except NoSession as error:
            wanted.session.connection.refuse(wanted.request, error)
        finally:
            if over and wanted in self._patient:
                self._patient.remove(wanted)
                self._patient.let_go(wanted)

    def _answer(self, wanted: PendingRequest) -> Iterator[None]:
        return self._on_one_map(wanted, lambda: self._answers.answer(wanted, self._now_s()))

    def _on_one_map(
        self, wanted: PendingRequest, do: Callable[[], Generator[None, None, Result]]
    ) -> Generator[None, None, Result]:
        """Go through a request's cells, from the beginning again if the map has changed."""
        while True:
            with contextlib.suppress(MapChanged):
                if wanted.catalogue is self._cache.catalogue:
                    return (yield from do())
            yield from wanted.follow(self._cache)

    def _goes_on_waiting(self, wanted: PendingRequest) -> Generator[None, None, bool]:
        """Whether a cell that had settled is cold again, or may fit now, and there is time to load it."""
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
        return bool(wanted.outstanding)

    def next_deadline_s(self) -> float:
        """When there is something to do: when the next client's patience ends; infinity when nobody waits."""
        return self._patient.next_deadline_s()

    def answer_overdue(self, now_s: float) -> None:
        """Answer those who waited long enough, with what there is; see to what is left to tidy."""
        for wanted in self._patient.overdue(now_s):
            self._answer_in_turn(wanted)
        self.tidy()

    def forget(self, session: Session) -> None:
        """The session ended: nobody waits for its requests any more."""
        for wanted in self._patient.of(session):
            self._patient.remove(wanted)
            self._patient.let_go(wanted)

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
        session.intent = session.told = messages.Intent(*area.center)
    session.sessions.moved[session] = None
