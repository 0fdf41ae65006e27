# SPDX-License-Identifier: Apache-2.0
"""One live map as its clients use it: requests are accepted, and answered when they are fulfilled."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, TypeVar

import msgspec

from shmmap.chunks.marks import decode_marks
from shmmap.chunks.voxels import CHUNK_SIDE, FURTHEST_SENSOR
from shmmap.errors import BadRequest, Busy, CannotWrite, InternalError, NotPermitted, ShmmapError
from shmmap.live_messages import MAX_PER_SESSION, Ask
from shmmap.live_settings import LiveSettings
from shmmap.live_worker.chunk_memory import ChunkMemory
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.mappers import APPLIED_BYTES, ActiveMapper, AppliedScans, Mappers
from shmmap.live_worker.marks_directory import MAX_MARKS_BYTES, MarksDirectory
from shmmap.live_worker.paged_map import PagedMap
from shmmap.live_worker.paging.durability import Chunk, Scan
from shmmap.live_worker.paging.residency import Limits
from shmmap.live_worker.paging.windows import place_ahead
from shmmap.live_worker.readers import Readers
from shmmap.logfmt import log
from shmmap.protocol import live as messages
from shmmap.protocol.messages import ErrorReply

_T = TypeVar("_T")

AHEAD_S: Final = 2.0
"""Look-ahead: chunks are loaded around the place that a client will have reached after this time."""
MAX_AHEAD_CHUNKS: Final = 4.0
MARKS_PART: Final = 2
"""Divisor of the budget for the marks of one scan, which are in shared memory until they are accepted."""
RECORD_S: Final = 60.0
SAY_WHY_S: Final = 1.0
"""After this time a scan that waits because of a problem is answered with the problem."""
MAX_LOSSES: Final = 64
"""Most lost chunks and damaged databases that are named; all are counted."""
FILES_S: Final = 0.5
"""Interval at which the sizes of files are summed."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Place of a session, and the time at which it was there."""

    xyz: tuple[float, float, float]
    seen_s: float


@dataclass(frozen=True, slots=True)
class _Ticket:
    """A request to apply a scan, and the time at which it came."""

    number: int
    request: int
    since_s: float


