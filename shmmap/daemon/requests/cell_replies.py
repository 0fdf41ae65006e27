# SPDX-License-Identifier: Apache-2.0
"""Replies to requests for cells: a handle for each cell that is in memory, for each other why not."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Final

import msgspec

from shmmap.daemon.cache.cell_cache import CellCache
from shmmap.daemon.loading.scheduler import Scheduler
from shmmap.daemon.records import SPACE_CODES, Key, Resident
from shmmap.daemon.requests.pending_request import PendingRequest, parts
from shmmap.daemon.transport.sessions import Session
from shmmap.protocol.codec import PackedArray, encode_cells
from shmmap.protocol.messages import FailedCell, Holder, PendingCell

__all__ = ["Answer", "CellReplies"]

MOST_HOLDERS: Final = 16
"""Named beside each cell that does not fit: those who have most."""
UNNAMED: Final = (Holder(0, 0, -1, "", 0, 0),)
"""Stands for them until they are found out."""
HELD_A_STEP: Final = 256
"""Of cells handed out, how many are noted in one turn, 0.1 us each: all that lie around a vehicle."""
PROMISED: Final = 1e9
"""Priority of a load that only a "pending" speaks of: behind the distances of all that is asked for."""


@dataclass(eq=False, slots=True)
class Answer:
    """A reply in the making.

    ``pending`` and ``failed`` are what is not in ``packed`` yet, the same two encoded.  If ``short``, some
    failed for lack of memory, and who has it is still to be named (`UNNAMED`).
    """

    handles: list[bytes] = field(default_factory=list)
    residents: list[Resident] = field(default_factory=list)
    pending: list[PendingCell] = field(default_factory=list)
    failed: list[FailedCell] = field(default_factory=list)
    short: bool = False
    packed: tuple[PackedArray, ...] = ()

    def pack(self) -> None:
        """Encode what came since the last time."""
        if self.pending or self.failed:
            self.packed = pending, failed = self.packed or (PackedArray(), PackedArray())
            pending.add(self.pending)
            self.pending.clear()
            if not self.short:
                failed.add(self.failed)
                self.failed.clear()


@dataclass(eq=False, slots=True)
class CellReplies:
    """Answers with what the cache has and what is being loaded."""

    cache: CellCache
    scheduler: Scheduler

    def answer(self, wanted: PendingRequest, now_s: float) -> Generator[None, None, None]:
        """Send what there is by now of everything that is wanted.

        Raises
        ------
        MapChanged, NoSession
            See `PendingRequest.pause`; nothing was sent.
        """
        warm = self.cache.warm.layers
        answer = Answer()
        if wanted.area is not None and wanted.area.z is not None:
            inside = set(self.cache.at_height([index for index, _ in wanted.cells], wanted.area.z))
            wanted.cells = [cell for cell in wanted.cells if cell[0] in inside]
        for number, unknown in enumerate(parts(wanted.unknown)):
            if number:
                yield from wanted.pause(self.cache)
            for cell_id, layer in unknown:
                answer.failed.append(FailedCell(cell_id, layer, "unknown_cell", "the map has no such cell"))
            answer.pack()
        for number, part in enumerate(parts(wanted.cells)):
            if number:
                yield from wanted.pause(self.cache)
            for index, layer in part:
                resident = warm[layer].get(index) if layer in warm else None
                if resident is None:  # evicted since the request came, perhaps, and still whole
                    resident = self.cache.find_warm(index, layer, now_s)
                if resident is not None and not wanted.refused:
                    answer.handles.append(resident.handle)
                    answer.residents.append(resident)
                else:
                    self._answer_cold(wanted, index, layer, answer, now_s)
            answer.pack()
        if answer.short:
            yield from self._name_holders(wanted, answer)
        self.reply(
            wanted.session, wanted.request, answer, wanted.layers, wanted.covered, reason=wanted.reason,
            removed=wanted.removed, removed_packed=wanted.removed_packed,
        )  # fmt: skip
        if wanted.began_s:
            self.cache.statistics.add_duration("wait", int((now_s - wanted.began_s) * 1e9))
        yield from self.hand_out(wanted.session, answer, now_s)

    def reply(
        self,
        session: Session,
        request: int,
        answer: Answer,
        layers: tuple[str, ...],
        covered: bool = True,
        *,
        reason: str = "",
        removed: tuple[str, ...],
        removed_packed: bytes,
    ) -> None:
        """Send a reply; the bookkeeping follows in `hand_out`, when it is on its way."""
        cache = self.cache
        reply = encode_cells(
            request, cache.epoch, cache.catalogue.map_version, answer.handles, removed, removed_packed,
            layers, covered, *answer.packed, reason=reason,
        )  # fmt: skip
        session.connection.reply(reply)

    def hand_out(self, session: Session, answer: Answer, now_s: float) -> Iterator[None]:
        """Note who has been given what."""
        first_used = 0
        for resident in answer.residents:
            resident.last_use_s = now_s  # from now on it is spared for as long as opening it takes
            if not resident.hits:
                first_used += resident.nbytes
                if resident.prefetched:
                    self.cache.ledger.asked_for(resident)
                    self.cache.statistics.add("prefetch_used")
            resident.hits += 1
        self.cache.statistics.add("bytes_used", first_used)
        self.cache.used.update(answer.residents)
        self.cache.statistics.add("handles_sent", len(answer.handles))
        for number, residents in enumerate(parts(answer.residents, HELD_A_STEP)):
            if number:
                yield
                if not session.is_connected:
                    return
            session.hold(residents)

    def _answer_cold(
        self, wanted: PendingRequest, index: int, layer: str, answer: Answer, now_s: float
    ) -> None:
        """Answer for one cell that is not simply warm."""
        cache, loads = self.cache, self.scheduler.loads
        key = Key(cache.catalogue.id(index), layer)
        wire_id = cache.wire_id(key.cell_id)
        failure, promised = loads.failures.get(key), loads.is_promised(key)
        refusal = wanted.refused.get(key)
        resident = cache.ledger.by_key.get(key)
        resident = resident if resident is None or resident.checked else None
        current = resident is not None and resident.version == cache.layers.version(index, layer)
        if resident is not None and refusal is None and (current or key not in wanted.held_old):
            answer.handles.append(resident.handle if current else resident.stale_handle)
            answer.residents.append(resident)
        if refusal is not None:
            mine = wanted.session.as_holder(wanted.session.held_bytes, len(wanted.session.held))
            box = cache.catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, *refusal, (mine,) if mine.bytes else (), box))
        elif not current and failure is not None and not promised:
            holders: tuple[Holder, ...] = ()
            if failure.code in SPACE_CODES:
                holders, answer.short = UNNAMED, True
            box = cache.catalogue.box(index)
            answer.failed.append(FailedCell(wire_id, layer, failure.code, failure.message, holders, box))
        elif not current:
            if not promised:  # evicted, or no longer out of room: "pending" promises a load
                self.scheduler.want(index, layer, PROMISED, now_s, wanted.session.asker)
            answer.pending.append(PendingCell(wire_id, layer))

    def _name_holders(self, wanted: PendingRequest, answer: Answer) -> Iterator[None]:
        """Say beside each cell that there is no memory for who fills the budget."""
        holders: list[Holder] = []
        for _ in self.cache.holders.look(self.cache.ledger.segments.walk(), holders):
            yield from wanted.pause(self.cache)
        most = tuple(holders[:MOST_HOLDERS])
        failed, answer.failed, answer.short = answer.failed, [], False
        for number, part in enumerate(parts(failed)):
            if number:
                yield from wanted.pause(self.cache)
            answer.failed += [
                msgspec.structs.replace(cell, holders=most) if cell.holders is UNNAMED else cell
                for cell in part
            ]
            answer.pack()
