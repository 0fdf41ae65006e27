# SPDX-License-Identifier: Apache-2.0
"""Chunks of a live map, the scans applied to them, and which scans are safe from power cuts.

A scan is durable when all its chunks have been written and flushed after it was applied to them.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from shmmap.chunks.voxels import ChunkKey

TOGETHER_S: Final = 1.0
"""Files written within this time are flushed together, each once, however often it was written."""


class State(enum.Enum):
    """State of a chunk that is in memory or being loaded."""

    LOADING = "loading"
    CLEAN = "clean"
    DIRTY = "dirty"
    SAVING = "saving"


@dataclass(eq=False, slots=True)
class Scan:
    """One scan of a mapper until it is durable.

    Attributes
    ----------
    mapper, number
        Mapper that sent the scan, and the scan's number.
    nbytes
        Memory of the scan until it is applied.
    to_apply
        Chunks to which the scan is not applied yet.
    to_save
        Chunks to which it is applied, with the resulting version, which is not durable yet.
    """

    mapper: int
    number: int
    nbytes: int
    to_apply: set[ChunkKey]
    to_save: dict[ChunkKey, int] = field(default_factory=dict)

    @property
    def applied(self) -> bool:
        """Whether the whole scan is in memory that outlives any process."""
        return not self.to_apply

    @property
    def durable(self) -> bool:
        """Whether the whole scan is on disk."""
        return not self.to_apply and not self.to_save


@dataclass(eq=False, slots=True)
class Chunk:
    """A chunk that is in memory, or is to be loaded.

    Attributes
    ----------
    version, saved, durable
        The version in memory, in its file, and durable on disk.
    in_progress
        The chunk is being loaded.
    leaving
        The chunk is being saved before its eviction.
    retry_s
        Its file is not retried before this time.
    missing_bytes
        Memory that it needs for its next scan, and did not get.
    waiting
        Scans still to be applied to it, in this order.
    unsaved
        Scans applied to it that are not durable, with its version after each.
    """

    key: ChunkKey
    state: State = State.LOADING
    nbytes: int = 0
    active: int = 0
    version: int = 0
    saved: int = 0
    durable: int = 0
    in_progress: bool = False
    leaving: bool = False
    retry_s: float = -math.inf
    dirty_since_s: float = 0.0
    changed_s: float = -math.inf
    missing_bytes: int = 0
    waiting: deque[Scan] = field(default_factory=deque)
    unsaved: deque[tuple[int, Scan]] = field(default_factory=deque)


class Durability:
    """Chunk files that are written but not durable yet; one flush at a time.

    Attributes
    ----------
    written
        Chunks whose files were written since the last flush began, with the versions.
    flushing
        Chunks and versions that the running flush makes durable.
    retry_s
        Time before which no flush begins, after a failed one.
    """

    def __init__(self) -> None:
        self.written: list[tuple[Chunk, int]] = []
        self.flushing: list[tuple[Chunk, int]] = []
        self._written_keys: set[ChunkKey] = set()
        self._flushing_keys: set[ChunkKey] = set()
        self._first_s = math.inf
        self.retry_s = -math.inf

    @property
    def due_s(self) -> float:
        """Time at which the written files are to be flushed; infinity for never."""
        return max(self._first_s + TOGETHER_S, self.retry_s)

    def note_written(self, chunk: Chunk, version: int, now_s: float) -> None:
        """Record that a chunk's file was written."""
        self._first_s = min(self._first_s, now_s)
        self.written.append((chunk, version))
        self._written_keys.add(chunk.key)

    def note_loaded(self, chunk: Chunk) -> None:
        """Record that a chunk was loaded from its file, which may not be durable yet."""
        if chunk.key in self._written_keys:
            self.written.append((chunk, chunk.version))
        elif chunk.key in self._flushing_keys:
            self.flushing.append((chunk, chunk.version))
        else:
            chunk.durable = chunk.version

    @staticmethod
    def note_applied(chunk: Chunk, scan: Scan) -> None:
        """Record that a scan is applied to a chunk, now or before."""
        if chunk.version > chunk.durable:
            scan.to_save[chunk.key] = chunk.version
            chunk.unsaved.append((chunk.version, scan))

    def missing(self, chunks: Iterable[Chunk]) -> list[tuple[Chunk, int]]:
        """Return the chunks, of these and of the evicted ones, that are not durable yet, with their versions.

        Each is durable once its ``durable`` reaches the returned version.
        """
        in_memory = [(chunk, chunk.version) for chunk in chunks if chunk.version > chunk.durable]
        return [*in_memory, *self.written, *self.flushing]

    def begin(self) -> None:
        """Begin a flush of all files written until now."""
        self.flushing, self.written = self.written, []
        self._flushing_keys, self._written_keys = self._written_keys, set()
        self._first_s = math.inf

    def failed(self, retry_s: float) -> None:
        """End a failed flush; it is retried at this time."""
        self.flushing, self.written = [], self.flushing + self.written
        self._written_keys |= self._flushing_keys
        self._flushing_keys = set()
        self._first_s, self.retry_s = -math.inf, retry_s

    def flushed(self) -> list[Scan]:
        """End a flush; return the scans that it made durable."""
        done: list[Scan] = []
        for chunk, version in self.flushing:
            chunk.durable = max(chunk.durable, version)
            while chunk.unsaved and chunk.unsaved[0][0] <= version:
                _, scan = chunk.unsaved.popleft()
                del scan.to_save[chunk.key]
                if scan.durable:
                    done.append(scan)
        self.flushing, self._flushing_keys = [], set()
        return done
