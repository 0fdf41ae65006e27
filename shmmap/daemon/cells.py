# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A request first becomes a `Wanted`: which cells in which order, minus what the client holds.  If all
of it is warm the answer leaves at once.  Otherwise loads are queued, nearest cells first, and the
answer leaves when the last one settled or the client's patience ends, whichever is first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from shmmap.daemon.difference import difference, warm_difference
from shmmap.daemon.loading import SPACE_CODES
from shmmap.daemon.reclaim import HAND_OUT_GRACE_S
from shmmap.daemon.request_limits import admitted_layers, check_count, check_held
from shmmap.daemon.residency import Key, Resident
from shmmap.daemon.sessions import Session
from shmmap.daemon.store import Store
from shmmap.daemon.waiting_list import WaitingList
from shmmap.errors import BadRequest
from shmmap.geometry import Area, ZRange, distance_to_boxes
from shmmap.protocol import messages
from shmmap.protocol.codec import encode_cells
from shmmap.protocol.messages import FailedCell, Holder, PendingCell
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellRequests", "Wanted"]

MAX_WAIT_S: Final = 3600.0
PROMISED: Final = 1e9
"""Priority of a load that only a "pending" speaks of: behind the distances of all that is asked for."""


@dataclass(eq=False, slots=True)
class Wanted:
    """What one request asks for, and what of it is still outstanding.

    ``cells`` holds catalogue index and layer of each handle to send, in reply order;
    ``unknown`` ids that the map does not have.
    """

    session: Session
    request: int
    cells: list[tuple[int, str]]
    removed: tuple[str, ...] = ()
    removed_packed: bytes = b""
    unknown: list[tuple[str, str]] = field(default_factory=list)
    refused: dict[Key, tuple[str, str]] = field(default_factory=dict)
    held_old: set[str] = field(default_factory=set)
    area: Area | None = None
    keys: tuple[Key, ...] = ()
    outstanding: set[Key] = field(default_factory=set)
    began_s: float = 0.0
    deadline_s: float = 0.0


@dataclass(eq=False, slots=True)
class _Answer:
    """A reply in the making; ``blockers``, who fills the budget, is looked up once if needed."""

    handles: list[bytes] = field(default_factory=list)
    residents: list[Resident] = field(default_factory=list)
    pending: list[PendingCell] = field(default_factory=list)
    failed: list[FailedCell] = field(default_factory=list)
    blockers: tuple[Holder, ...] | None = None


