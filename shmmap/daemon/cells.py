# SPDX-License-Identifier: Apache-2.0
"""Requests for cells: area, differential and selected.

A request first becomes a `Wanted`: which cells in which order, minus what the client holds.  If all
of it is warm the answer leaves at once.  Otherwise loads are queued, nearest cells first, and the
answer leaves when the last one settled or the client's patience ends, whichever is first.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import msgspec
import numpy as np

from shmmap.daemon.residency import Key, Resident
from shmmap.daemon.sessions import Session
from shmmap.daemon.store import HAND_OUT_GRACE_S, SPACE_CODES, Store
from shmmap.errors import BadRequest
from shmmap.geometry import Area, ZRange, distance_to_boxes
from shmmap.layers.spec import canonical_layer
from shmmap.protocol import messages
from shmmap.protocol.codec import encode, pack_versions, unpack_versions
from shmmap.protocol.messages import FailedCell, Holder, PendingCell
from shmmap.statistics.writer import StatisticsWriter

__all__ = ["CellRequests", "Wanted"]

MAX_WAIT_S: Final = 3600.0


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
    held_old: frozenset[str] = frozenset()
    area: Area | None = None
    keys: tuple[Key, ...] = ()
    outstanding: set[Key] = field(default_factory=set)
    deadline_s: float = 0.0


@dataclass(eq=False, slots=True)
class _Named:
    """Held cells named one by one: per cell which layers are current, what to remove, what is old."""

    layers: dict[int, frozenset[str]] = field(default_factory=dict)
    removed: dict[str, None] = field(default_factory=dict)
    old: set[str] = field(default_factory=set)
    versions: set[int] = field(default_factory=set)


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
        self._by_deadline: list[Wanted] = []

    def __len__(self) -> int:
        return len(self._by_deadline)

    # --- the three verbs ------------------------------------------------------------------------

    def area(self, session: Session, message: messages.Area, now_s: float) -> None:
        """All cells that touch an area."""
        area = messages.area_from_message(message.area)
        layers = _layers(message.layers)
        indices = self._in_area(area)
        cells = [(index, layer) for index in indices for layer in layers]
        self._begin(Wanted(session, message.request, cells, area=area), message.wait, area, now_s)

    def selected(self, session: Session, message: messages.Selected, now_s: float) -> None:
        """Cells by id, in the order asked for."""
        layers = _layers(message.layers)
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
        area = messages.area_from_message(message.area)
        layers = _layers(message.layers)
        indices = self._in_area(area)
        order = unpack_versions(message.packed)
        packed = set(order)
        named = self._named(message.held, indices, layers)
        version = self._store.catalogue.version
        cells: list[tuple[int, str]] = []
        current: set[int] = set()
        for layer in layers:
            warm = self._store.warm.get(layer, {})
            for index in indices:
                resident = warm.get(index)
                now = resident.version if resident is not None else version(index)
                current.add(now)
                if now not in packed and layer not in named.layers.get(index, ()):
                    cells.append((index, layer))
        if len(layers) > 1:
            cells.sort(key=lambda cell: (cell[0], layers.index(cell[1])))
        gone = packed - current
        held_old = set(named.old)
        if gone:
            asked = {self._store.catalogue.id(index) for index, _ in cells}
            superseded = {v: c for v in gone if (c := self._store.cell_of_version(v)) in asked}
            held_old.update(cell for cell in superseded.values() if cell is not None)
            gone -= superseded.keys()
        wanted = Wanted(
            session,
            message.request,
            cells,
            removed=tuple(named.removed),
            removed_packed=pack_versions(v for v in dict.fromkeys(order) if v in gone),
            held_old=frozenset(held_old),
            area=area,
        )
        self._account(session, packed | named.versions)
        self._begin(wanted, message.wait, area, now_s)

    def _named(
        self, held: Sequence[messages.HeldCell], indices: list[int], layers: tuple[str, ...]
    ) -> _Named:
        """Sort the held cells that the client names one by one."""
        named = _Named()
        if not held:
            return named
        index_of, version = self._store.index_of, self._store.catalogue.version
        inside = set(indices)
        everything = frozenset(layers)
        for cell in held:
            index = index_of(cell.id)
            if cell.version is not None:
                named.versions.add(cell.version)
            if index is None or index not in inside:
                named.removed[cell.id] = None
                continue
            now = version(index)
            if cell.version is None:
                named.versions.add(now)
            elif cell.version != now:
                named.old.add(self._store.catalogue.id(index))
                continue
            had = everything if cell.layers is None else frozenset(_layers(cell.layers))
            before = named.layers.get(index)
            named.layers[index] = had if before is None else before | had
        return named

    def _account(self, session: Session, held: set[int]) -> None:
        """The client says what it holds: note what it dropped since, and free it where possible."""
        dropped = [version for version in session.held if version not in held]
        if dropped:
            residents = [resident for version in dropped for resident in session.drop(version)]
            self.let_go(residents)

    def let_go(self, residents: Iterable[Resident]) -> None:
        """Somebody dropped these: what was refused for want of memory may fit now."""
        self._store.reclaimer.let_go(residents, self._now_s())
        self._store.books.clear_failures(SPACE_CODES)

    def _in_area(self, area: Area) -> list[int]:
        indices: list[int] = self._store.catalogue.query(area).tolist()
        if area.z is None:
            return indices
        return [index for index, _ in self._at_height([(index, "") for index in indices], area.z)]

    def _at_height(self, cells: list[tuple[int, str]], z: ZRange) -> list[tuple[int, str]]:
        """Leave out cells whose heights, known once they were loaded, lie outside the range."""
        heights = self._store.heights
        return [cell for cell in cells if (h := heights.get(cell[0])) is None or z.overlaps(*h)]

    # --- waiting and answering ------------------------------------------------------------------

    def _begin(self, wanted: Wanted, wait_s: float | None, area: Area | None, now_s: float) -> None:
        if wait_s is not None and not 0 <= wait_s <= MAX_WAIT_S:
            raise BadRequest(f"wait must be between 0 and {MAX_WAIT_S:.0f} seconds, not {wait_s!r}")
        warm = self._store.warm
        find = self._store.find_warm
        cold = [
            (index, layer)
            for index, layer in wanted.cells
            if index not in warm.get(layer, {}) and find(index, layer) is None
        ]
        self._statistics.add("hits", len(wanted.cells) - len(cold))
        self._check_quota(wanted, cold)
        if cold:
            self._statistics.add("misses", len(cold))
            self._load(wanted, cold, area, now_s)
            if wait_s and wanted.outstanding:
                wanted.deadline_s = now_s + wait_s
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
            if store.want(index, layer, distance, now_s).load is not None:
                wanted.outstanding.add(key)

    def _check_quota(self, wanted: Wanted, cold: Sequence[tuple[int, str]]) -> None:
        """Refuse what would make this session keep more than its quota for itself alone."""
        session, store = wanted.session, self._store
        chilled = set(cold)
        sizes = [
            store.estimate(index) if (index, layer) in chilled else store.warm[layer][index].nbytes
            for index, layer in wanted.cells
        ]
        if session.held_bytes + sum(sizes) <= self._quota_bytes:
            return
        self._refresh(session)
        left = self._quota_bytes - session.exclusive_bytes()
        boxes = store.catalogue.boxes[np.array([index for index, _ in wanted.cells], dtype=np.intp)]
        if session.intent is not None:
            order = np.argsort(distance_to_boxes(session.intent.x, session.intent.y, boxes), kind="stable")
        elif wanted.area is not None:
            order = np.argsort(distance_to_boxes(*wanted.area.center, boxes), kind="stable")
        else:
            order = np.arange(len(boxes))
        for position in order.tolist():
            index, layer = wanted.cells[position]
            key = Key(store.catalogue.id(index), layer)
            resident = None if (index, layer) in chilled else store.warm[layer][index]
            if resident is not None and resident.sessions - {session.slot}:
                continue  # somebody else keeps it anyway
            if resident is not None and session.slot in resident.sessions:
                continue
            left -= sizes[position]
            if left < 0:
                message = (
                    f"this client would keep more than {self._quota_bytes} bytes (its quota) for itself alone"
                )
                wanted.refused[key] = ("over_budget", message)
                self._statistics.add("refused_quota")

    def _refresh(self, session: Session) -> None:
        """Ask the kernel which segments the session really still uses."""
        for resident in list(session.residents()):
            slots = self._store.reclaimer.slots_of(resident)
            if slots is not None and session.slot not in slots and resident.handed_until_s <= self._now_s():
                session.drop_resident(resident)

    def _wait(self, wanted: Wanted) -> None:
        catalogue = self._store.catalogue
        wanted.keys = tuple({Key(catalogue.id(index), layer) for index, layer in wanted.cells})
        for key in wanted.keys:
            self._store.books.slot(key).waiting += 1
        for key in wanted.outstanding:
            self._waiting.setdefault(key, []).append(wanted)
        self._by_deadline.append(wanted)

    def _stop_waiting(self, wanted: Wanted) -> None:
        for key in wanted.keys:
            self._store.books.unwait(key)
        for key in wanted.outstanding:
            waiters = self._waiting.get(key)
            if waiters is not None:
                waiters.remove(wanted)
                if not waiters:
                    del self._waiting[key]
        self._by_deadline.remove(wanted)

    def settled(self, key: Key) -> None:
        """A load ended: answer the requests it was the last one for."""
        for wanted in self._waiting.pop(key, ()):
            wanted.outstanding.discard(key)
            if not wanted.outstanding:
                self._stop_waiting(wanted)
                self._answer(wanted, self._now_s())

    def next_deadline_s(self) -> float:
        """When the next client's patience ends; infinity when nobody waits."""
        return min((wanted.deadline_s for wanted in self._by_deadline), default=float("inf"))

    def answer_overdue(self, now_s: float) -> None:
        """Answer those who waited long enough, with what there is."""
        for wanted in [w for w in self._by_deadline if w.deadline_s <= now_s]:
            self._stop_waiting(wanted)
            self._answer(wanted, now_s)

    def forget(self, session: Session) -> None:
        """The session ended: nobody waits for its requests any more."""
        for wanted in [w for w in self._by_deadline if w.session is session]:
            self._stop_waiting(wanted)

    def renumber(self, new_index: Callable[[int], int | None], id_of: Callable[[int], str]) -> None:
        """The catalogue is about to be replaced: follow the cells that requests wait for.

        ``new_index`` maps an old index to the new one, None for a cell that left the map.
        """
        for wanted in self._by_deadline:
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
        for wanted in list(self._by_deadline):
            self._stop_waiting(wanted)
            self._answer(wanted, now_s)

    def _answer(self, wanted: Wanted, now_s: float) -> None:
        session, warm = wanted.session, self._store.warm
        handles: list[msgspec.Raw] = []
        pending: list[PendingCell] = []
        failed = [FailedCell(cell_id, layer, "unknown_cell", "the map has no such cell")
                  for cell_id, layer in wanted.unknown]  # fmt: skip
        grace_s = now_s + HAND_OUT_GRACE_S
        blockers: tuple[Holder, ...] | None = None
        if wanted.area is not None and wanted.area.z is not None:
            wanted.cells = self._at_height(wanted.cells, wanted.area.z)
        for index, layer in wanted.cells:
            resident = warm[layer].get(index) if layer in warm else None
            if resident is not None and not wanted.refused:
                handles.append(msgspec.Raw(resident.handle))
                resident.last_use_s = now_s
                resident.hits += 1
                resident.handed_until_s = grace_s
                session.hold(resident)
                continue
            blockers = self._answer_cold(wanted, index, layer, handles, pending, failed, blockers, now_s)
        reply: tuple[Any, ...] = (
            "cells",
            wanted.request,
            self._epoch,
            self._store.catalogue.map_version,
            handles,
            wanted.removed,
            wanted.removed_packed,
            pending,
            failed,
        )
        self._statistics.add("handles_sent", len(handles))
        self._send(session, encode(reply))

    def _answer_cold(
        self,
        wanted: Wanted,
        index: int,
        layer: str,
        handles: list[msgspec.Raw],
        pending: list[PendingCell],
        failed: list[FailedCell],
        blockers: tuple[Holder, ...] | None,
        now_s: float,
    ) -> tuple[Holder, ...] | None:
        """Answer for one cell that is not simply warm."""
        store = self._store
        key = Key(store.catalogue.id(index), layer)
        wire_id = store.wire_id(key.cell_id)
        slot = store.books.slot(key)
        refusal = wanted.refused.get(key)
        resident = slot.resident
        current = resident is not None and resident.version == store.catalogue.version(index)
        if resident is not None and refusal is None and (current or key.cell_id not in wanted.held_old):
            handles.append(msgspec.Raw(resident.handle if current else resident.stale_handle))
            resident.last_use_s = now_s
            resident.handed_until_s = now_s + HAND_OUT_GRACE_S
            wanted.session.hold(resident)
        if current and refusal is None:
            return blockers
        if refusal is not None:
            mine = wanted.session.as_holder(wanted.session.held_bytes, len(wanted.session.held))
            failed.append(FailedCell(wire_id, layer, *refusal, (mine,)))
        elif slot.failure is not None and slot.load is None:
            holders: tuple[Holder, ...] = ()
            if slot.failure.code in SPACE_CODES:
                if blockers is None:
                    blockers = store.reclaimer.holders_of(store.reclaimer.everything())
                holders = blockers
            failed.append(FailedCell(wire_id, layer, slot.failure.code, slot.failure.message, holders))
        else:
            pending.append(PendingCell(wire_id, layer))
        store.books.forget_if_empty(key)
        return blockers


def _layers(specs: Sequence[str]) -> tuple[str, ...]:
    """Canonical layers, duplicates left out."""
    if not specs:
        raise BadRequest("a request must name at least one layer")
    return tuple(dict.fromkeys(itertools.starmap(canonical_layer, ((spec,) for spec in specs))))
