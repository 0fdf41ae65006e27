# SPDX-License-Identifier: Apache-2.0
"""One live map at work: scans are applied, chunks loaded, saved and given up, as `Residency` says.

Everything that changes a chunk happens in the thread that calls `LiveMap.turn`; files are read, written and
flushed in others.  After the death of this process the next one finds the chunks in shared memory: what was
*applied* is there, what a scan had half done is undone, and the mapper sends it again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeVar

from shmmap.chunks.applying import ChunkWriter, UndoRecord
from shmmap.chunks.chunk_file import decode_chunk, encode_chunk
from shmmap.chunks.layout import (
    ChunkIdentity,
    ChunkView,
    chunk_bytes,
    new_header,
)
from shmmap.chunks.marks import Marks
from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.chunk_memory import ChunkFile, ChunkMemory, memory_bytes
from shmmap.daemon.live.file_threads import CLOSE_S, FileThreads, Job
from shmmap.daemon.live.map_files import MapFiles
from shmmap.daemon.live.paging.key_index import KeyIndex
from shmmap.daemon.live.paging.records import Chunk, Limits, Scan
from shmmap.daemon.live.paging.residency import RETRY_S, Residency
from shmmap.errors import MapDataError, PackageMissing
from shmmap.logfmt import log

__all__ = ["LiveMap"]

T = TypeVar("T")

CHUNKS_A_TURN: Final = 64
"""Chunks that take in a scan in one turn: 37 us each."""
LOOK_S: Final = 2.0
"""How often the directory is looked at: it may have been moved, or another one put in its place."""
HANGS_S: Final = 10.0
"""After so long without an answer of the disk it hangs, as far as anybody can say."""
MOST_UNFLUSHED: Final = 32 << 20
"""Files that are written and not flushed: beyond it the disk is waited for, and what is not saved stays."""


@dataclass(eq=False, slots=True)
class _Part:
    """What a scan says of its chunks, by key."""

    marks: Marks
    places: dict[ChunkKey, tuple[int, int, int]]  # first word, end, hits


@dataclass(eq=False)
class LiveMap:
    """A map, its memory and its files.

    Parameters
    ----------
    files, memory
        Where it is on disk and in shared memory.
    undo
        Memory that outlives this process.
    limits
        What it may take.
    codec
        How chunks are compressed on disk.
    on_applied, on_durable
        Called with scans that are in memory, and on the disk.
    on_changed, on_gone
        Called with chunks that came into memory or were changed there, and that left it.
    on_work_done
        Called, in another thread, when there is something to do in the next turn.

    Attributes
    ----------
    stored : KeyIndex
        Chunks that have files, in order; one whose file was put aside is in it until it is loaded.
    problems : dict
        What keeps chunks from being loaded or saved just now.
    saved_s : float
        When a file was written or flushed last.
    """

    files: MapFiles
    memory: ChunkMemory
    undo: UndoRecord
    limits: Limits
    codec: str = "zlib"
    on_applied: Callable[[Scan], None] = lambda _scan: None
    on_durable: Callable[[Scan], None] = lambda _scan: None
    on_changed: Callable[[ChunkKey], None] = lambda _key: None
    on_gone: Callable[[ChunkKey], None] = lambda _key: None
    on_work_done: Callable[[], None] = lambda: None
    residency: Residency = field(init=False)
    chunks: dict[ChunkKey, ChunkFile] = field(default_factory=dict)
    stored: KeyIndex = field(init=False)
    problems: dict[str, str] = field(default_factory=dict)
    saved_s: float = -math.inf
    _parts: dict[Scan, _Part] = field(default_factory=dict)
    _generation: int = 0
    _look_s: float = 0.0
    _end_s: float | None = None

    def __post_init__(self) -> None:
        self.residency = Residency(self.limits, new_bytes=memory_bytes(0))
        self._writer = ChunkWriter(self.files.settings.occupancy, self.undo)
        self._threads = FileThreads(lambda: self.on_work_done())
        self._generation = self.files.begin_life() << 32
        self.stored = KeyIndex(self.files.rows)
        for key, row in self.files.rows.items():
            self.residency.note_size(key, memory_bytes(row.bricks))

    def take_over(self, chunk: ChunkFile, now_s: float) -> None:
        """A chunk is in memory since an earlier life of the writer, and whole."""
        key, state = chunk.view.identity.key, chunk.view.state
        self.chunks[key] = chunk
        saved = state["saved_version"] = self.files.version(key)  # it may have died before it noted that
        self.residency.adopt(
            key, version=int(state["version"]), saved=saved, nbytes=chunk.nbytes,
            active=int(state["active"]), now_s=now_s,
        )  # fmt: skip
        self.on_changed(key)

    def identity(self, key: ChunkKey, generation: int) -> ChunkIdentity:
        """What a chunk of this map says of itself."""
        return self.files.settings.identity(self.files.map_id, key, generation)

    # --- what comes -----------------------------------------------------------------------------

    def add(self, mapper: int, number: int, marks: Marks, nbytes: int) -> Scan:
        """Take a scan in; it is applied in this and the next turns."""
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
            self._tell_applied(scan)
        return scan

    def move(self, client: object, xyz: tuple[float, float, float]) -> None:
        """A client is somewhere; metres."""
        side = 64 * self.files.settings.resolution
        self.residency.move(client, (xyz[0] / side, xyz[1] / side, xyz[2] / side))

    # --- a turn ---------------------------------------------------------------------------------

    @property
    def all_durable(self) -> bool:
        """Whether everything that came is on the disk."""
        return not self._parts and self.residency.all_durable

    def turn(self, now_s: float, now_ns: int, *, save_all: bool = False) -> None:
        """Do what can be done now, without waiting for the disk."""
        self._threads.tell(now_s)
        self._look_after_directory(now_s, save_all=save_all)
        residency = self.residency
        for chunk, scan in residency.ready()[:CHUNKS_A_TURN]:
            self._apply(chunk, scan, now_s, now_ns)
        while (gone := residency.next_eviction(now_s)) is not None:  # there is room for others now
            self.memory.give_up(self.chunks.pop(gone.key))
            self.on_gone(gone.key)
        jobs = []
        while (cold := residency.next_load(now_s)) is not None:
            self._generation += 1
            identity = self.identity(cold.key, self._generation)
            jobs.append(Job(partial(self._load, identity), partial(self._loaded, cold)))
        self._threads.start(jobs)
        jobs = []
        while (
            self.files.unflushed_bytes < MOST_UNFLUSHED
            and (dirty := residency.next_save(now_s, everything=save_all)) is not None
        ):
            view = self.chunks[dirty.key].view
            copy = ChunkView(bytes(view.data[: chunk_bytes(int(view.state["bricks"]))]))
            saved = partial(self._saved, dirty, dirty.version)
            jobs.append(Job(partial(self._save, dirty.key, copy), saved))
        self._threads.start(jobs)
        if residency.flush_is_due(now_s, everything=save_all):
            residency.durability.begin()
            self._threads.start([Job(self.files.flush, self._flushed)])

    def _look_after_directory(self, now_s: float, *, save_all: bool) -> None:
        hangs = self._threads.idle_s(now_s) > HANGS_S
        self._note("hangs", "its directory does not answer: its disk is stopped or away" if hangs else "")
        if now_s >= self._look_s and not save_all:
            self._look_s = math.inf  # until it was looked at
            self._threads.start([Job(self.files.files.moved, self._looked)])

    def _looked(self, future: Future[str], now_s: float) -> None:
        self._look_s = now_s + LOOK_S
        moved = future.result()
        text = f"its directory: {moved}; what is saved goes to where it was opened" if moved else ""
        self._note("moved", text)

    def _note(self, what: str, problem: str) -> None:
        """Something is wrong, or right again; said once in the log."""
        if problem and what not in self.problems:
            log.error("live map has a problem", reason=problem)
        if problem:
            self.problems[what] = problem
        elif self.problems.pop(what, ""):
            log.info("live map is in order again", what=what)

    def on_disk(self, work: Callable[[], T], then: Callable[[Future[T], float], None]) -> None:
        """Have a file thread do something; ``then`` gets what came of it in a later turn."""
        self._threads.start([Job(work, then)])

    def wait(self, seconds: float) -> None:
        """Wait until a file was read or written, at most so long; not at all if there is none."""
        self._threads.wait(seconds)

    # --- applying -------------------------------------------------------------------------------

    def _apply(self, chunk: Chunk, scan: Scan, now_s: float, now_ns: int) -> None:
        part, file = self._parts[scan], self.chunks[chunk.key]
        begin, end, hits = part.places[chunk.key]
        words, bits = part.marks.words[begin:end], part.marks.bits[begin:end]
        bricks = int(file.view.state["bricks"]) + self._writer.new_bricks(file.view, words)
        more = memory_bytes(bricks) - chunk.nbytes
        if more > 0 and not self.residency.may_grow(chunk, more):
            return
        try:
            self._writer.apply(
                file.view, words, bits, hits, mapper=scan.mapper, scan=scan.number, now_ns=now_ns,
                grow=file.grow, known_mappers={mapper.number for mapper in self.files.mappers},
            )  # fmt: skip
        except OSError as error:  # no memory: as if the budget did not allow it
            log.warning("chunk cannot grow", chunk=chunk.key.text, reason=error.strerror)
            self.residency.may_grow(chunk, self.limits.budget_bytes)
            return
        state = file.view.state
        self.residency.applied(
            chunk, scan, version=int(state["version"]), nbytes=file.nbytes, active=int(state["active"]),
            now_s=now_s,
        )  # fmt: skip
        self.on_changed(chunk.key)
        if scan.applied:
            self._tell_applied(scan)

    def _tell_applied(self, scan: Scan) -> None:
        del self._parts[scan]
        self.on_applied(scan)
        if scan.durable:
            self.on_durable(scan)

    # --- files ----------------------------------------------------------------------------------

    def _load(self, identity: ChunkIdentity) -> ChunkFile:
        """Bring a chunk into memory as its file is, or new; a file that is of no use is put aside."""
        key = identity.key
        content: bytes | bytearray = new_header(identity)
        try:
            data = self.files.load(key)
            if data is not None:
                content = decode_chunk(data, identity, key.text)
        except MapDataError as error:
            self.files.put_aside(key, error.message)
        return self.memory.create(content)

    def _loaded(self, chunk: Chunk, future: Future[ChunkFile], now_s: float) -> None:
        try:
            file = future.result()
        except (OSError, MemoryError, PackageMissing) as error:
            self._failed("loaded", chunk.key.text, str(error))
            self.residency.load_failed(chunk, now_s)
            return
        self._succeeded("loaded")
        if chunk.key not in self.files.rows:
            self.stored.discard(chunk.key)
        self.chunks[chunk.key] = file
        state = file.view.state
        self.residency.loaded(
            chunk, version=int(state["version"]), nbytes=file.nbytes, active=int(state["active"])
        )
        self.on_changed(chunk.key)

    def _save(self, key: ChunkKey, view: ChunkView) -> None:
        self.files.save(key, encode_chunk(view, self.codec))

    def _saved(self, chunk: Chunk, version: int, future: Future[None], now_s: float) -> None:
        try:
            future.result()
        except (OSError, MemoryError) as error:
            self._failed("saved", chunk.key.text, _reason(error))
            self.residency.save_failed(chunk, now_s)
            return
        self._succeeded("saved")
        self.saved_s = now_s
        self.stored.add(chunk.key)
        self.residency.saved(chunk, version, now_s)
        self.chunks[chunk.key].view.state["saved_version"] = version

    @property
    def problem(self) -> str:
        """What keeps chunks from being loaded or saved just now; empty: nothing."""
        return "; ".join(self.problems.values())

    def _failed(self, what: str, key: str, reason: str | None) -> None:
        if what not in self.problems:  # told once: it is tried again each second
            log.warning(f"chunk not {what}", chunk=key or None, reason=reason)
        self.problems[what] = f"chunk {key} cannot be {what}: {reason}" if key else f"not {what}: {reason}"

    def _succeeded(self, what: str) -> None:
        if self.problems.pop(what, ""):
            log.info(f"chunks are {what} again")

    def finish(self, applied: dict[int, int] | None) -> None:
        """Have the manifest written, and what is only there to be written over removed, before the end."""
        self._threads.start([Job(partial(self._finish, applied), self._listed)])
        while not self._threads.are_idle and (left_s := self._left_s()) > 0:
            self._threads.wait(left_s)
            self._threads.tell(time.monotonic())

    def _left_s(self) -> float:
        """How long files may still take at the end, counted from the first time that this is asked."""
        if self._end_s is None:
            self._end_s = time.monotonic() + (0.0 if "hangs" in self.problems else CLOSE_S)
        return max(0.0, self._end_s - time.monotonic())

    def _finish(self, applied: dict[int, int] | None) -> None:
        self.files.write_manifest(applied)
        self.files.remove_spare()

    def list_files(self, applied: dict[int, int] | None) -> None:
        """Have the manifest written, beside the rest; ``applied`` as there."""
        self._threads.start([Job(partial(self.files.write_manifest, applied), self._listed)])

    def _listed(self, future: Future[None], now_s: float) -> None:
        del now_s
        if error := future.exception():
            log.warning("manifest not written", reason=str(error))

    def _flushed(self, future: Future[None], now_s: float) -> None:
        try:
            future.result()
        except (OSError, MemoryError) as error:
            self._failed("flushed", "", _reason(error))
            self.residency.durability.failed(now_s + RETRY_S)
            return
        self._succeeded("flushed")
        self.saved_s = now_s
        for scan in self.residency.durability.flushed():
            self.on_durable(scan)

    def remove_from_memory(self) -> None:
        """Give all chunks up."""
        for file in self.chunks.values():
            self.memory.give_up(file)
        self.chunks.clear()

    def close(self) -> None:
        """Leave memory and files as they are."""
        for done in self._threads.close(self._left_s()):
            if isinstance(done, ChunkFile):
                done.close()  # it has come, and there was no turn since
        for file in self.chunks.values():
            file.close()
        self.chunks.clear()


def _reason(error: OSError | MemoryError) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else "this process has no memory left"