class CellRequests:
    """Answers requests for cells from the store.

    Parameters
    ----------
    quota_bytes
        Most bytes one session may keep that no other session also holds.
    send
        Called with a session and an encoded reply.
    clock
        The serving loop's clock, seconds.
    """

    def __init__(
        self,
        store: Store,
        statistics: StatisticsWriter,
        *,
        epoch: int,
        quota_bytes: int,
        send: Callable[[Session, bytes], None],
        clock: Callable[[], float],
    ) -> None:
        self._store = store
        self._statistics = statistics
        self._epoch = epoch
        self._quota_bytes = quota_bytes
        self._send = send
        self._now_s = clock
        self._waiting: dict[Key, list[Wanted]] = {}
        self._patient: WaitingList[Wanted] = WaitingList()

    def __len__(self) -> int:
        return len(self._patient)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area, now_s: float) -> None:
        """All cells that touch an area."""
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        session.asked_about(area)
        layers = admitted_layers(self._store, message.layers)
        indices = self._at_height(self._store.catalogue.query(area).tolist(), area.z)
        cells = [(index, layer) for index in indices for layer in layers]
        self._begin(Wanted(session, message.request, cells, area=area), message.wait, area, now_s)

    def selected(self, session: Session, message: messages.Selected, now_s: float) -> None:
        """Cells by id, in the order asked for."""
        _check_wait(message.wait)
        layers = admitted_layers(self._store, message.layers)
        check_count(len(message.ids) * len(layers))
        cells: list[tuple[int, str]] = []
        unknown: list[tuple[str, str]] = []
        for cell_id in message.ids:
            index = self._store.index_of(cell_id)
            for layer in layers:
                if index is None:
                    unknown.append((cell_id, layer))
                else:
                    cells.append((index, layer))
        self._begin(Wanted(session, message.request, cells, unknown=unknown), message.wait, None, now_s)

    def differential(self, session: Session, message: messages.Differential, now_s: float) -> None:
        """Cells that touch an area, minus those the client holds."""
        check_held(message)
        _check_wait(message.wait)
        area = messages.area_from_message(message.area)
        session.asked_about(area)
        layers = admitted_layers(self._store, message.layers)
        found = self._store.catalogue.query(area)
        if len(layers) == 1 and area.z is None and self._cannot_exceed_quota(session):
            warm = warm_difference(self._store, message, found, layers[0])
            if warm is not None:
                answer = _Answer([resident.handle for resident in warm.residents], warm.residents)
                self._reply(session, message.request, answer, warm.removed, warm.removed_packed)
                # the books can wait until the answer is out
                self._statistics.add("hits", len(answer.handles))
                self._account(session, warm.held)
                self._hand_out(session, answer, now_s)
                return
        lacks = difference(self._store, message, self._at_height(found.tolist(), area.z), layers)
        wanted = Wanted(
            session,
            message.request,
            lacks.cells,
            removed=lacks.removed,
            removed_packed=lacks.removed_packed,
            held_old=lacks.old,
            area=area,
        )
        self._account(session, lacks.held)
        self._begin(wanted, message.wait, area, now_s)

    def _cannot_exceed_quota(self, session: Session) -> bool:
        return session.held_bytes + self._store.books.resident_bytes <= self._quota_bytes

    def _account(self, session: Session, held: set[int]) -> None:
        """The client says what it holds: note what it dropped since, and free it where possible."""
        dropped = session.held.keys() - held
        if dropped:
            self.let_go(session.drop(dropped))

    def let_go(self, residents: Iterable[Resident]) -> None:
        """Somebody dropped these: what was refused for want of memory may fit now."""
        self._store.reclaimer.let_go(residents, self._now_s())
        self._store.books.clear_failures(SPACE_CODES)

    def _at_height(self, indices: list[int], z: ZRange | None) -> list[int]:
        """Leave out cells whose heights, known once they were loaded, lie outside the range."""
        if z is None:
            return indices
        heights = self._store.heights
        return [i for i in indices if (known := heights.get(i)) is None or z.overlaps(*known)]

    # --- waiting and answering ------------------------------------------------------------------

    def _begin(self, wanted: Wanted, wait_s: float | None, area: Area | None, now_s: float) -> None:
        check_count(len(wanted.cells))
        warm = self._store.warm
        find = self._store.find_warm
        cold = [
            (index, layer)
            for index, layer in wanted.cells
            if index not in warm.get(layer, {}) and find(index, layer, now_s) is None
        ]
        self._statistics.add("hits", len(wanted.cells) - len(cold))
        self._check_quota(wanted, cold)
        if cold:
            self._statistics.add("misses", len(cold))
            self._load(wanted, cold, area, now_s)
            if wait_s and wanted.outstanding and self._patient.has_room(wanted.session):
                wanted.began_s, wanted.deadline_s = now_s, now_s + wait_s
                self._wait(wanted)
                return
        self._answer(wanted, now_s)

    def _load(self, wanted: Wanted, cold: list[tuple[int, str]], area: Area | None, now_s: float) -> None:
        store = self._store
        boxes = store.catalogue.boxes[np.array([index for index, _ in cold], dtype=np.intp)]
        intent = wanted.session.intent
        x, y = (intent.x, intent.y) if intent is not None else area.center if area is not None else (0.0, 0.0)
        near = (
            distance_to_boxes(x, y, boxes) if intent is not None or area is not None else np.zeros(len(cold))
        )
        for (index, layer), distance in zip(cold, near.tolist(), strict=True):
            key = Key(store.catalogue.id(index), layer)
            if key in wanted.refused:
                continue
            if store.want(index, layer, distance, now_s, wanted.session.asker).load is not None:
                wanted.outstanding.add(key)

    def _check_quota(self, wanted: Wanted, cold: Sequence[tuple[int, str]]) -> None:
        """Refuse what would make this session keep more than its quota for itself alone."""
        session, store = wanted.session, self._store
        if self._cannot_exceed_quota(session) and not cold:
            return
        chilled = set(cold)
        sizes = [
            store.estimate(index, layer) if (index, layer) in chilled else store.warm[layer][index].nbytes
            for index, layer in wanted.cells
        ]
        if session.held_bytes + sum(sizes) <= self._quota_bytes:
            return
        self._refresh(session)
        left = self._quota_bytes - session.exclusive_bytes()
        # a new version takes the place of the old one that its holder is about to drop
        replaced = {r.key: r.nbytes for r in session.residents() if not store.is_current(r)}
        boxes = store.catalogue.boxes[np.array([index for index, _ in wanted.cells], dtype=np.intp)]
        if session.intent is not None:
            order = np.argsort(distance_to_boxes(session.intent.x, session.intent.y, boxes), kind="stable")
        elif wanted.area is not None:
            order = np.argsort(distance_to_boxes(*wanted.area.center, boxes), kind="stable")
        else:
            order = np.arange(len(boxes))
        counted: set[tuple[int, str]] = set()
        for position in order.tolist():
            index, layer = wanted.cells[position]
            if (index, layer) in counted:
                continue
            counted.add((index, layer))
            key = Key(store.catalogue.id(index), layer)
            resident = None if (index, layer) in chilled else store.warm[layer][index]
            if resident is not None and resident.sessions - {session.slot}:
                continue  # somebody else keeps it anyway
            if resident is not None and session.slot in resident.sessions:
                continue
            left -= sizes[position] - replaced.get(key, 0)
            if left < 0:
                message = (
                    f"this client would keep more than {self._quota_bytes} bytes (its quota) for itself alone"
                )
                wanted.refused[key] = ("over_budget", message)
                self._statistics.add("refused_quota")
                store.events.pressure.refused(store.wire_id(key.cell_id), layer, "quota", self._now_s())

    def _refresh(self, session: Session) -> None:
        """Ask the kernel which segments the session really still uses."""
        before_s = self._now_s() - HAND_OUT_GRACE_S
        for resident in session.residents():
            slots = self._store.reclaimer.slots_of(resident)
            if slots is not None and session.slot not in slots and resident.last_use_s < before_s:
                session.drop_segment(resident)

    def _wait(self, wanted: Wanted) -> None:
        catalogue = self._store.catalogue
        wanted.keys = tuple({Key(catalogue.id(index), layer) for index, layer in wanted.cells})
        for key in wanted.keys:
            self._store.books.slot(key).waiting += 1
        for key in wanted.outstanding:
            self._waiting.setdefault(key, []).append(wanted)
        self._patient.add(wanted)

    def _stop_waiting(self, wanted: Wanted) -> None:
        for key in wanted.keys:
            self._store.books.unwait(key)
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
                self._stop_waiting(wanted)
                self._answer(wanted, self._now_s())

    def _goes_on_waiting(self, wanted: Wanted) -> bool:
        """Whether a cell that had settled is cold again, or may fit now, and there is time to load it."""
        now_s = self._now_s()
        if now_s >= wanted.deadline_s:
            return False
        for index, layer in wanted.cells:
            key = Key(self._store.catalogue.id(index), layer)
            if key in wanted.refused or self._store.find_warm(index, layer, now_s) is not None:
                continue
            if (
                key not in wanted.outstanding  # it may be asked for twice
                and self._store.books.slot(key).failure is None
                and self._store.want(index, layer, 0.0, now_s, wanted.session.asker).load
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
            self._stop_waiting(wanted)
            self._answer(wanted, now_s)

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
            self._answer(wanted, now_s)

    def _answer(self, wanted: Wanted, now_s: float) -> None:
        warm = self._store.warm
        answer = _Answer()
        if wanted.area is not None and wanted.area.z is not None:
            inside = set(self._at_height([index for index, _ in wanted.cells], wanted.area.z))
            wanted.cells = [cell for cell in wanted.cells if cell[0] in inside]
        for cell_id, layer in wanted.unknown:
            answer.failed.append(FailedCell(cell_id, layer, "unknown_cell", "the map has no such cell"))
        for index, layer in wanted.cells:
            resident = warm[layer].get(index) if layer in warm else None
            if resident is None:  # evicted since the request came, perhaps, and still whole
                resident = self._store.find_warm(index, layer, now_s)
            if resident is not None and not wanted.refused:
                answer.handles.append(resident.handle)
                answer.residents.append(resident)
            else:
                self._answer_cold(wanted, index, layer, answer, now_s)
        self._reply(wanted.session, wanted.request, answer, wanted.removed, wanted.removed_packed)
        self._hand_out(wanted.session, answer, now_s)
        if wanted.deadline_s:
            self._statistics.add_duration("wait", int((now_s - wanted.began_s) * 1e9))

    def _reply(
        self,
        session: Session,
        request: int,
        answer: _Answer,
        removed: tuple[str, ...],
        removed_packed: bytes,
    ) -> None:
        reply = encode_cells(
            request,
            self._epoch,
            self._store.catalogue.map_version,
            answer.handles,
            removed,
            removed_packed,
            answer.pending,
            answer.failed,
        )
        self._send(session, reply)

    def _hand_out(self, session: Session, answer: _Answer, now_s: float) -> None:
        for resident in answer.residents:
            resident.last_use_s = now_s
            resident.hits += 1
        session.hold(answer.residents)
        self._store.used.update(answer.residents)
        self._statistics.add("handles_sent", len(answer.handles))

    def _answer_cold(self, wanted: Wanted, index: int, layer: str, answer: _Answer, now_s: float) -> None:
        """Answer for one cell that is not simply warm."""
        store = self._store
        key = Key(store.catalogue.id(index), layer)
        wire_id = store.wire_id(key.cell_id)
        slot = store.books.slot(key)
        refusal = wanted.refused.get(key)
        resident = slot.resident if slot.resident is None or slot.resident.checked else None
        current = resident is not None and resident.version == store.layers.version(index, layer)
        if resident is not None and refusal is None and (current or key.cell_id not in wanted.held_old):
            answer.handles.append(resident.handle if current else resident.stale_handle)
            answer.residents.append(resident)
        if refusal is not None:
            mine = wanted.session.as_holder(wanted.session.held_bytes, len(wanted.session.held))
            answer.failed.append(FailedCell(wire_id, layer, *refusal, (mine,)))
        elif not current and slot.failure is not None and slot.load is None:
            holders: tuple[Holder, ...] = ()
            if slot.failure.code in SPACE_CODES:
                if answer.blockers is None:
                    answer.blockers = store.reclaimer.holders_of(store.reclaimer.everything())
                holders = answer.blockers
            answer.failed.append(FailedCell(wire_id, layer, slot.failure.code, slot.failure.message, holders))
        elif not current:
            if slot.load is None:  # evicted, or no longer out of room: "pending" promises a load
                store.want(index, layer, PROMISED, now_s, wanted.session.asker)
            answer.pending.append(PendingCell(wire_id, layer))
        store.books.forget_if_empty(key)


def _check_wait(wait_s: float | None) -> None:
    if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
        raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")
