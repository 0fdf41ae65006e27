# SPDX-License-Identifier: Apache-2.0
"""Requests of readers of a live map: lists of chunks, of changes, and of voxels in an area.

A request is processed in steps, each much shorter than the work for a scan.  Sessions alternate step by step,
in a small part of the time between two scans; separate threads read files.  So readers wait for each other
and for the disk, and mapping waits for none of them.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any, Final

from shmmap.chunks.reading import KINDS
from shmmap.chunks.voxels import ChunkKey
from shmmap.errors import BadRequest, CannotWrite, InternalError, ShmmapError
from shmmap.live_messages import Ask
from shmmap.live_worker.areas import check_area, key_range, touches
from shmmap.live_worker.disk.map_record import Row
from shmmap.live_worker.paged_map import FileThreads, Job, PagedMap
from shmmap.live_worker.paging.key_index import KeyIndex, merged_part
from shmmap.live_worker.voxel_lists import Later, Steps, VoxelLists, lacking_chunks, shown
from shmmap.logfmt import log
from shmmap.protocol import live as messages
from shmmap.protocol.areas import LiveArea
from shmmap.protocol.messages import ErrorReply

NOTHING: Final = Row(0, 0, 0, 0, 0, 0)
"""Row of a chunk without a file."""
BURST_S: Final = 0.001
"""Longest time of readers' steps between two turns of the worker while other work waits, seconds."""
KEYS_PER_STEP: Final = 64
FEW_CHANGES: Final = 1000
"""Most chunks that are sorted in one step."""
THREADS: Final = 2
"""Threads that read files for readers; mapping has its own threads."""
MEASURED_S: Final = 2.0
BUSIEST: Final = 3
"""How many of the sessions that use the most time are reported."""


@dataclass(eq=False, slots=True)
class _Work:
    """A request in progress; ``error`` or ``outcome`` is the result of its last work in a thread."""

    ask: Ask
    request: int
    steps: Steps
    outcome: Any = None
    error: BaseException | None = None
    is_over: bool = False


