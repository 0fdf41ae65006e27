# SPDX-License-Identifier: Apache-2.0
"""Decide which chunks of a live map to load, change, save and evict, and in which order.

Pure decisions: clock and sizes are injected.  The owner of the memory asks to begin a step (`begin_load`,
`ready`, `begin_save`, `evict_next`), carries it out, and reports that.

- A chunk is loaded because a scan waits for it, or because it is near a client.  It stays until its memory is
  needed.  For a chunk near a client, only chunks near no client are evicted; for a scan, any chunk, the
  furthest first, and one that a scan waits for only if no save makes memory free.
- A scan is never dropped: it waits for chunks that are not in memory, and scans are applied in order of
  arrival.  The memory of waiting scans is bounded; beyond that no scan is accepted (`has_room`).
- A changed chunk is saved before it is evicted (once memory is half full, in advance), and is durable after
  `Limits.checkpoint_s`.  A chunk that changes while it is saved is dirty again.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice, takewhile
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from shmmap.chunks.voxels import ChunkKey
from shmmap.live_worker.paging.durability import TOGETHER_S, Chunk, Durability, Scan, State
from shmmap.live_worker.paging.key_index import KeyIndex
from shmmap.live_worker.paging.windows import Windows

RETRY_S: Final = 1.0
"""Delay before an unreadable or unwritable file, or a chunk evicted for a scan, is tried again."""
REVIEW_S: Final = 0.1
"""Shortest time between two reviews of all chunks for eviction; 30 000 chunks take 30 ms."""
FRUITLESS_S: Final = 1.0
"""Shortest time after a review that found nothing, while no client moves."""
CHUNKS_PER_CHANGE: Final = 32
"""All chunks are also reviewed when one in this many was loaded or changed since."""
SAVE_CANDIDATES: Final = 32
"""How many of the chunks changed longest ago are searched for an unwanted one."""
FOUND_PER_REVIEW: Final = 64, 16
"""How many chunks one review selects: at least the first number, or one in the second."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one map's memory and files.

    Attributes
    ----------
    budget_bytes
        Memory of all chunks, and of the lists of voxels and marks of scans beside them.
    reserve_bytes
        Memory reserved for chunks, so that the map can always be written.
    max_chunks
        Chunks in memory; 0 for no limit.  Each uses a descriptor and a mapping.
    most_active
        Known voxels of all chunks in memory; 0 for no limit.
    waiting_bytes
        Marks of scans that wait for chunks.
    radius
        Chunks kept around a client's chunk along each axis; 1 keeps its 26 neighbours.
    hysteresis
        How far a client has to enter another chunk until its window follows, as a fraction of a chunk.
    linger_s
        How long a chunk outside all windows counts as near after a scan changed it.
    checkpoint_s
        How long a change may be only in memory.
    loads, saves
        Most files being read, and being written, or waiting for a thread.
    """

    budget_bytes: int
    reserve_bytes: int = 0
    max_chunks: int = 0
    most_active: int = 0
    waiting_bytes: int = 64 << 20
    radius: int = 1
    hysteresis: float = 0.2
    linger_s: float = 2.0
    checkpoint_s: float = 10.0
    loads: int = 16
    saves: int = 16


class _Short(enum.IntEnum):
    """Degree of memory shortage, and so what may be evicted: nothing, chunks near no client, any chunk."""

    NO = 0
    NEAR = 1
    SCANS = 2


class _Rank(NamedTuple):
    """Rank of a chunk in the eviction order: the greatest is evicted first."""

    is_idle: bool
    is_unwanted: bool
    distance: int


_SAVED_TO_GO: Final = _Rank(True, True, 1 << 62)


class _Missing:
    """Chunks near a client that are not in memory, by their distance when they entered the window."""

    def __init__(self, radius: int) -> None:
        self._levels: list[dict[ChunkKey, None]] = [{} for _ in range(radius + 1)]
        self._level: dict[ChunkKey, int] = {}

    def __bool__(self) -> bool:
        return bool(self._level)

    def __contains__(self, key: ChunkKey) -> bool:
        return key in self._level

    def add(self, key: ChunkKey, distance: int) -> None:
        """Add a chunk, or change its distance."""
        self.discard(key)
        self._level[key] = min(distance, len(self._levels) - 1)
        self._levels[self._level[key]][key] = None

    def discard(self, key: ChunkKey) -> None:
        """Remove a chunk, if it is there."""
        level = self._level.pop(key, None)
        if level is not None:
            del self._levels[level][key]

    def nearest(self) -> ChunkKey:
        """Return one of the nearest chunks; the set must not be empty."""
        return next(reversed(next(level for level in self._levels if level)))


class Residency:
    """Decides which chunks of one map are in memory.

    Parameters
    ----------
    limits
        Limits of the map.
    new_bytes
        Memory of an empty chunk.
    sizes
        Memory that each chunk on disk will use.

    Attributes
    ----------
    chunks, index
        All chunks that are in memory or to be loaded, and their sorted keys.
    chunk_bytes, waiting_bytes
        Memory of chunks, and of waiting scans.
    beside_bytes, asked_bytes
        Memory used beside the chunks, and memory that a request waits for.
    active
        Known voxels in memory.
    """

    def __init__(
        self, limits: Limits, *, new_bytes: int = 4096, sizes: Mapping[ChunkKey, int] = MappingProxyType({})
    ) -> None:
        self.limits = limits
        self.chunks: dict[ChunkKey, Chunk] = {}
        self.index = KeyIndex()
        self.chunk_bytes = self.waiting_bytes = self.active = 0
        self.beside_bytes = self.asked_bytes = 0
        self.loading = self.saving = 0
        self._held = 0  # number of chunks that occupy memory
        self._new_bytes = new_bytes
        self._save_after_s = max(0.0, limits.checkpoint_s - TOGETHER_S)  # the rest is for the flush
        self._sizes = dict(sizes)
        self.windows = Windows(limits.radius, limits.hysteresis)
        self._missing = _Missing(limits.radius)
        self._needing: dict[ChunkKey, Chunk] = {}
        self._dirty: dict[ChunkKey, Chunk] = {}  # the one changed longest ago first
        # chunks to evict; the next one is at the end
        self._found: dict[State, list[tuple[_Rank, Chunk]]] = {State.CLEAN: [], State.DIRTY: []}
        self._review_s = dict.fromkeys(self._found, -math.inf)  # no review before, unless much changes
        self._fruitless_s = dict.fromkeys(self._found, -math.inf)  # nor before this, unless a client moves
        self._reviewed = dict.fromkeys(self._found, _Short.NO)
        self._changes = dict.fromkeys(self._found, 0)
        self._save_s = self._near_s = -math.inf  # no save, or load, before this time: a file failed
        self.durability = Durability()

    def fits(self, more_bytes: int) -> bool:
        """Return whether this much more memory may be used now beside the chunks."""
        return self.chunk_bytes + self.beside_bytes + more_bytes <= self.limits.budget_bytes

    def _fits(self, more_bytes: int, more_chunks: int = 0) -> bool:
        limits = self.limits
        if limits.max_chunks and self._held + more_chunks > limits.max_chunks:
            return False
        return self.fits(more_bytes) or self.chunk_bytes + more_bytes <= limits.reserve_bytes

    def _resize(self, chunk: Chunk, nbytes: int, active: int) -> None:
        self.chunk_bytes += nbytes - chunk.nbytes
        self.active += active - chunk.active
        self._held += bool(nbytes) - bool(chunk.nbytes)
        chunk.nbytes, chunk.active = nbytes, active

    def _want(self, key: ChunkKey) -> Chunk:
        """Return the chunk of this key, marked as to be loaded if it is not in memory."""
        chunk = self.chunks.get(key)
        if chunk is None:
            chunk = self.chunks[key] = Chunk(key)
            self.index.add(key)
        return chunk

    def _forget(self, key: ChunkKey) -> None:
        del self.chunks[key]
        self.index.discard(key)

    def move(self, client: object, position: tuple[float, float, float]) -> None:
        """Move a client to a position in chunks; see `Windows.move`."""
        entered, left = self.windows.move(client, position)
        center = self.windows.center(client)
        if not entered or center is None:
            return
        for key in left:
            self._missing.discard(key)
        for key in entered:
            if key not in self.chunks:
                self._missing.add(key, key.distance(center))
        if center in self._missing:
            self._missing.add(center, 0)
        self._fruitless_s = dict.fromkeys(self._found, -math.inf)

    def leave(self, client: object) -> None:
        """Forget a client's position."""
        for key in self.windows.leave(client):
            self._missing.discard(key)
        self._fruitless_s = dict.fromkeys(self._found, -math.inf)

    def is_wanted(self, chunk: Chunk, now_s: float) -> bool:
        """Return whether a chunk should stay: a scan needs it, a client is near, or it was just changed."""
        near = chunk.key in self.windows.near
        return near or bool(chunk.waiting) or now_s < chunk.changed_s + self.limits.linger_s

    # --- scans ----------------------------------------------------------------------------------

    def has_room(self, nbytes: int) -> bool:
        """Return whether another scan is accepted: waiting scans are bounded, but one may always wait."""
        return not self.waiting_bytes or self.waiting_bytes + nbytes <= self.limits.waiting_bytes

    def add(self, scan: Scan) -> None:
        """Add a scan: every chunk that it touches is wanted until the scan is applied to it."""
        if scan.to_apply:
            self.waiting_bytes += scan.nbytes
        for key in scan.to_apply:
            chunk = self._want(key)
            chunk.waiting.append(scan)
            self._missing.discard(key)
            self._needing[key] = chunk

    def ready(self) -> list[tuple[Chunk, Scan]]:
        """Return the scans that can be applied now: each chunk in memory with its next scan.

        Chunks that still lack the memory for their scan are at the end.
        """
        loaded = [chunk for chunk in self._needing.values() if chunk.state is not State.LOADING]
        return [(chunk, chunk.waiting[0]) for chunk in sorted(loaded, key=self._lacks_memory)]

    @property
    def is_ready(self) -> bool:
        """Whether a scan can be applied now, for which there may be memory."""
        needing = self._needing.values()
        return any(one.state is not State.LOADING and not self._lacks_memory(one) for one in needing)

    def _lacks_memory(self, chunk: Chunk) -> bool:
        return bool(chunk.missing_bytes) and not self._fits(chunk.missing_bytes)

    def may_grow(self, chunk: Chunk, more_bytes: int) -> bool:
        """Return whether a chunk may use this much more memory now; if not, others are evicted for it."""
        fits = self._fits(more_bytes)
        chunk.missing_bytes = 0 if fits else more_bytes
        return fits

    def applied(
        self, chunk: Chunk, scan: Scan, *, version: int, nbytes: int, active: int, now_s: float
    ) -> None:
        """Record that a chunk's next scan is applied; raise ValueError if another scan is before it."""
        if chunk.waiting[0] is not scan:
            raise ValueError("scans of a chunk are applied in the order in which they came")
        chunk.waiting.popleft()
        if not chunk.waiting:
            del self._needing[chunk.key]
        self._resize(chunk, nbytes, active)
        self._note_change()
        chunk.missing_bytes, chunk.changed_s = 0, now_s
        if version > chunk.version:
            chunk.version = version
            if chunk.state is State.CLEAN:
                self._soil(chunk, now_s)
        scan.to_apply.discard(chunk.key)
        self.durability.note_applied(chunk, scan)
        if scan.applied:
            self.waiting_bytes -= scan.nbytes

    def _soil(self, chunk: Chunk, now_s: float) -> None:
        chunk.state, chunk.dirty_since_s = State.DIRTY, now_s
        self._dirty[chunk.key] = chunk

    def adopt(
        self, key: ChunkKey, *, version: int, saved: int, nbytes: int, active: int, now_s: float
    ) -> Chunk:
        """Add a chunk that a previous writer left in memory; its file has the version ``saved``."""
        chunk = self._want(key)
        chunk.state, chunk.version, chunk.saved, chunk.durable = State.CLEAN, version, saved, saved
        self._missing.discard(key)
        self._resize(chunk, nbytes, active)
        if version > saved:
            self._soil(chunk, now_s)
        return chunk

    def _size(self, key: ChunkKey) -> int:
        return self._sizes.get(key, self._new_bytes)

    def begin_load(self, now_s: float) -> Chunk | None:
        """Begin to load a chunk: one that a scan waits for, else the nearest to a client."""
        if self.loading >= self.limits.loads:
            return None
        kept_bytes = sum(chunk.missing_bytes for chunk in self._needing.values())  # memory was freed for them
        for chunk in self._needing.values():
            if self._can_load(chunk, now_s) and self._fits(self._size(chunk.key) + kept_bytes, 1):
                return self._note_loading(chunk)
        if self._missing and now_s >= self._near_s and self._short(now_s) is not _Short.SCANS:
            key = self._missing.nearest()
            if self._fits(self._size(key) + kept_bytes, 1):
                self._missing.discard(key)
                return self._note_loading(self._want(key))
        return None

    def _can_load(self, chunk: Chunk, now_s: float) -> bool:
        return chunk.state is State.LOADING and not chunk.in_progress and chunk.retry_s <= now_s

    def _note_loading(self, chunk: Chunk) -> Chunk:
        chunk.in_progress = True
        self._resize(chunk, self._size(chunk.key), 0)
        self.loading += 1
        return chunk

    def loaded(self, chunk: Chunk, *, version: int, nbytes: int, active: int) -> None:
        """Record that a chunk was loaded from disk, or is new (version 0)."""
        self.loading -= 1
        chunk.in_progress = False
        chunk.state = State.CLEAN
        self._note_change()
        self._resize(chunk, nbytes, active)
        chunk.version = chunk.saved = version
        self.durability.note_loaded(chunk)

    def load_failed(self, chunk: Chunk, now_s: float) -> None:
        """Record that a file could not be read: scans that need it keep waiting."""
        self.loading -= 1
        chunk.in_progress = False
        self._resize(chunk, 0, 0)
        chunk.retry_s = now_s + RETRY_S
        if not chunk.waiting:
            self._forget(chunk.key)
            self._near_s = chunk.retry_s
            self._note_missing(chunk.key)

    def _note_missing(self, key: ChunkKey) -> None:
        """Queue a chunk that left memory to be loaded again, after the others, if it is near a client."""
        if key in self.windows.near:
            self._missing.add(key, self.limits.radius)

    # --- saving ---------------------------------------------------------------------------------

    def _short(self, now_s: float) -> _Short:
        """Return the present degree of memory shortage."""
        limits = self.limits
        if (
            (limits.most_active and self.active > limits.most_active)
            or not self._fits(0)
            or (self.asked_bytes and not self.fits(self.asked_bytes))
            or any(
                self._lacks_memory(chunk)
                or (self._can_load(chunk, now_s) and not self._fits(self._size(chunk.key), 1))
                for chunk in self._needing.values()
            )
        ):
            return _Short.SCANS
        if self._missing and now_s >= self._near_s and not self._fits(self._size(self._missing.nearest()), 1):
            return _Short.NEAR
        return _Short.NO

    def _may_go(self, chunk: Chunk, now_s: float, short: _Short) -> bool:
        """Return whether a chunk may be evicted; a scan that can be applied to it now is applied first."""
        if chunk.state is State.LOADING or (chunk.waiting and not self._lacks_memory(chunk)):
            return False
        return short is _Short.SCANS or (short is _Short.NEAR and not self.is_wanted(chunk, now_s))

    def _next_victim(self, now_s: float, state: State) -> Chunk | None:
        """Return the next clean, or dirty, chunk to evict."""
        short = self._short(now_s)
        if short is _Short.NO:
            return None
        found = self._found[state]
        if (not found or short < self._reviewed[state]) and self._is_review_due(now_s, state, short):
            self._review(now_s, state, short)
        while found:
            rank, chunk = found.pop()
            if chunk.state is state and self.chunks.get(chunk.key) is chunk and chunk.retry_s <= now_s:
                may_go = self._may_go(chunk, now_s, short)
                if state is State.DIRTY:
                    others_first = self._has_clean(rank, now_s, short)
                else:
                    others_first = bool(chunk.waiting) and self._becomes_clean(now_s)
                if may_go and not others_first:
                    return chunk
                if may_go or short < self._reviewed[state]:  # evicted when memory is shorter again
                    found.append((rank, chunk))
                    return None
        return None

    def _has_clean(self, rank: _Rank, now_s: float, short: _Short) -> bool:
        """Return whether a clean chunk is evicted before one of this rank, which then need not be saved."""
        found = self._found[State.CLEAN]
        return (
            bool(found)
            and found[-1][0] >= rank
            and found[-1][1].state is State.CLEAN
            and self._may_go(found[-1][1], now_s, short)
        )

    def _becomes_clean(self, now_s: float) -> bool:
        """Return whether saves make memory free, so that no chunk need be evicted that a scan waits for."""
        can_save = now_s >= self._save_s and any(not one.waiting for one in self._dirty.values())
        return bool(self.saving) or can_save

    def _note_change(self) -> None:
        """Count a chunk that was loaded, changed or saved."""
        for state in self._changes:
            self._changes[state] += 1

    def _is_review_due(self, now_s: float, state: State, short: _Short) -> bool:
        """Return whether to review all chunks again: rarely, or for a scan when much has changed."""
        if now_s >= max(self._review_s[state], self._fruitless_s[state]) or short > self._reviewed[state]:
            return True
        idle, changes = not self.loading and not self.saving, self._changes[state]
        much = changes > 0 if idle else changes * CHUNKS_PER_CHANGE >= len(self.chunks)
        return much and short is _Short.SCANS and not self._found[state]

    def _review(self, now_s: float, state: State, short: _Short) -> None:
        """Find the chunks that may be evicted: unwanted ones first, then the furthest."""
        self._changes[state], self._reviewed[state] = 0, short
        every = self._dirty if state is State.DIRTY else self.chunks
        found = [one for one in every.values() if one.state is state and self._may_go(one, now_s, short)]
        self._review_s[state] = now_s + REVIEW_S
        self._fruitless_s[state] = -math.inf if found else now_s + FRUITLESS_S
        is_idle = np.array([not one.waiting for one in found], bool)
        is_unwanted = np.array([not self.is_wanted(one, now_s) for one in found], bool)
        distance = self.windows.distances([one.key for one in found])
        order = np.lexsort((np.array([-one.active for one in found]), distance, is_unwanted, is_idle))
        least, part = FOUND_PER_REVIEW
        first = order[-max(least, len(found) // part) :]
        ranks = zip(
            is_idle[first].tolist(), is_unwanted[first].tolist(), distance[first].tolist(), strict=True
        )
        self._found[state][:] = [
            (_Rank(*rank), found[at]) for rank, at in zip(ranks, first.tolist(), strict=True)
        ]

    def begin_save(self, now_s: float, *, everything: bool = False) -> Chunk | None:
        """Begin to save a chunk: one to be evicted, else one that is due, or any."""
        if self.saving >= self.limits.saves or now_s < self._save_s:
            return None
        due_s = math.inf if everything else now_s - self._save_after_s
        old = takewhile(lambda one: one.dirty_since_s <= due_s, self._dirty.values())
        due = next((one for one in old if one.retry_s <= now_s), None)
        victim = self._next_victim(now_s, State.DIRTY)
        best = victim or due or self._next_to_leave(now_s)
        if best is not None:
            best.state, best.leaving = State.SAVING, best is victim
            del self._dirty[best.key]
            self.saving += 1
        return best

    def _next_to_leave(self, now_s: float) -> Chunk | None:
        """Return an unwanted chunk once memory is half full: once saved, it can be evicted immediately."""
        if not self._fills_up or self._short(now_s) is not _Short.NO:
            return None
        oldest = islice(self._dirty.values(), SAVE_CANDIDATES)
        return next((one for one in oldest if one.retry_s <= now_s and not self.is_wanted(one, now_s)), None)

    @property
    def _fills_up(self) -> bool:
        return 2 * (self.chunk_bytes + self.beside_bytes) > self.limits.budget_bytes

    def saved(self, chunk: Chunk, version: int, now_s: float) -> None:
        """Record that a chunk's file has this version; the chunk may have changed since."""
        self.saving -= 1
        chunk.saved = version
        self._sizes[chunk.key] = chunk.nbytes
        self.durability.note_written(chunk, version, now_s)
        chunk.state = State.CLEAN
        self._note_change()
        if chunk.version > version:
            self._soil(chunk, now_s)
        elif chunk.leaving:
            self._found[State.CLEAN].append((_SAVED_TO_GO, chunk))

    def save_failed(self, chunk: Chunk, now_s: float) -> None:
        """Record that a file could not be written: the chunk stays in memory, and saving is retried."""
        self.saving -= 1
        chunk.retry_s = self._save_s = now_s + RETRY_S  # others would fail as well
        self._soil(chunk, now_s)

    def save_again(self, chunk: Chunk, now_s: float) -> None:
        """Have a chunk in memory saved, whose file is lost."""
        chunk.saved = chunk.durable = 0
        if chunk.state is State.CLEAN:
            self._soil(chunk, now_s)

    @property
    def dirty(self) -> int:
        """Number of chunks that are changed and neither saved nor being saved."""
        return len(self._dirty)

    @property
    def all_durable(self) -> bool:
        """Whether every change is durable on disk."""
        return not self._dirty and not self.saving and not self.durability.written + self.durability.flushing

    def flush_is_due(self, now_s: float, *, everything: bool = False) -> bool:
        """Return whether to flush the written files: after some time, or with ``everything`` at once."""
        if self.durability.flushing:
            return False
        if everything and not self.saving:
            return bool(self.durability.written) and now_s >= self.durability.retry_s
        return now_s >= self.durability.due_s

    # --- eviction ------------------------------------------------------------------------------

    def evict_next(self, now_s: float) -> Chunk | None:
        """Evict a saved chunk, if that is needed: its memory counts as free."""
        chunk = self._next_victim(now_s, State.CLEAN)
        if chunk is None:
            return None
        self._resize(chunk, 0, 0)
        self._forget(chunk.key)
        if chunk.waiting:  # another scan needs its memory first: the chunk is loaded again later
            again = self._needing[chunk.key] = self._want(chunk.key)
            again.changed_s, again.waiting = chunk.changed_s, chunk.waiting
            chunk.waiting = deque()
        else:
            self._note_missing(chunk.key)
            if chunk.key in self.windows.near:  # a scan needed its memory, and would soon need it again
                self._near_s = now_s + RETRY_S
        return chunk

    def next_event_s(self, now_s: float) -> float:
        """Return the time of the next scheduled step; infinity for never."""
        times = [chunk.retry_s for chunk in self._needing.values() if chunk.retry_s > now_s]
        if not self.durability.flushing:
            times.append(self.durability.due_s)
        if self._missing and now_s < self._near_s:
            times.append(self._near_s)
        if self._dirty and self.saving < self.limits.saves:  # otherwise the end of a save wakes the worker
            first = next(iter(self._dirty.values()))
            times.append(max(first.dirty_since_s + self._save_after_s, first.retry_s, self._save_s))
            if self._fills_up:
                times.append(max(now_s + REVIEW_S, self._save_s))
        if self._short(now_s) is not _Short.NO:
            times.append(now_s + REVIEW_S)
        return max(now_s, min(times, default=math.inf))
