# SPDX-License-Identifier: Apache-2.0
"""One live map: apply scans, and load, save and evict chunks as `Residency` decides.

Only the thread that calls `PagedMap.run_turn` changes chunks; other threads read, write and flush files.  If
this process dies, the next one finds the chunks in shared memory.  Scans that were *applied* are there, a
partial change by a scan is undone, and the mapper sends that scan again.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from functools import partial
from typing import Any, Final, NamedTuple, Protocol, TypeVar

from shmmap.chunks.applying import UNDO_BYTES, ChunkWriter, UndoRecord
from shmmap.chunks.chunk_file import encode_chunk
from shmmap.chunks.layout import (
    OUT_OF_SERVICE,
    ChunkIdentity,
    ChunkView,
    check_consistent,
    chunk_bytes,
    new_header,
)
from shmmap.chunks.marks import Marks
from shmmap.chunks.voxels import CHUNK_SIDE, ChunkKey
from shmmap.errors import CannotStart, PackageMissing, SegmentCorrupt
from shmmap.live_worker.changes import Changes
from shmmap.live_worker.chunk_memory import ChunkFile, ChunkMemory, memory_bytes
from shmmap.live_worker.disk.map_database import MapDatabase
from shmmap.live_worker.paging.durability import Chunk, Scan
from shmmap.live_worker.paging.key_index import KeyIndex
from shmmap.live_worker.paging.residency import RETRY_S, Limits, Residency
from shmmap.logfmt import log

T = TypeVar("T")

THREADS: Final = 4
"""File threads of a map, one of which flushes.  More threads would only wait for the interpreter lock."""
CLOSE_S: Final = 5.0
"""Time for file operations in progress at the end; after that, a directory that hangs is abandoned."""
FILES_PER_JOB: Final = 8
"""Files that a thread reads or writes per report: a report costs as much time as a file."""
CHUNKS_PER_TURN: Final = 64
"""Chunks to which scans are applied in one turn, 37 us each."""
LOOK_S: Final = 2.0
"""Interval of checks whether the directory, or a file of the database, was moved or replaced."""
HANGS_S: Final = 10.0
"""Time without an answer after which a disk counts as hanging."""


class Job(NamedTuple):
    """Work for a thread, and the function that gets its outcome in a later turn."""

    work: Callable[[], Any]
    then: Callable[[Future[Any], float], None]


class FileThreads:
    """Threads that read, write and flush files of one map.

    Parameters
    ----------
    on_done
        Called, in a thread, when there are outcomes to deliver.
    """

    def __init__(self, on_done: Callable[[], None], threads: int = THREADS) -> None:
        self._threads = ThreadPoolExecutor(threads, "live-files")
        self._running: dict[Future[list[Future[Any]]], list[Job]] = {}
        self._progress_s = 0.0
        self._on_done = on_done

    @property
    def are_idle(self) -> bool:
        """Whether all jobs are done and their outcomes delivered."""
        return not self._running

    def idle_s(self, now_s: float) -> float:
        """Return how long ago a job last finished, seconds; 0 if there are no jobs."""
        return now_s - self._progress_s if self._running else 0.0

    def start(self, jobs: list[Job]) -> None:
        """Start jobs, several per thread."""
        for first in range(0, len(jobs), FILES_PER_JOB):
            some = jobs[first : first + FILES_PER_JOB]
            future = self._threads.submit(_outcomes, [job.work for job in some])
            self._running[future] = some
            future.add_done_callback(lambda _future: self._on_done())

    def deliver(self, now_s: float) -> None:
        """Deliver the outcomes of finished jobs."""
        done = [future for future in self._running if future.done()]
        if done or not self._running:
            self._progress_s = now_s
        for future in done:
            for job, outcome in zip(self._running.pop(future), future.result(), strict=True):
                job.then(outcome, now_s)

    def wait(self, seconds: float) -> None:
        """Wait at most ``seconds`` until there are outcomes; return at once if no job runs."""
        wait(list(self._running), timeout=seconds, return_when=FIRST_COMPLETED)

    def close(self, seconds: float = CLOSE_S) -> list[Any]:
        """Wait at most ``seconds`` for all jobs; return undelivered results without errors."""
        done, _ = wait(list(self._running), timeout=seconds)
        self._threads.shutdown(wait=False, cancel_futures=True)
        outcomes = [outcome for future in done for outcome in future.result()]
        self._running.clear()
        return [outcome.result() for outcome in outcomes if outcome.exception() is None]


def _outcomes(works: list[Callable[[], Any]]) -> list[Future[Any]]:
    """Call functions one after the other; return the outcome of each."""
    found: list[Future[Any]] = []
    for work in works:
        outcome: Future[Any] = Future()
        try:
            outcome.set_result(work())
        except Exception as error:  # noqa: BLE001  raised again when the outcome is read
            outcome.set_exception(error)
        found.append(outcome)
    return found


class Observer(Protocol):
    """Receives the progress of a live map's scans, in the thread of its turns."""

    def scan_applied(self, scan: Scan) -> None:
        """Handle that a scan is in memory that outlives this process."""

    def scan_durable(self, scan: Scan) -> None:
        """Note that a scan is on the disk."""


