# SPDX-License-Identifier: Apache-2.0
"""One live map as clients meet it: requests come in, and are answered when what they ask for is so."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import Final, Protocol, TypeVar

import msgspec

from shmmap.chunks.marks import decode_marks
from shmmap.chunks.voxels import CHUNK_SIDE, FURTHEST_SENSOR
from shmmap.daemon.config_live import LiveSettings
from shmmap.daemon.live.live_map import LiveMap
from shmmap.daemon.live.messages import MOST_OF_A_SESSION, Ask
from shmmap.daemon.live.paging.records import Chunk, Scan
from shmmap.daemon.live.paging.windows import place_ahead
from shmmap.daemon.live.worker.applied_scans import AppliedScans
from shmmap.daemon.live.worker.changes import Changes
from shmmap.daemon.live.worker.mappers import ActiveMapper, Mappers
from shmmap.daemon.live.worker.marks_directory import MOST_MARKS_BYTES, MarksDirectory
from shmmap.daemon.live.worker.readers import Readers
from shmmap.daemon.live.worker.voxel_lists import VoxelLists
from shmmap.errors import BadRequest, CannotWrite, InternalError, NotPermitted, ShmmapError
from shmmap.logfmt import log
from shmmap.protocol import live as messages
from shmmap.protocol.messages import ErrorReply

__all__ = ["ServedMap"]

_T = TypeVar("_T")

AHEAD_S: Final = 2.0
"""Chunks are loaded for where a mapper will be then, if it goes on as it does."""
MOST_AHEAD_CHUNKS: Final = 4.0
MARKS_PART: Final = 2
"""Marks of one scan may take this part of the budget: they are in shared memory until they are taken in."""
MANIFEST_S: Final = 60.0
FILES_S: Final = 0.5
"""How often files are added up."""


class _Reply(Protocol):
    request: int


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a session was, and when."""

    xyz: tuple[float, float, float]
    seen_s: float


