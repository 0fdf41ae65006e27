# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A request first becomes a `PendingRequest`: which cells in which order, minus what the client holds.  If all
of it is warm the answer leaves at once.  Otherwise loads are queued, nearest cells first, and the
answer (`cell_replies`) leaves when the last one settled or the client's patience ends, whichever is
first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

import numpy as np

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.records import Key, Resident
from shmmap.daemon.requests import limits
from shmmap.daemon.requests.cell_replies import Answer, CellReplies
from shmmap.daemon.requests.differential import difference, warm_difference
from shmmap.daemon.requests.pending_request import PendingRequest, WaitingList
from shmmap.daemon.transport.connection import Connection
from shmmap.daemon.transport.sessions import Session
from shmmap.errors import BadRequest
from shmmap.geometry import Area
from shmmap.protocol import messages

__all__ = ["CellRequests", "note_area"]

MAX_WAIT_S: Final = 3600.0


class CellRequests:
    """Answers requests for cells from the cache, and has loaded what is absent.

    Parameters
    ----------
    quota_bytes
        Most bytes one session may keep that no other session also holds.
    due
        Given a connection and what answers it: called in its process's turn.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self,
        cache: CellCache,
        scheduler: Scheduler,
        *,
        quota_bytes: int,
        due: Callable[[Connection, Callable[[], None]], None],
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
        self._waiting: dict[Key, list[PendingRequest]] = {}
        self._patient = WaitingList()

    def __len__(self) -> int:
        return len(self._patient)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area, now_s: float) -> None:
        """All cells that touch an area."""
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        note_area(session, area)
        layers = limits.admitted_layers(self._cache, message.layers)
        indices = self._cache.at_height(self._cache.catalogue.query(area).tolist(), area.z)
        cells = [(index, layer) for index in indices for layer in layers]
        self._begin(PendingRequest(session, message.request, cells, area=area), message.wait, now_s)

    def selected(self, session: Session, message: messages.Selected, now_s: float) -> None:
        """Cells by id, in the order asked for."""
        _check_wait(message.wait)
        layers = limits.admitted_layers(self._cache, message.layers)
        limits.check_count(len(message.ids) * len(layers))
        cells: list[tuple[int, str]] = []
        unknown: list[tuple[str, str]] = []
        for cell_id in message.ids:
            index = self._cache.index_of(cell_id)
            for layer in layers:
                if index is None:
                    unknown.append((cell_id, layer))
                else:
                    cells.append((index, layer))
        self._begin(PendingRequest(session, message.request, cells, unknown=unknown), message.wait, now_s)

    def differential(self, session: Session, message: messages.Differential, now_s: float) -> None:
        """Cells that touch an area, minus those the client holds."""
        limits.check_held(message)
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        note_area(session, area)
        layers = limits.admitted_layers(self._cache, message.layers)
        found = self._cache.catalogue.query(area)
        if len(layers) == 1 and area.z is None:
            warm = warm_difference(self._cache, message, found, layers[0])
            if warm is not None and self._quota.has_room(session, warm.residents):
                answer = Answer([resident.handle for resident in warm.residents], warm.residents)
                self._answers.reply(session, message.request, answer, warm.removed, warm.removed_packed)
                # the bookkeeping can wait until the answer is out
                self._statistics.add("hits", len(answer.handles))
                self._answers.hand_out(session, answer, now_s)
                return
        lacks = difference(self._cache, message, self._cache.at_height(found.tolist(), area.z), layers)
        wanted = PendingRequest(
            session, message.request, lacks.cells, removed=lacks.removed, removed_packed=lacks.removed_packed,
            held_old=lacks.old, area=area,
        )  # fmt: skip
        self._begin(wanted, message.wait, now_s)

    def let_go(self, residents: Iterable[Resident]) -> None:
        """Somebody dropped these."""
        self._scheduler.let_go(residents, self._now_s())

    # --- loading and waiting --------------------------------------------------------------------

    def _begin(self, wanted: PendingRequest, wait_s: float | None, now_s: float) -> None:
        limits.check_count(len(wanted.cells))
        warm = self._cache.warm.layers
        find = self._cache.find_warm
        cold = [
            (index, layer)
            for index, layer in wanted.cells
            if index not in warm.get(layer, {}) and find(index, layer, now_s) is None
        ]
        self._statistics.add("hits", len(wanted.cells) - len(cold))
        self._quota.check(wanted, cold)
        if cold:
            limits.check_queue(self._cache.catalogue, self._scheduler.loads, wanted.session, cold)
            self._statistics.add("misses", len(cold))
            self._load(wanted, cold, now_s)
            if wait_s and wanted.outstanding and self._patient.has_room(wanted.session):
                wanted.began_s, wanted.deadline_s = now_s, now_s + wait_s
                self._wait(wanted)
                return
        self._answers.answer(wanted, now_s)

    def _load(self, wanted: PendingRequest, cold: list[tuple[int, str]], now_s: float) -> None:
        cache = self._cache
        boxes = cache.catalogue.boxes[np.array([index for index, _ in cold], dtype=np.intp)]
        for (index, layer), distance in zip(cold, wanted.distances_m(boxes).tolist(), strict=True):
            key = Key(cache.catalogue.id(index), layer)
            if key in wanted.refused:
                continue
            if self._scheduler.want(index, layer, distance, now_s, wanted.session.asker) is not None:
                wanted.outstanding.add(key)

    def _wait(self, wanted: PendingRequest) -> None:
        catalogue = self._cache.catalogue
        wanted.keys = tuple({Key(catalogue.id(index), layer) for index, layer in wanted.cells})
        for key in wanted.keys:
            self._cache.ledger.need(key)
        for key in wanted.outstanding:
            self._waiting.setdefault(key, []).append(wanted)
        self._patient.add(wanted)

    def _stop_waiting(self, wanted: PendingRequest) -> None:
        for key in wanted.keys:
            self._cache.ledger.need_no_more(key)
        for key in wanted.outstanding:
            waiters = self._waiting.get(key)
            if waiters is not None:
                waiters.remove(wanted)
                if not waiters:
                    del self._waiting[key]
        self._patient.remove(wanted)

    def settled(self, key: Key) -> None:
        """A load ended: answer the requests it was the last one for."""
        for wanted in self._waiting.pop(key, ()):
            wanted.outstanding.discard(key)
            if not wanted.outstanding and not self._goes_on_waiting(wanted):
                self._answer_in_turn(wanted)

    def _answer_in_turn(self, wanted: PendingRequest) -> None:
        """Answer a request that waits; what it asks for stays needed until then."""
        if not wanted.due:
            wanted.due = True
            self._due(wanted.session.connection, partial(self._answer_now, wanted))

    def _answer_now(self, wanted: PendingRequest) -> None:
        if wanted in self._patient:  # its session may have ended
            self._stop_waiting(wanted)
            self._answers.answer(wanted, self._now_s())

    def _goes_on_waiting(self, wanted: PendingRequest) -> bool:
        """Whether a cell that had settled is cold again, or may fit now, and there is time to load it."""
        now_s = self._now_s()
        if now_s >= wanted.deadline_s:
            return False
        for index, layer in wanted.cells:
            key = Key(self._cache.catalogue.id(index), layer)
            if key in wanted.refused or self._cache.find_warm(index, layer, now_s) is not None:
                continue
            if (
                key not in wanted.outstanding  # it may be asked for twice
                and key not in self._scheduler.loads.failures
                and self._scheduler.want(index, layer, 0.0, now_s, wanted.session.asker)
            ):
                wanted.outstanding.add(key)
                self._waiting.setdefault(key, []).append(wanted)
        return bool(wanted.outstanding)

    def next_deadline_s(self) -> float:
        """When the next client's patience ends; infinity when nobody waits."""
        return self._patient.next_deadline_s()

    def answer_overdue(self, now_s: float) -> None:
        """Answer those who waited long enough, with what there is."""
        for wanted in self._patient.overdue(now_s):
            self._answer_in_turn(wanted)

    def forget(self, session: Session) -> None:
        """The session ended: nobody waits for its requests any more."""
        for wanted in self._patient.of(session):
            self._stop_waiting(wanted)

    def renumber(self, new_index: Callable[[int], int | None], id_of: Callable[[int], str]) -> None:
        """The catalogue is about to be replaced: follow the cells that requests wait for.

        ``new_index`` maps an old index to the new one, None for a cell that left the map.
        """
        for wanted in self._patient:
            cells = []
            for index, layer in wanted.cells:
                now = new_index(index)
                if now is not None:
                    cells.append((now, layer))
                elif wanted.area is None:
                    wanted.unknown.append((id_of(index), layer))
            wanted.cells = cells

    def answer_all(self, now_s: float) -> None:
        """Answer everybody now (the daemon stops)."""
        for wanted in self._patient:
            self._stop_waiting(wanted)
            self._answers.answer(wanted, now_s)


def _check_wait(wait_s: float | None) -> None:
    if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
        raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")


def note_area(session: Session, area: Area) -> None:
    """A session asks for an area: in the middle of it is where it is, unless it says."""
    session.area = area
    if not session.says_where:
        session.intent = messages.Intent(*area.center)