class _Part(NamedTuple):
    """A scan's marks in each chunk, by key: first word, end, hits."""

    marks: Marks
    places: dict[ChunkKey, tuple[int, int, int]]


class PagedMap:
    """A map, its memory and its database.

    Parameters
    ----------
    database, memory
        The map on disk and in shared memory.
    limits
        Limits of the map's memory and files.
    observer
        Receives the progress of scans.
    wake
        Called in another thread when there is work for the next turn.
    codec
        How chunks are compressed on disk.

    Attributes
    ----------
    changes : Changes
        Numbered changes of the chunks in memory.
    stored : KeyIndex
        Chunks that are saved, in order.
    problems : dict
        Problems that keep chunks from being loaded or saved at present.
    saved_s : float
        When a file was written or flushed last.
    record_retry_s : float
        Before then the record is not written again, because that has failed.
    """

    def __init__(
        self,
        database: MapDatabase,
        memory: ChunkMemory,
        limits: Limits,
        observer: Observer,
        wake: Callable[[], None] = lambda: None,
        codec: str = "zlib",
    ) -> None:
        self.database = database
        self.memory = memory
        self.limits = limits
        sizes = {key: memory_bytes(row.bricks) for key, row in database.rows.items()}
        self.residency = Residency(limits, new_bytes=memory_bytes(0), sizes=sizes)
        self.chunks: dict[ChunkKey, ChunkFile] = {}
        self.stored = KeyIndex(database.rows)
        self.problems: dict[str, str] = {}
        self.saved_s = self.record_retry_s = -math.inf
        self.changes = Changes(time.time_ns())
        self._observer = observer
        self._codec = codec
        self._undo = UndoRecord(memory.record("undo", UNDO_BYTES))
        self._writer = ChunkWriter(database.settings.occupancy, self._undo)
        self._threads = FileThreads(wake)
        self._parts: dict[Scan, _Part] = {}
        self._generation = database.record.runs << 32
        self._look_s = 0.0
        self._end_s: float | None = None

    @property
    def resolution(self) -> float:
        """Edge of a voxel, metres."""
        return self.database.settings.resolution

    def identity(self, key: ChunkKey, generation: int) -> ChunkIdentity:
        """Return the identity of a chunk of this map."""
        return self.database.settings.identity(self.database.map_id, key, generation)

    # --- chunks of a previous writer ------------------------------------------------------------

    def adopt(self, now_s: float) -> int:
        """Take over the chunks that a previous writer left in memory; return how many.

        The chunks may exist nowhere else.

        Raises
        ------
        CannotStart
            There are unsaved chunks of another map of that name.
        OSError
            A chunk cannot be opened; it stays in memory for the next try.
        """
        memory = self.memory
        newest: set[ChunkKey] = set()
        for name, key, _ in sorted(memory.names(), key=lambda one: -one[2]):
            chunk = self._left_behind(name)
            if chunk is None:
                memory.remove(name)
            elif key in newest or int(chunk.view.state["state"]) == OUT_OF_SERVICE:
                memory.give_up(chunk)  # it was saved and about to be evicted
            else:
                self._take_over(chunk, now_s)
            newest.add(key)
        if self._undo.of is not None:
            self._undo.drop()
        if memory.foreign:
            log.warning("foreign files ignored", count=len(memory.foreign), first=min(memory.foreign))
        return len(self.chunks)

    def _take_over(self, chunk: ChunkFile, now_s: float) -> None:
        """Add a chunk that a previous writer left, if it is whole and no older than its file."""
        identity, state = chunk.view.identity, chunk.view.state
        try:
            if self._undo.of == (identity.key, identity.generation):
                self._undo.restore(chunk.view)
            check_consistent(chunk.view, chunk.name)
            if int(state["version"]) < self.database.version(identity.key):
                raise SegmentCorrupt(f"{chunk.name}: older than its file")
        except SegmentCorrupt as error:
            log.warning("chunk not adopted", chunk=identity.key.text, reason=error.message)
            self.memory.give_up(chunk)
        else:
            self.add_chunk(chunk, now_s)

    def _left_behind(self, name: str) -> ChunkFile | None:
        """Open a chunk of this map; return None if it is invalid, raise OSError if it cannot be opened."""
        if self.memory.is_given_up(name):
            return None
        try:
            chunk = self.memory.open(name)
        except SegmentCorrupt as error:
            log.warning("chunk not adopted", file=name, reason=error.message)
            return None
        identity, state = chunk.view.identity, chunk.view.state
        if identity == self.identity(identity.key, identity.generation):
            return chunk
        unsaved = int(state["version"]) > int(state["saved_version"])
        with contextlib.closing(chunk):
            if unsaved and int(state["state"]) != OUT_OF_SERVICE:
                raise CannotStart(
                    f"{name} is a chunk of another map of this name, and has not been saved",
                    hint="start once with the directory of that map, or remove the file if it is of no use",
                )
        log.warning("chunk not adopted", file=name, reason="of another map, or of other settings")
        return None

    def add_chunk(self, chunk: ChunkFile, now_s: float) -> None:
        """Add a complete chunk that is in memory already."""
        key, state = chunk.view.identity.key, chunk.view.state
        self.chunks[key] = chunk
        self.database.note_whole(key, int(state["version"]))
        # its previous writer may have died before it recorded that
        saved = state["saved_version"] = self.database.version(key)
        version, active = int(state["version"]), int(state["active"])
        self.residency.adopt(
            key, version=version, saved=saved, nbytes=chunk.nbytes, active=active, now_s=now_s
        )
        self.changes.note_changed(key)

    # --- scans and clients ----------------------------------------------------------------------

    def add(self, mapper: int, number: int, marks: Marks, nbytes: int) -> Scan:
        """Add a scan; it is applied in this turn and the next ones."""
        starts = marks.starts.tolist()
        keys = marks.chunks
        places = {
            key: (starts[at], starts[at + 1], hits)
            for at, (key, hits) in enumerate(zip(keys, marks.hits.tolist(), strict=True))
        }
        scan = Scan(mapper, number, nbytes, set(keys))
        self._parts[scan] = _Part(marks, places)
        self.residency.add(scan)
        if scan.applied:
            self._note_applied(scan)
        return scan

    def move(self, client: object, xyz: tuple[float, float, float]) -> None:
        """Move a client to a position in metres."""
        side = CHUNK_SIDE * self.resolution
        self.residency.move(client, (xyz[0] / side, xyz[1] / side, xyz[2] / side))

    # --- a turn ---------------------------------------------------------------------------------

    @property
    def all_durable(self) -> bool:
        """Whether all accepted scans are on disk."""
        return not self._parts and self.residency.all_durable

    def not_durable(self) -> list[tuple[Chunk, int]]:
        """Return the chunks that are not durable yet, with their versions; see `Durability.missing`."""
        return self.residency.durability.missing(self.residency.chunks.values())

    @property
    def unsaved(self) -> int:
        """Number of chunks that are only in memory."""
        return sum(chunk.version > chunk.saved for chunk in self.residency.chunks.values())

    def run_turn(self, now_s: float, now_ns: int, *, save_all: bool = False) -> None:
        """Do what can be done now, without waiting for the disk."""
        self._threads.deliver(now_s)
        self._check_directory(now_s, save_all=save_all)
        while self.database.found_lost:
            self.note_lost(self.database.found_lost.popleft(), now_s)
        residency = self.residency
        for chunk, scan in residency.ready()[:CHUNKS_PER_TURN]:
            self._apply(chunk, scan, now_s, now_ns)
        while (gone := residency.evict_next(now_s)) is not None:  # now there is memory for others
            self.memory.give_up(self.chunks.pop(gone.key))
            self.changes.note_gone(gone.key)
        jobs = []
        while (cold := residency.begin_load(now_s)) is not None:
            self._generation += 1
            identity = self.identity(cold.key, self._generation)
            jobs.append(Job(partial(self._load, identity), partial(self._loaded, cold)))
        self._threads.start(jobs)
        jobs = []
        while (dirty := residency.begin_save(now_s, everything=save_all)) is not None:
            view = self.chunks[dirty.key].view
            copy = ChunkView(bytes(view.data[: chunk_bytes(int(view.state["bricks"]))]))
            saved = partial(self._saved, dirty, dirty.version)
            jobs.append(Job(partial(self._save, dirty.key, copy), saved))
        self._threads.start(jobs)
        if residency.flush_is_due(now_s, everything=save_all):
            residency.durability.begin()
            self.on_disk(self.database.flush, self._flushed)

    def _check_directory(self, now_s: float, *, save_all: bool) -> None:
        hangs = self._threads.idle_s(now_s) > HANGS_S
        self._note("hangs", "its directory does not answer: its disk is stopped or away" if hangs else "")
        if now_s >= self._look_s and not save_all:
            self._look_s = math.inf  # until this check has ended
            self.on_disk(self._look, self._checked)

    def _look(self) -> str:
        self.database.look_again()
        return self.database.moved()

    def _checked(self, future: Future[str], now_s: float) -> None:
        self._look_s = now_s + LOOK_S
        moved = future.result()
        self._note("moved", f"{moved}; what is saved goes to where it was opened" if moved else "")

    def _note(self, what: str, problem: str = "") -> None:
        """Record a problem or its end; logged once: work is retried each second."""
        if problem and what not in self.problems:
            log.error("live map has a problem", reason=problem)
        if problem:
            self.problems[what] = problem
        elif self.problems.pop(what, ""):
            log.info("live map is in order again", what=what)

    def on_disk(self, work: Callable[[], T], then: Callable[[Future[T], float], None]) -> None:
        """Call ``work`` in a file thread; ``then`` gets the outcome in a later turn."""
        self._threads.start([Job(work, then)])

    # --- applying -------------------------------------------------------------------------------

    def _apply(self, chunk: Chunk, scan: Scan, now_s: float, now_ns: int) -> None:
        part, file = self._parts[scan], self.chunks[chunk.key]
        begin, end, hits = part.places[chunk.key]
        words, bits = part.marks.words[begin:end], part.marks.bits[begin:end]
        bricks = int(file.view.state["bricks"]) + self._writer.new_bricks(file.view, words)
        more = memory_bytes(bricks) - chunk.nbytes
        if more > 0 and not self.residency.may_grow(chunk, more):
            return
        known = {mapper.number for mapper in self.database.record.mappers}
        try:
            self._writer.apply(
                file.view,
                words,
                bits,
                hits,
                mapper=scan.mapper,
                scan=scan.number,
                now_ns=now_ns,
                grow=file.grow,
                known_mappers=known,
            )
        except OSError as error:  # no memory: treated as if the budget did not allow it
            self._note("enlarged", f"chunk {chunk.key.text} cannot be enlarged: {_reason(error)}")
            self.residency.may_grow(chunk, self.limits.budget_bytes)
            return
        self._note("enlarged")
        version, active = int(file.view.state["version"]), int(file.view.state["active"])
        self.residency.applied(chunk, scan, version=version, nbytes=file.nbytes, active=active, now_s=now_s)
        self.changes.note_changed(chunk.key)
        if scan.applied:
            self._note_applied(scan)

    def _note_applied(self, scan: Scan) -> None:
        del self._parts[scan]
        self._observer.scan_applied(scan)
        if scan.durable:
            self._observer.scan_durable(scan)

    # --- files ----------------------------------------------------------------------------------

    def _load(self, identity: ChunkIdentity) -> ChunkFile:
        """Load a chunk from its file, or create it if there is no good one."""
        content = self.database.load(identity.key, identity.generation)
        if content is None:
            self.database.note_remade(identity.key)
            content = new_header(identity)
        return self.memory.create(content)

    def _loaded(self, chunk: Chunk, future: Future[ChunkFile], now_s: float) -> None:
        try:
            file = future.result()
        except (OSError, MemoryError, PackageMissing) as error:
            self._note("loaded", f"chunk {chunk.key.text} cannot be loaded: {error}")
            self.residency.load_failed(chunk, now_s)
            return
        self._note("loaded")
        if chunk.key not in self.database.rows:
            self.stored.discard(chunk.key)
        self.chunks[chunk.key] = file
        version, active = int(file.view.state["version"]), int(file.view.state["active"])
        self.residency.loaded(chunk, version=version, nbytes=file.nbytes, active=active)
        self.changes.note_changed(chunk.key)

    def note_lost(self, key: ChunkKey, now_s: float) -> None:
        """Note that a chunk has no good file any more; save it again if memory has all of it."""
        if key in self.database.rows:
            return  # saved meanwhile
        self.stored.discard(key)
        chunk = self.residency.chunks.get(key)
        if key in self.chunks and chunk is not None and chunk.saved:  # else it was made new meanwhile
            self.database.note_whole(key, chunk.version)
            self.residency.save_again(chunk, now_s)

    def _save(self, key: ChunkKey, view: ChunkView) -> None:
        self.database.save(key, encode_chunk(view, self._codec))

    def _saved(self, chunk: Chunk, version: int, future: Future[None], now_s: float) -> None:
        try:
            future.result()
        except (OSError, MemoryError) as error:
            self._note("saved", f"chunk {chunk.key.text} cannot be saved: {_reason(error)}")
            self.residency.save_failed(chunk, now_s)
            return
        self._note("saved")
        self.saved_s = now_s
        self.stored.add(chunk.key)
        self.residency.saved(chunk, version, now_s)
        self.chunks[chunk.key].view.state["saved_version"] = version

    @property
    def problem(self) -> str:
        """The problem that keeps chunks from being loaded or saved at present; empty if there is none."""
        problems = list(self.problems.values())
        if (unreadable := dict(self.database.unreadable)) and "loaded" not in self.problems:
            key, reason = next(iter(unreadable.items()))
            more = f", and {len(unreadable) - 1:,} more" if len(unreadable) > 1 else ""
            problems.append(f"chunk {key.text} cannot be read: {reason}{more}")
        return "; ".join(problems)

    def _flushed(self, future: Future[None], now_s: float) -> None:
        try:
            future.result()
        except (OSError, MemoryError) as error:
            self._note("flushed", f"not flushed: {_reason(error)}")
            self.residency.durability.failed(now_s + RETRY_S)
            return
        self._note("flushed")
        self.saved_s = now_s
        for scan in self.residency.durability.flushed():
            self._observer.scan_durable(scan)

    def write_record(self, applied: dict[int, int] | None) -> None:
        """Write the record in a file thread; ``applied`` as in `MapDatabase.write_record`."""
        self.on_disk(partial(self.database.write_record, applied), self._recorded)

    def _recorded(self, future: Future[None], now_s: float) -> None:
        error = future.exception()
        if error is not None:
            self.record_retry_s = now_s + RETRY_S
        reason = _reason(error) if isinstance(error, OSError | MemoryError) else error
        self._note("recorded", f"its record cannot be written: {reason}" if error is not None else "")

    # --- the end --------------------------------------------------------------------------------

    def finish(self, applied: dict[int, int] | None) -> None:
        """Write the record and bring the log into the database, at the end."""
        self.on_disk(partial(self._finish, applied), self._recorded)
        while not self._threads.are_idle and (left_s := self._left_s()) > 0:
            self._threads.wait(left_s)
            self._threads.deliver(time.monotonic())

    def _left_s(self) -> float:
        """Return the time left for files at the end, seconds, counted from the first call."""
        if self._end_s is None:
            self._end_s = time.monotonic() + (0.0 if "hangs" in self.problems else CLOSE_S)
        return max(0.0, self._end_s - time.monotonic())

    def _finish(self, applied: dict[int, int] | None) -> None:
        self.database.write_record(applied)
        self.database.bring_log_in()

    def remove_from_memory(self) -> None:
        """Evict all chunks."""
        for file in self.chunks.values():
            self.memory.give_up(file)
        self.chunks.clear()

    def close(self) -> None:
        """Close the map; memory and files stay as they are."""
        for done in self._threads.close(self._left_s()):
            if isinstance(done, ChunkFile):
                done.close()  # loaded after the last turn
        self.database.close(self._left_s())
        for file in self.chunks.values():
            file.close()
        self.chunks.clear()


def _reason(error: OSError | MemoryError) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else "this process has no memory left"