class ServedMap:
    """Answers what concerns one map.

    Parameters
    ----------
    live, applied
        In memory, with what an earlier life left.
    answer
        Takes a ticket and the reply to it.
    """

    def __init__(
        self,
        settings: LiveSettings,
        live: LiveMap,
        lists: VoxelLists,
        marks: MarksDirectory,
        applied: AppliedScans,
        answer: Callable[[int, _Reply], None],
    ) -> None:
        self.settings = settings
        self.live = live
        self.changes = Changes(time.time_ns())
        self.mappers = Mappers(live.files, applied)
        self.readers = Readers(live, self.changes, lists, answer)
        self._marks = marks
        self._answer = answer
        self._tickets: dict[tuple[int, int], list[tuple[int, int]]] = {}  # of scans that are on their way
        self._waiting: deque[tuple[Ask, messages.LiveScan]] = deque()
        self._saves: list[tuple[Ask, messages.LiveSave, list[tuple[Chunk, int]]]] = []
        self._places: dict[int, _Place] = {}
        self._writing: dict[int, int] = {}  # sessions by ticket whose requests wait for the disk
        durability, chunks = live.residency.durability, live.residency.chunks
        self._earlier = durability.missing(chunks.values())  # what an earlier life applied, and did not save
        self._scans = self._durable = 0
        self._marks_bytes = 0  # of those in shared memory, as it was counted last
        self._file_bytes, self._files_s = 0, -math.inf
        self._manifest_s = 0.0
        self._listed = -1
        live.on_applied, live.on_durable = self._on_applied, self._on_durable
        live.on_changed, live.on_gone = self.changes.changed, self.changes.gone
        for key in live.chunks:
            self.changes.changed(key)

    # --- requests -------------------------------------------------------------------------------

    def handle(self, ask: Ask, message: messages.LiveRequest, now_s: float) -> None:
        """Answer a request now or later; raises what refuses it."""
        if isinstance(message, messages.LiveScan | messages.LiveSave):
            _require_mapper(ask)
        if isinstance(message, messages.LiveOpen):
            self._open(ask, message)
        elif isinstance(message, messages.LiveScan):
            self._scan(ask, message, now_s)
        elif isinstance(message, messages.LiveMove):
            self._move(ask.session, message.position, now_s)
            self._answer(ask.ticket, messages.LiveMoved(message.request, self.changes.number))
        elif isinstance(message, messages.LiveSave):
            residency = self.live.residency
            self._saves.append((ask, message, residency.durability.missing(residency.chunks.values())))
        elif isinstance(message, messages.LiveChunks | messages.LiveVoxels):
            self.readers.begin(ask, message)
        elif isinstance(message, messages.LiveRelease):
            self.readers.lists.release(ask.session, message.segment)
            self._answer(ask.ticket, messages.LiveReleased(message.request))

    def _open(self, ask: Ask, message: messages.LiveOpen) -> None:
        live, fixed = self.live, self.live.files.settings
        if message.frame_id not in ("", fixed.frame_id):
            raise BadRequest(
                f"live map {self.settings.name} is in frame {fixed.frame_id!r}, not {message.frame_id!r}",
                hint="transform the poses, or use another map",
            )
        hit, miss, low, high = fixed.occupancy.steps
        above, below = fixed.occupancy.thresholds
        reply = messages.LiveOpened(
            message.request, live.files.map_id, fixed.resolution, fixed.frame_id, hit, miss, low, high, above,
            below, self.readers.lists.path, live.memory.prefix,
            probabilities=msgspec.structs.astuple(fixed.occupancy),
        )  # fmt: skip
        if not message.mapper:
            self._answer(ask.ticket, reply)
            return
        _require_mapper(ask)

        def opened(active: ActiveMapper) -> None:
            reply.mapper, reply.next_scan = active.mapper.number, self.mappers.next_scan(active)
            reply.applied = active.applied
            reply.marks_dir = self._marks.path
            reply.max_marks_bytes = min(MOST_MARKS_BYTES, live.limits.budget_bytes // MARKS_PART)
            self._answer(ask.ticket, reply)

        open_mapper = partial(self.mappers.open, ask.uid, message.mapper, ask.session)
        self._on_disk(ask, message.request, open_mapper, opened)

    def _on_disk(self, ask: Ask, request: int, work: Callable[[], _T], then: Callable[[_T], None]) -> None:
        """Have something written first, by a file thread, for the directory may hang; answers a refusal."""
        self._writing[ask.ticket] = ask.session

        def written(future: Future[_T], now_s: float) -> None:
            del now_s
            if self._writing.pop(ask.ticket, None) is None:
                self.mappers.left(ask.session)  # the session has ended meanwhile
                return
            try:
                then(future.result())
            except ShmmapError as error:
                self._refuse(ask, request, error)
            except OSError as error:
                said = f"live map {self.settings.name}: its directory cannot be written: {error.strerror}"
                hint = f"see to {self.settings.path}; what is in memory stays there"
                self._refuse(ask, request, CannotWrite(said, hint=hint))

        self.live.on_disk(work, written)

    def _scan(self, ask: Ask, message: messages.LiveScan, now_s: float) -> None:
        expect = partial(self.mappers.expect, message.mapper, message.scan, ask.session)
        if self.mappers.is_far(message.mapper, message.scan):
            self._on_disk(ask, message.request, expect, lambda _active: self._scan(ask, message, now_s))
            return
        active = expect()
        self._move(ask.session, message.sensor, now_s)
        on_its_way = self._tickets.get((active.mapper.number, message.scan))
        if on_its_way is not None:
            self._answer_too(on_its_way, ask, message)
        else:
            self._waiting.append((ask, message))

    @staticmethod
    def _answer_too(tickets: list[tuple[int, int]], ask: Ask, message: messages.LiveScan) -> None:
        tickets.append((ask.ticket, message.request))
        del tickets[:-MOST_OF_A_SESSION]  # earlier ones are of sessions that have ended

    def _take_scans(self) -> None:
        """Take in what waits, as long as there is room for it; the rest waits where the mappers put it."""
        while self._waiting and self.live.residency.has_room(self._waiting[0][1].bytes):
            ask, message = self._waiting.popleft()
            try:
                self._take(ask, message)
            except ShmmapError as error:
                self._refuse(ask, message.request, error)
            except Exception:  # noqa: BLE001  whatever is in a file must not end everybody's maps
                log.exception("marks cannot be read")
                self._refuse(ask, message.request, InternalError("the daemon failed on these marks"))

    def _take(self, ask: Ask, message: messages.LiveScan) -> None:
        active = self.mappers.by_number.get(message.mapper)
        if active is None or active.session != ask.session:
            raise BadRequest(f"the session does not map as mapper {message.mapper} any more")
        on_its_way = self._tickets.get((message.mapper, message.scan))
        if on_its_way is not None:
            self._answer_too(on_its_way, ask, message)
            return
        data = self._marks.take(message.marks, message.bytes, ask.session, ask.uid)
        marks = decode_marks(data, self.live.files.map_id, message.mapper, message.scan)
        self.mappers.taken(active, message.scan)
        self._tickets[message.mapper, message.scan] = [(ask.ticket, message.request)]
        self.live.add(message.mapper, message.scan, marks, message.bytes)

    def _move(self, session: int, position: tuple[float, float, float], now_s: float) -> None:
        """A client is here, and will be further on: what is near both is brought into memory."""
        reach = FURTHEST_SENSOR * self.live.files.settings.resolution
        if not all(-reach < value < reach for value in position):
            raise BadRequest(f"position {position}: it is not finite, or too far away")
        self.live.move(session, position)
        before = self._places.get(session)
        self._places[session] = _Place(position, now_s)
        if before is None or now_s <= before.seen_s:
            return
        most = MOST_AHEAD_CHUNKS * CHUNK_SIDE * self.live.files.settings.resolution
        ahead = place_ahead(before.xyz, position, now_s - before.seen_s, AHEAD_S, most)
        self.live.move((session, "ahead"), ahead)

    def left(self, session: int) -> None:
        """A session has ended: what it sent goes on, what it asked for does not."""
        for client in (session, (session, "ahead")):
            self.live.residency.leave(client)
        self._places.pop(session, None)
        self._writing = {ticket: one for ticket, one in self._writing.items() if one != session}
        self.mappers.left(session)
        self.readers.left(session)
        self._waiting = deque(row for row in self._waiting if row[0].session != session)
        self._saves = [row for row in self._saves if row[0].session != session]

    # --- answers --------------------------------------------------------------------------------

    def _on_applied(self, scan: Scan) -> None:
        self._scans += 1
        durable = 0
        active = self.mappers.by_number.get(scan.mapper)
        if active is not None:
            self.mappers.applied(active, scan.number)
            durable = active.durable if self._earlier_is_durable() else 0
        for ticket, request in self._tickets.pop((scan.mapper, scan.number), ()):
            self._answer(ticket, messages.LiveApplied(request, scan.number, durable))

    def _earlier_is_durable(self) -> bool:
        """Whether all that was found in memory is on the disk: nobody knows which scans made it."""
        self._earlier = [(chunk, version) for chunk, version in self._earlier if chunk.durable < version]
        return not self._earlier

    def _on_durable(self, scan: Scan) -> None:
        self._durable += 1
        active = self.mappers.by_number.get(scan.mapper)
        if active is not None:
            active.unsaved.discard(scan.number)

    def _durable_scans(self) -> dict[int, int] | None:
        """Up to which scan of each mapper all are on the disk; None while that is not known."""
        known = self._earlier_is_durable()
        return {number: one.durable for number, one in self.mappers.by_number.items()} if known else None

    def _refuse(self, ask: Ask, request: int, error: ShmmapError) -> None:
        self._answer(ask.ticket, ErrorReply(request, error.code, error.message, error.hint))

    def _answer_saves(self) -> None:
        waiting, self._saves = self._saves, []
        for ask, message, unsaved in waiting:
            left = [(chunk, version) for chunk, version in unsaved if chunk.durable < version]
            if left:
                self._saves.append((ask, message, left))
                continue
            mine = [one.durable for one in self.mappers.by_number.values() if one.session == ask.session]
            files = len(self.live.files.rows)
            self._answer(ask.ticket, messages.LiveDurable(message.request, max(mine, default=0), files))

    # --- turns ----------------------------------------------------------------------------------

    def turn(self, now_s: float, *, save_all: bool) -> None:
        """Do what can be done now."""
        self._take_scans()
        self.readers.lists.expire(now_s)
        residency = self.live.residency
        marks_bytes = sum(min(message.bytes, MOST_MARKS_BYTES) for _, message in self._waiting)
        residency.beside_bytes += marks_bytes - self._marks_bytes
        self._marks_bytes = marks_bytes
        residency.asked_bytes = self.readers.lists.asked_bytes
        self.live.turn(now_s, time.time_ns(), save_all=save_all or bool(self._saves))
        if self._saves:
            self._answer_saves()
        self.readers.turn(now_s)
        if now_s >= self._manifest_s and self.changes.number != self._listed:
            self._manifest_s, self._listed = now_s + MANIFEST_S, self.changes.number
            self.live.list_files(self._durable_scans())

    def next_turn_s(self, now_s: float) -> float:
        """When the next turn is due, if nothing happens before."""
        residency = self.live.residency
        first_fits = bool(self._waiting) and residency.has_room(self._waiting[0][1].bytes)
        if first_fits or residency.is_ready:
            return now_s
        return min(residency.next_event_s(now_s), self.readers.next_turn_s(now_s))

    def status(self) -> messages.LiveMapRow:
        """How the map is."""
        live, residency, now_s = self.live, self.live.residency, time.monotonic()
        self.readers.measure(now_s)
        if now_s >= self._files_s:
            self._files_s = now_s + FILES_S
            self._file_bytes = sum(row.bytes for row in list(live.files.rows.values()))  # other threads save
        missing = (f"{key.text}: version {row.version} is missing" for key, row in live.files.missing.items())
        quarantined = list(live.files.damaged.items())
        damaged = (f"{name}: {why}" for name, why in quarantined)
        return messages.LiveMapRow(
            self.settings.name, self.settings.path, live.files.settings.resolution,
            live.files.settings.frame_id, chunks=len(live.chunks), active=residency.active,
            bytes=residency.chunk_bytes, loading=len(residency.chunks) - len(live.chunks),
            dirty=residency.dirty, saving=residency.saving,
            waiting_bytes=residency.waiting_bytes, files=len(live.files.rows), file_bytes=self._file_bytes,
            scans=self._scans, durable=self._durable, budget_bytes=live.limits.budget_bytes,
            damaged=tuple(islice(chain(missing, damaged), 64)),
            mappers=tuple(f"{one.mapper.uid}/{one.mapper.name}" for one in self.mappers.by_number.values()),
            problem=live.problem, change=self.changes.number, beside_bytes=residency.beside_bytes,
            readers=self.readers.busiest, damaged_count=len(live.files.missing) + len(quarantined),
            mapper_count=len(self.mappers.by_number),
        )  # fmt: skip

    # --- the end --------------------------------------------------------------------------------

    @property
    def is_saved(self) -> bool:
        """Whether nothing is in memory alone."""
        return self.live.all_durable

    def stop_taking(self) -> None:
        """Take in nothing more: what waits is sent again to the next life."""
        self._waiting.clear()

    def end(self, *, keep: bool) -> int:
        """End it; returns how many chunks stay in memory because they are nowhere else."""
        self.readers.close()
        self.readers.lists.remove_all()
        unsaved = sum(chunk.version > chunk.saved for chunk in self.live.residency.chunks.values())
        if not keep and not unsaved:
            self.live.finish(self._durable_scans())
            self.live.remove_from_memory()
        self.live.close()
        return unsaved


def _require_mapper(ask: Ask) -> None:
    if not ask.maps:
        raise NotPermitted(
            "this user may not change live maps",
            hint="root, the daemon's own user and members of its `live_group` may",
        )
