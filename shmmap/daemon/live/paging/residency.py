# SPDX-License-Identifier: Apache-2.0
"""Which chunks of a live map are in memory: what is loaded, written, saved and given up, and in which order.

Pure: clock and bytes are injected, and nothing is done here.  Whoever has the memory asks what is to be done
next (`next_load`, `ready`, `next_save`, `next_eviction`) and tells when it was done.

- A chunk is loaded because a scan waits for it, or because it is near a client; it is given up when neither
  holds any more, or when memory is short: the furthest first.
- A scan is never dropped: for a chunk that is not in memory it waits, and scans are applied in the order in
  which they came.  What waits is bounded; beyond that scans are not accepted (`has_room`).
- A chunk that was written is saved before it is given up, and is durable after `Limits.checkpoint_s`;
  one that is written while it is saved is dirty again.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import takewhile
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.paging.durability import TOGETHER_S, Durability
from shmmap.daemon.live.paging.leases import Leases
from shmmap.daemon.live.paging.records import Chunk, Lease, Limits, Scan, State
from shmmap.daemon.live.paging.victims import REVIEW_S, Victims
from shmmap.daemon.live.paging.windows import Windows

__all__ = ["Residency"]

RETRY_S: Final = 1.0
"""How long after a file could not be read or written it is tried again."""


class Residency:
    """Decides for one map.

    Parameters
    ----------
    limits
        What it may take.
    new_bytes
        Memory of a chunk in which nothing is known.

    Attributes
    ----------
    chunks
        All that are in memory, or wanted there.
    leases
        What is out of service and may still be mapped.
    chunk_bytes, waiting_bytes
        Memory of chunks, and what waiting scans take.
    active
        Known voxels in memory.
    windows, durability
        What is near a client; which scans are safe from power cuts.
    """

    def __init__(self, limits: Limits, *, new_bytes: int = 4096) -> None:
        self.limits = limits
        self.chunks: dict[ChunkKey, Chunk] = {}
        self.leases = Leases()
        self.chunk_bytes = self.waiting_bytes = self.active = 0
        self.loading = self.saving = 0
        self._new_bytes = new_bytes
        self._save_after_s = max(0.0, limits.checkpoint_s - TOGETHER_S)  # then it is flushed
        self._sizes: dict[ChunkKey, int] = {}
        self.windows = Windows(limits.radius, limits.hysteresis)
        self._missing: list[ChunkKey] = []  # near, not in memory; the nearest last
        self._needing: dict[ChunkKey, Chunk] = {}
        self._dirty: dict[ChunkKey, Chunk] = {}  # since the longest first
        self._victims = Victims(self.chunks, self._may_go, self._leaves_last)
        self._save_s = self._near_s = -math.inf  # not before: a file could not be written, or read
        self.durability = Durability()

    def _fits(self, more_bytes: int) -> bool:
        chunks = self.chunk_bytes + more_bytes
        return chunks + self.leases.nbytes <= self.limits.budget_bytes or chunks <= self.limits.reserve_bytes

    def _resize(self, chunk: Chunk, nbytes: int, active: int) -> None:
        self.chunk_bytes += nbytes - chunk.nbytes
        self.active += active - chunk.active
        chunk.nbytes, chunk.active = nbytes, active

    def move(self, client: object, position: tuple[float, float, float]) -> None:
        """A client is somewhere, in chunks; see `Windows.move`."""
        if self.windows.move(client, position):
            self._look_around()

    def leave(self, client: object) -> None:
        """A client has gone."""
        if self.windows.leave(client):
            self._look_around()

    def _look_around(self) -> None:
        near = self.windows.near
        missing = (key for key in near if key not in self.chunks)
        self._missing = sorted(missing, key=near.__getitem__, reverse=True)
        self._victims.look_again()

    def is_wanted(self, chunk: Chunk, now_s: float) -> bool:
        """Whether a chunk is to stay: a scan waits for it, it is near a client, or was just changed."""
        near = chunk.key in self.windows.near
        return near or bool(chunk.waiting) or now_s < chunk.changed_s + self.limits.linger_s

    # --- scans ----------------------------------------------------------------------------------

    def has_room(self, nbytes: int) -> bool:
        """Whether a scan may come: what waits is bounded, and a single one may always wait."""
        return not self.waiting_bytes or self.waiting_bytes + nbytes <= self.limits.waiting_bytes

    def add(self, scan: Scan) -> None:
        """A scan has come: every chunk that it touches is wanted until it has taken it in."""
        if scan.to_apply:
            self.waiting_bytes += scan.nbytes
        for key in scan.to_apply:
            chunk = self.chunks.get(key) or self.chunks.setdefault(key, Chunk(key))
            chunk.waiting.append(scan)
            self._needing[key] = chunk

    def ready(self) -> list[tuple[Chunk, Scan]]:
        """What can be applied now: of each chunk in memory the scan that comes next.

        Those that had not the memory for it, and have not now, come last.
        """
        there = [chunk for chunk in self._needing.values() if chunk.state is not State.LOADING]
        return [(chunk, chunk.waiting[0]) for chunk in sorted(there, key=self._lacks_memory)]

    @property
    def is_ready(self) -> bool:
        """Whether something can be applied now for which there may be memory."""
        needing = self._needing.values()
        return any(one.state is not State.LOADING and not self._lacks_memory(one) for one in needing)

    def _lacks_memory(self, chunk: Chunk) -> bool:
        return bool(chunk.missing_bytes) and not self._fits(chunk.missing_bytes)

    def may_grow(self, chunk: Chunk, more_bytes: int) -> bool:
        """Whether a chunk may take so much more memory now; if not, others are given up for it."""
        fits = self._fits(more_bytes)
        chunk.missing_bytes = 0 if fits else more_bytes
        return fits

    def applied(
        self, chunk: Chunk, scan: Scan, *, version: int, nbytes: int, active: int, now_s: float
    ) -> None:
        """A chunk has taken in the scan that it waited for first; ValueError if another one comes first."""
        if chunk.waiting[0] is not scan:
            raise ValueError("scans of a chunk are applied in the order in which they came")
        chunk.waiting.popleft()
        if not chunk.waiting:
            del self._needing[chunk.key]
        self._resize(chunk, nbytes, active)
        self._victims.news += 1
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
        """A chunk is in memory since an earlier life of the writer; its file has the version ``saved``."""
        chunk = self.chunks[key] = Chunk(key, State.CLEAN, version=version, saved=saved, durable=saved)
        self._resize(chunk, nbytes, active)
        if version > saved:
            self._soil(chunk, now_s)
        return chunk

    def note_size(self, key: ChunkKey, nbytes: int) -> None:
        """A chunk on disk takes so much memory."""
        self._sizes[key] = nbytes

    def _size(self, key: ChunkKey) -> int:
        return self._sizes.get(key, self._new_bytes)

    def next_load(self, now_s: float) -> Chunk | None:
        """The chunk to load now: those that scans wait for first, then what is nearest to a client."""
        if self.loading >= self.limits.loads:
            return None
        kept_bytes = sum(chunk.missing_bytes for chunk in self._needing.values())  # room was made for these
        for chunk in self._needing.values():
            if self._can_load(chunk, now_s) and self._fits(self._size(chunk.key) + kept_bytes):
                return self._begin_load(chunk)
        if self._is_short(now_s) or now_s < self._near_s:
            return None
        while self._missing:
            key = self._missing[-1]
            if key in self.chunks:
                self._missing.pop()
            elif self._fits(self._size(key) + kept_bytes):
                self._missing.pop()
                return self._begin_load(self.chunks.setdefault(key, Chunk(key)))
            else:
                break
        return None

    def _can_load(self, chunk: Chunk, now_s: float) -> bool:
        return chunk.state is State.LOADING and not chunk.under_way and chunk.retry_s <= now_s

    def _begin_load(self, chunk: Chunk) -> Chunk:
        chunk.under_way = True
        self._resize(chunk, self._size(chunk.key), 0)
        self.loading += 1
        return chunk

    def loaded(self, chunk: Chunk, *, version: int, nbytes: int, active: int) -> None:
        """A chunk is in memory as it is on disk, or new: version 0."""
        self.loading -= 1
        chunk.under_way = False
        chunk.state = State.CLEAN
        self._victims.news += 1
        self._resize(chunk, nbytes, active)
        chunk.version = chunk.saved = version
        self.durability.note_loaded(chunk)

    def load_failed(self, chunk: Chunk, now_s: float) -> None:
        """A file could not be read just now: what waits for it goes on waiting."""
        self.loading -= 1
        chunk.under_way = False
        self._resize(chunk, 0, 0)
        chunk.retry_s = now_s + RETRY_S
        if not chunk.waiting:
            del self.chunks[chunk.key]
            self._near_s = chunk.retry_s
            self._missing[:0] = [chunk.key] if chunk.key in self.windows.near else []

    # --- saving ---------------------------------------------------------------------------------

    def _is_short(self, now_s: float) -> bool:
        """Whether a scan waits for memory, or there are more known voxels than there may be."""
        if self.limits.most_active and self.active > self.limits.most_active:
            return True
        return any(
            self._lacks_memory(chunk)
            or (self._can_load(chunk, now_s) and not self._fits(self._size(chunk.key)))
            for chunk in self._needing.values()
        )

    def _may_go(self, chunk: Chunk, now_s: float, *, short: bool) -> bool:
        """Whether a chunk may be given up; one that can take in a scan now does that first."""
        if chunk.state is State.LOADING or (chunk.waiting and not self._lacks_memory(chunk)):
            return False
        return short or not self.is_wanted(chunk, now_s)

    def _leaves_last(self, chunk: Chunk, now_s: float) -> tuple[bool, bool, int, bool, int]:
        """In which order chunks are given up, the first with the greatest: the furthest, the cleanest."""
        return (
            not chunk.waiting, not self.is_wanted(chunk, now_s), self.windows.distance(chunk.key),
            chunk.state is State.CLEAN, -chunk.active,
        )  # fmt: skip

    def _next_victim(self, now_s: float, state: State) -> Chunk | None:
        """What to give up next: unwanted ones, and where memory is short others, the furthest first."""
        idle = not self.loading and not self.saving
        return self._victims.next(state, now_s, short=self._is_short(now_s), idle=idle)

    def next_save(self, now_s: float, *, everything: bool = False) -> Chunk | None:
        """The chunk to save now: one that is to be given up, else one whose time has come, or all."""
        if self.saving >= self.limits.saves or now_s < self._save_s:
            return None
        due_s = math.inf if everything else now_s - self._save_after_s
        old = takewhile(lambda one: one.dirty_since_s <= due_s, self._dirty.values())
        due = next((one for one in old if one.retry_s <= now_s), None)
        victim = self._next_victim(now_s, State.DIRTY)
        best = victim or due
        if best is not None:
            best.state, best.leaving = State.SAVING, best is victim
            del self._dirty[best.key]
            self.saving += 1
        return best

    def saved(self, chunk: Chunk, version: int, now_s: float) -> None:
        """A chunk's file has this version; it may have been written since."""
        self.saving -= 1
        chunk.saved = version
        self._sizes[chunk.key] = chunk.nbytes
        self.durability.note_written(chunk, version, now_s)
        chunk.state = State.CLEAN
        self._victims.news += 1
        if chunk.version > version:
            self._soil(chunk, now_s)
        elif chunk.leaving:
            self._victims.saved(chunk)

    def save_failed(self, chunk: Chunk, now_s: float) -> None:
        """A file could not be written: the chunk stays in memory, and is tried again."""
        self.saving -= 1
        chunk.retry_s = self._save_s = now_s + RETRY_S  # others would fail as well
        self._soil(chunk, now_s)

    @property
    def all_durable(self) -> bool:
        """Whether no change is in memory alone."""
        return not self._dirty and not self.saving and not self.durability.written + self.durability.flushing

    def flush_is_due(self, now_s: float, *, everything: bool = False) -> bool:
        """Whether files that were written are to be made durable now: those of some time together, or all."""
        if self.durability.flushing:
            return False
        if everything and not self.saving:
            return bool(self.durability.written) and now_s >= self.durability.retry_s
        return now_s >= self.durability.due_s

    # --- giving up ------------------------------------------------------------------------------

    def next_eviction(self, now_s: float) -> Lease | None:
        """Give up a chunk that is as its file; its memory counts until its lease ends."""
        chunk = self._next_victim(now_s, State.CLEAN)
        if chunk is None:
            return None
        lease = self.leases.begin(chunk.key, chunk.nbytes)
        self._resize(chunk, 0, 0)
        del self.chunks[chunk.key]
        if chunk.waiting:  # for another that comes first it gave way: later it is loaded again
            again = Chunk(chunk.key, changed_s=chunk.changed_s, waiting=chunk.waiting)
            self.chunks[chunk.key] = self._needing[chunk.key] = again
            chunk.waiting = deque()
        elif chunk.key in self.windows.near:
            self._missing.insert(0, chunk.key)
        return lease

    def next_event_s(self, now_s: float) -> float:
        """When there is something to do although nothing happens; infinity for never."""
        times = [chunk.retry_s for chunk in self._needing.values() if chunk.retry_s > now_s]
        if not self.durability.flushing:
            times.append(self.durability.due_s)
        if self._missing and now_s < self._near_s:
            times.append(self._near_s)
        if self._dirty and self.saving < self.limits.saves:  # else there is when one has been saved
            first = next(iter(self._dirty.values()))
            times.append(max(first.dirty_since_s + self._save_after_s, first.retry_s, self._save_s))
        if self._needing or len(self.chunks) > sum(key in self.chunks for key in self.windows.near):
            times.append(now_s + REVIEW_S)
        return max(now_s, min(times, default=math.inf))