class Readers:
    """Answers the readers of one map.

    Parameters
    ----------
    paged
        The map.
    answer
        Sends a reply, given the request's ticket.
    wake
        Called in another thread when there is work for the next turn.

    Attributes
    ----------
    lists
        Lists of the map's voxels.
    busiest
        Sessions whose requests used most of the time, with their share of one processor, thousandths.
    """

    def __init__(
        self,
        paged: PagedMap,
        answer: Callable[[int, Any], None],
        wake: Callable[[], None],
    ) -> None:
        self.paged, self.changes, self._answer = paged, paged.changes, answer
        self.lists = VoxelLists(paged)
        self._ready: dict[int, deque[_Work]] = {}  # by session, the next one first
        self._later: list[tuple[float, _Work]] = []
        self._in_thread: dict[int, deque[tuple[_Work, Callable[[], Any]]]] = {}  # by session, one at a time
        self._threads = FileThreads(wake, THREADS)
        self._spent_s: dict[int, float] = {}  # by session, since the measurement began
        self._measured_s = time.monotonic()
        self.busiest: tuple[tuple[int, int], ...] = ()

    def next_turn_s(self, now_s: float) -> float:
        """Return the time at which the next turn is due; infinity for never."""
        if self._ready:
            return now_s
        return min([self.lists.next_expiry_s, *(due_s for due_s, _ in self._later)])

    def on_disconnect(self, session: int) -> None:
        """Drop the requests and lists of a session that has ended."""
        works = [*self._ready.pop(session, ()), *(work for work, _ in self._in_thread.get(session, ()))]
        works += [work for _, work in self._later if work.ask.session == session]
        self._later = [row for row in self._later if row[1].ask.session != session]
        for work in works:
            work.is_over = True
            work.steps.close()
        self.lists.on_disconnect(session)

    def close(self) -> None:
        """Stop answering: the end does not wait for files requested by readers."""
        self.lists.is_closed = True
        self._threads.close(0.0)

    def begin(self, ask: Ask, message: messages.LiveChunks | messages.LiveVoxels) -> None:
        """Begin a request, which is answered in later turns; raise `BadRequest` if it is invalid."""
        if message.area is not None:
            check_area(message.area)
        if isinstance(message, messages.LiveChunks):
            steps = self._page(message)
        elif message.scope not in ("memory", "disk", "all"):
            raise BadRequest(f"scope {message.scope!r}", hint="ask for memory, disk or all")
        elif message.kind not in KINDS:
            raise BadRequest(f"voxels are not {message.kind!r}", hint=f"ask for one of {', '.join(KINDS)}")
        else:
            steps = self._voxels(ask, message)
        self._put(_Work(ask, message.request, steps))

    # --- turns ----------------------------------------------------------------------------------

    def run_turn(self, now_s: float) -> None:
        """Process requests for a short time."""
        self._threads.deliver(now_s)
        due = [work for due_s, work in self._later if due_s <= now_s]
        self._later = [row for row in self._later if row[0] > now_s]
        for work in due:
            self._put(work)
        begun_s = before_s = time.perf_counter()
        while self._ready:
            session = next(iter(self._ready))
            works = self._ready.pop(session)
            work = works.popleft()
            if self._step(work, now_s):
                works.append(work)
            if works:  # after all others
                self._ready[session] = works
            after_s = time.perf_counter()
            self._spent_s[session] = self._spent_s.get(session, 0.0) + after_s - before_s
            if after_s >= begun_s + BURST_S:
                break
            before_s = after_s

    def measure(self, now_s: float) -> None:
        """Update the list of the busiest sessions at intervals."""
        passed_s = now_s - self._measured_s
        if passed_s >= MEASURED_S:
            busiest = sorted(self._spent_s.items(), key=lambda item: -item[1])[:BUSIEST]
            self.busiest = tuple((session, round(1000 * took_s / passed_s)) for session, took_s in busiest)
            self._measured_s = now_s
            self._spent_s.clear()

    def _put(self, work: _Work) -> None:
        self._ready.setdefault(work.ask.session, deque()).append(work)

    def _step(self, work: _Work, now_s: float) -> bool:
        """Do a step of a request; return whether the next one may follow."""
        outcome, error = work.outcome, work.error
        work.outcome = work.error = None
        try:
            step = work.steps.send(outcome) if error is None else work.steps.throw(error)
        except StopIteration as done:
            self._answer(work.ask.ticket, done.value)
        except ShmmapError as failed:
            self._refuse(work, failed)
        except OSError as failed:
            self._refuse(work, CannotWrite(f"the list of voxels: {failed.strerror}"))
        except Exception:  # noqa: BLE001  a defect in one request must not end the map for all
            log.exception("request of a reader failed")
            self._refuse(work, InternalError("the daemon failed on this request"))
        else:
            if step is None:
                return True
            if isinstance(step, Later):
                self._later.append((now_s + step.seconds, work))
            else:
                self._read(work, step)
        return False

    def _refuse(self, work: _Work, error: ShmmapError) -> None:
        reply = ErrorReply(work.request, error.code, error.message, error.hint)
        self._answer(work.ask.ticket, reply)

    def _read(self, work: _Work, what: Callable[[], Any]) -> None:
        """Call a function for a request in a thread, after earlier work of the same session."""
        waiting = self._in_thread.setdefault(work.ask.session, deque())
        waiting.append((work, what))
        if len(waiting) == 1:
            self._threads.start([Job(what, partial(self._done, work.ask.session))])

    def _done(self, session: int, future: Future[Any], now_s: float) -> None:
        del now_s
        waiting = self._in_thread[session]
        work, _ = waiting.popleft()
        if not work.is_over:
            work.error = future.exception()
            work.outcome = None if work.error is not None else future.result()
            self._put(work)
        while waiting and waiting[0][0].is_over:
            waiting.popleft()
        if waiting:
            self._threads.start([Job(waiting[0][1], partial(self._done, session))])
        else:
            del self._in_thread[session]

    # --- requests -------------------------------------------------------------------------------

    def _keys(
        self, area: LiveArea | None, indexes: list[KeyIndex], since: int, after: ChunkKey | None
    ) -> Iterator[list[ChunkKey]]:
        """Yield chunks that touch an area, in order, one list per step; chunks in memory only if changed."""
        resolution = self.paged.resolution
        few = (
            self.changes.newer(since, FEW_CHANGES)
            if since and indexes == [self.paged.residency.index]
            else None
        )
        if few is not None:
            sorted_few = iter(sorted(key for key in few if after is None or key > after))
            while some := list(islice(sorted_few, KEYS_PER_STEP)):
                yield [key for key in some if touches(area, key, resolution)]
            return
        within, last = key_range(area, resolution), after
        while True:
            keys, last = merged_part(indexes, last, within, KEYS_PER_STEP)
            yield [
                key
                for key in keys
                if (not since or key not in self.paged.chunks or self.changes.is_newer(key, since))
                and touches(area, key, resolution)
            ]
            if last is None:
                return

    def _page(self, message: messages.LiveChunks) -> Steps:
        """List chunks."""
        paged, area, change = self.paged, message.area, self.changes.number
        known = not message.since or self.changes.known(message.since)
        since = message.since if known else 0
        gone = []
        if since and message.after is None:
            for number, key in enumerate(self.changes.gone(since), 1):
                if touches(area, key, paged.resolution):
                    gone.append(key)
                if number % KEYS_PER_STEP == 0:
                    yield None
        indexes = [paged.residency.index, *([paged.stored] if message.saved else [])]
        after = ChunkKey(*message.after) if message.after is not None else None
        rows: list[messages.LiveChunkRow] = []
        for keys in self._keys(area, indexes, since, after):
            for key in keys:
                row = self._row(key)
                if row is not None and (not since or row.generation or message.saved):
                    rows.append(row)
            if len(rows) > messages.MAX_CHUNK_ROWS:
                break
            yield None
        page = tuple(rows[: messages.MAX_CHUNK_ROWS])
        lacking = {}
        if message.after is None:
            lacking = yield from lacking_chunks(paged, area)
        return messages.LiveChunkPage(
            message.request, change, page, len(rows) > len(page), tuple(gone), known, *shown(lacking)
        )

    def _row(self, key: ChunkKey) -> messages.LiveChunkRow | None:
        there, known = self.paged.chunks.get(key), self.paged.residency.chunks.get(key)
        if there is None or known is None:
            row = self.paged.database.rows.get(key)
            if known is None and row is None:
                return None
            row = row or NOTHING
            state_now, nbytes = ("saved", row.bytes) if known is None else (known.state.value, known.nbytes)
            return messages.LiveChunkRow(
                key, 0, row.version, state_now, row.active, row.occupied, row.free, nbytes
            )
        state = there.view.state
        version, active, occupied, free = (
            int(state[name]) for name in ("version", "active", "occupied", "free")
        )
        return messages.LiveChunkRow(
            key, there.generation, version, known.state.value, active, occupied, free, known.nbytes
        )

    def _voxels(self, ask: Ask, message: messages.LiveVoxels) -> Steps:
        """List voxels."""
        change = self.changes.number
        since = message.since if self.changes.known(message.since) else 0
        indexes = []
        if message.scope != "disk":
            indexes.append(self.paged.residency.index)
        if message.scope != "memory" and not since:
            indexes.append(self.paged.stored)
        keys = self._keys(message.area, indexes, since, None) if indexes else iter(())
        reply = yield from self.lists.collect(message, keys, ask.session, change)
        return reply