class ServedMap:
    """Answers the requests about one map, and observes its changes.

    Parameters
    ----------
    database, memory, limits
        The map on disk, its memory and its limits; `adopt` takes over the chunks that a previous run left in
        memory.
    marks
        Directory where mappers put marks.
    answer
        Sends a reply, given the request's ticket.
    wake
        Called in another thread when there is work for the next turn.
    codec
        How chunks are compressed on disk.
    """

    def __init__(
        self,
        settings: LiveSettings,
        database: MapDatabase,
        memory: ChunkMemory,
        limits: Limits,
        marks: MarksDirectory,
        answer: Callable[[int, Any], None],
        wake: Callable[[], None] = lambda: None,
        codec: str = "zlib",
    ) -> None:
        self.settings = settings
        self.paged = PagedMap(database, memory, limits, self, wake, codec)
        self.mappers = Mappers(database, AppliedScans(memory.record("applied", APPLIED_BYTES)))
        self.readers = Readers(self.paged, answer, wake)
        self._marks = marks
        self._answer = answer
        self._tickets: dict[tuple[int, int], list[_Ticket]] = {}  # of scans accepted and not applied yet
        self._waiting: deque[tuple[_Ticket, Ask, messages.LiveScan]] = deque()
        self._saves: list[tuple[Ask, messages.LiveSave, list[tuple[Chunk, int]]]] = []
        self._places: dict[int, _Place] = {}
        self._writing: dict[int, int] = {}  # sessions by ticket whose requests wait for the disk
        self._adopted: list[tuple[Chunk, int]] = []  # applied by a previous run, not durable yet
        self._scans = self._durable = 0
        self._marks_bytes = 0  # size of marks in shared memory when last counted
        self._file_bytes, self._files_s = 0, -math.inf
        self._record_s = 0.0
        self._recorded = -1

    def adopt(self, now_s: float) -> int:
        """Take over the chunks that a previous run left in memory; return how many; see `PagedMap.adopt`."""
        self.readers.lists.remove_all()
        adopted = self.paged.adopt(now_s)
        self._adopted = self.paged.not_durable()
        return adopted

    # --- requests -------------------------------------------------------------------------------

    def handle(self, ask: Ask, message: messages.LiveRequest, now_s: float) -> None:
        """Answer a request now or later; raise the error that refuses it."""
        if isinstance(message, messages.LiveScan | messages.LiveSave):
            _require_mapper(ask)
        if isinstance(message, messages.LiveOpen):
            self._open(ask, message)
        elif isinstance(message, messages.LiveScan):
            self._scan(ask, message, now_s)
        elif isinstance(message, messages.LiveMove):
            self._move(ask.session, message.position, now_s)
            self._answer(ask.ticket, messages.LiveMoved(message.request, self.paged.changes.number))
        elif isinstance(message, messages.LiveSave):
            self._saves.append((ask, message, self.paged.not_durable()))
        elif isinstance(message, messages.LiveChunks | messages.LiveVoxels):
            self.readers.begin(ask, message)
        elif isinstance(message, messages.LiveRelease):
            self.readers.lists.release(ask.session, message.segment)
            self._answer(ask.ticket, messages.LiveReleased(message.request))

    def _open(self, ask: Ask, message: messages.LiveOpen) -> None:
        paged, fixed = self.paged, self.paged.database.settings
        if message.frame_id not in ("", fixed.frame_id):
            raise BadRequest(
                f"live map {self.settings.name} is in frame {fixed.frame_id!r}, not {message.frame_id!r}",
                hint="transform the poses, or use another map",
            )
        hit, miss, low, high = fixed.occupancy.steps
        above, below = fixed.occupancy.thresholds
        reply = messages.LiveOpened(
            message.request,
            paged.database.map_id,
            fixed.resolution,
            fixed.frame_id,
            hit,
            miss,
            low,
            high,
            above,
            below,
            paged.memory.path,
            paged.memory.prefix,
            probabilities=msgspec.structs.astuple(fixed.occupancy),
        )
        if not message.mapper:
            self._answer(ask.ticket, reply)
            return
        _require_mapper(ask)

        def opened(active: ActiveMapper) -> None:
            reply.mapper, reply.next_scan = active.mapper.number, self.mappers.next_scan(active)
            reply.applied = active.applied
            reply.marks_dir = self._marks.path
            reply.max_marks_bytes = min(MAX_MARKS_BYTES, paged.limits.budget_bytes // MARKS_PART)
            self._answer(ask.ticket, reply)

        open_mapper = partial(self.mappers.open, ask.uid, message.mapper, ask.session)
        self._on_disk(ask, message.request, open_mapper, opened)

    def _on_disk(self, ask: Ask, request: int, work: Callable[[], _T], then: Callable[[_T], None]) -> None:
        """Write to disk first, in a file thread since the directory may hang; answer if that fails."""
        self._writing[ask.ticket] = ask.session

        def written(future: Future[_T], now_s: float) -> None:
            del now_s
            if self._writing.pop(ask.ticket, None) is None:
                self.mappers.on_disconnect(ask.session)  # the session has ended meanwhile
                return
            try:
                then(future.result())
            except ShmmapError as error:
                self._refuse(ask, request, error)
            except OSError as error:
                text = f"live map {self.settings.name}: its directory cannot be written: {error.strerror}"
                hint = f"see to {self.settings.path}; what is in memory stays there"
                self._refuse(ask, request, CannotWrite(text, hint=hint))

        self.paged.on_disk(work, written)

    def _scan(self, ask: Ask, message: messages.LiveScan, now_s: float) -> None:
        expect = partial(self.mappers.expect, message.mapper, message.scan, ask.session)
        if self.mappers.is_far(message.mapper, message.scan):
            self._on_disk(ask, message.request, expect, lambda _active: self._scan(ask, message, now_s))
            return
        active = expect()
        self._move(ask.session, message.sensor, now_s)
        tickets = self._tickets.get((active.mapper.number, message.scan))
        ticket = _Ticket(ask.ticket, message.request, now_s)
        if tickets is not None:
            self._add_ticket(tickets, ticket)
        else:
            self._waiting.append((ticket, ask, message))

    @staticmethod
    def _add_ticket(tickets: list[_Ticket], ticket: _Ticket) -> None:
        tickets.append(ticket)
        del tickets[:-MAX_PER_SESSION]  # older tickets belong to sessions that have ended

    def _say_why(self, now_s: float) -> None:
        """Refuse scans that wait because of a problem: their mappers send them again, and they count once.

        Scans that are accepted are applied all the same.
        """
        if not (problem := self.paged.problem):
            return
        before_s = now_s - SAY_WHY_S
        late = [ticket for ticket, _, _ in self._waiting if ticket.since_s <= before_s]
        self._waiting = deque(row for row in self._waiting if row[0].since_s > before_s)
        for tickets in self._tickets.values():
            late += [one for one in tickets if one.since_s <= before_s]
            tickets[:] = [one for one in tickets if one.since_s > before_s]
        text = f"live map {self.settings.name}: a scan waits: {problem}"
        for one in late:
            reply = ErrorReply(
                one.request, Busy.code, text, "it is applied when that is mended; it counts once"
            )
            self._answer(one.number, reply)

    def _accept_scans(self) -> None:
        """Accept waiting scans while there is memory; the others stay in the directory of marks."""
        while self._waiting and self.paged.residency.has_room(self._waiting[0][2].bytes):
            ticket, ask, message = self._waiting.popleft()
            try:
                self._accept(ticket, ask, message)
            except ShmmapError as error:
                self._refuse(ask, message.request, error)
            except Exception:  # noqa: BLE001  a defect with one file must not end the map for all
                log.exception("marks cannot be read")
                self._refuse(ask, message.request, InternalError("the daemon failed on these marks"))

    def _accept(self, ticket: _Ticket, ask: Ask, message: messages.LiveScan) -> None:
        active = self.mappers.by_number.get(message.mapper)
        if active is None or active.session != ask.session:
            raise BadRequest(f"the session does not map as mapper {message.mapper} any more")
        tickets = self._tickets.get((message.mapper, message.scan))
        if tickets is not None:
            self._add_ticket(tickets, ticket)
            return
        data = self._marks.take(message.marks, message.bytes, ask.session, ask.uid)
        marks = decode_marks(data, self.paged.database.map_id, message.mapper, message.scan)
        self.mappers.accepted(active, message.scan)
        self._tickets[message.mapper, message.scan] = [ticket]
        self.paged.add(message.mapper, message.scan, marks, message.bytes)

    def _move(self, session: int, position: tuple[float, float, float], now_s: float) -> None:
        """Move a client: load chunks near its place and near its predicted place."""
        reach = FURTHEST_SENSOR * self.paged.resolution
        if not all(-reach < value < reach for value in position):
            raise BadRequest(f"position {position}: it is not finite, or too far away")
        self.paged.move(session, position)
        before = self._places.get(session)
        self._places[session] = _Place(position, now_s)
        if before is None or now_s <= before.seen_s:
            return
        longest = MAX_AHEAD_CHUNKS * CHUNK_SIDE * self.paged.resolution
        ahead = place_ahead(before.xyz, position, now_s - before.seen_s, AHEAD_S, longest)
        self.paged.move((session, "ahead"), ahead)

    def on_disconnect(self, session: int) -> None:
        """Handle the end of a session: accepted scans are applied, other requests dropped."""
        for client in (session, (session, "ahead")):
            self.paged.residency.leave(client)
        self._places.pop(session, None)
        self._writing = {ticket: one for ticket, one in self._writing.items() if one != session}
        self.mappers.on_disconnect(session)
        self.readers.on_disconnect(session)
        self._waiting = deque(row for row in self._waiting if row[1].session != session)
        self._saves = [row for row in self._saves if row[0].session != session]

    # --- changes of the map ----------------------------------------------------------------

    def scan_applied(self, scan: Scan) -> None:
        """Answer all requests that contain this scan."""
        self._scans += 1
        durable = 0
        active = self.mappers.by_number.get(scan.mapper)
        if active is not None:
            self.mappers.applied(active, scan.number)
            durable = active.durable if self._adopted_is_durable() else 0
        for one in self._tickets.pop((scan.mapper, scan.number), ()):
            self._answer(one.number, messages.LiveApplied(one.request, scan.number, durable))

    def _adopted_is_durable(self) -> bool:
        """Return whether all adopted chunks are on disk; the scans in them are not known."""
        self._adopted = _left(self._adopted)
        return not self._adopted

    def scan_durable(self, scan: Scan) -> None:
        """Record that a scan is on disk."""
        self._durable += 1
        active = self.mappers.by_number.get(scan.mapper)
        if active is not None:
            active.unsaved.discard(scan.number)

    def _durable_scans(self) -> dict[int, int] | None:
        """Return, for each mapper, the scan up to which all are on disk; None while that is unknown."""
        known = self._adopted_is_durable()
        return {number: one.durable for number, one in self.mappers.by_number.items()} if known else None

    def _refuse(self, ask: Ask, request: int, error: ShmmapError) -> None:
        self._answer(ask.ticket, ErrorReply(request, error.code, error.message, error.hint))

    def _answer_saves(self) -> None:
        waiting, self._saves = self._saves, []
        for ask, message, unsaved in waiting:
            if left := _left(unsaved):
                self._saves.append((ask, message, left))
                continue
            mine = [one.durable for one in self.mappers.by_number.values() if one.session == ask.session]
            files = len(self.paged.database.rows)
            self._answer(ask.ticket, messages.LiveDurable(message.request, max(mine, default=0), files))

    # --- turns ----------------------------------------------------------------------------------

    def run_turn(self, now_s: float, *, save_all: bool) -> None:
        """Do the work that is possible now."""
        self._accept_scans()
        self.readers.lists.expire(now_s)
        residency = self.paged.residency
        marks_bytes = sum(min(message.bytes, MAX_MARKS_BYTES) for _, _, message in self._waiting)
        residency.beside_bytes += marks_bytes - self._marks_bytes
        self._marks_bytes = marks_bytes
        residency.asked_bytes = self.readers.lists.asked_bytes
        self.paged.run_turn(now_s, time.time_ns(), save_all=save_all or bool(self._saves))
        self._say_why(now_s)
        if self._saves:
            self._answer_saves()
        self.readers.run_turn(now_s)
        due = now_s >= self._record_s and self.paged.changes.number != self._recorded
        if due or (self.paged.database.record_is_due and now_s >= self.paged.record_retry_s):
            self.paged.database.record_is_due = False
            self._record_s, self._recorded = now_s + RECORD_S, self.paged.changes.number
            self.paged.write_record(self._durable_scans())

    def next_turn_s(self, now_s: float) -> float:
        """Return the time at which the next turn is due, if nothing happens before."""
        residency = self.paged.residency
        first_fits = bool(self._waiting) and residency.has_room(self._waiting[0][2].bytes)
        if first_fits or residency.is_ready:
            return now_s
        record_s = self.paged.record_retry_s if self.paged.database.record_is_due else math.inf
        return min(residency.next_event_s(now_s), self.readers.next_turn_s(now_s), record_s)

    def status(self) -> messages.LiveMapRow:
        """Return the state of the map."""
        paged, residency, now_s = self.paged, self.paged.residency, time.monotonic()
        self.readers.measure(now_s)
        if now_s >= self._files_s:
            self._files_s = now_s + FILES_S
            rows = list(paged.database.rows.values())  # other threads save
            self._file_bytes = sum(row.bytes for row in rows)
        losses, losses_count = paged.database.losses(MAX_LOSSES)
        return messages.LiveMapRow(
            self.settings.name,
            self.settings.path,
            paged.resolution,
            paged.database.settings.frame_id,
            chunks=len(paged.chunks),
            active=residency.active,
            bytes=residency.chunk_bytes,
            loading=len(residency.chunks) - len(paged.chunks),
            dirty=residency.dirty,
            saving=residency.saving,
            waiting_bytes=residency.waiting_bytes,
            files=len(paged.database.rows),
            file_bytes=self._file_bytes,
            scans=self._scans,
            durable=self._durable,
            budget_bytes=paged.limits.budget_bytes,
            damaged=losses,
            mappers=tuple(f"{one.mapper.uid}/{one.mapper.name}" for one in self.mappers.by_number.values()),
            problem=paged.problem,
            change=self.paged.changes.number,
            beside_bytes=residency.beside_bytes,
            readers=self.readers.busiest,
            damaged_count=losses_count,
            mapper_count=len(self.mappers.by_number),
        )

    # --- the end --------------------------------------------------------------------------------

    def stop_accepting(self) -> None:
        """Stop accepting scans: waiting scans are sent again to the next run."""
        self._waiting.clear()

    def end(self, *, keep: bool) -> int:
        """Close the map; return the number of unsaved chunks, which stay in memory."""
        self.readers.close()
        self.readers.lists.remove_all()
        unsaved = self.paged.unsaved
        if not keep and not unsaved:
            self.paged.finish(self._durable_scans())
            self.paged.remove_from_memory()
        self.paged.close()
        return unsaved


def _left(chunks: list[tuple[Chunk, int]]) -> list[tuple[Chunk, int]]:
    """Return the chunks that are not durable in these versions yet."""
    return [(chunk, version) for chunk, version in chunks if chunk.durable < version]


def _require_mapper(ask: Ask) -> None:
    if not ask.maps:
        raise NotPermitted(
            "this user may not change live maps",
            hint="root, the daemon's own user and members of its `live_group` may",
        )
