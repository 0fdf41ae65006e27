# SPDX-License-Identifier: Apache-2.0
"""Which scans no power cut takes away: those all of whose chunks have been written and flushed since."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

from shmmap.chunks.voxels import ChunkKey
from shmmap.daemon.live.paging.records import Chunk, Scan

__all__ = ["Durability"]

TOGETHER_S: Final = 1.0
"""Files that were written in this time are flushed together: each once, however often it was written."""


class Durability:
    """Files of chunks between being written and being durable; one flush at a time.

    Attributes
    ----------
    written
        Chunks whose files were written since the last flush began, with the versions.
    flushing
        What the flush that is under way makes durable.
    retry_s
        Not before that: a flush failed.
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
        """When what was written is to be flushed; infinity for not at all."""
        return max(self._first_s + TOGETHER_S, self.retry_s)

    def note_written(self, chunk: Chunk, version: int, now_s: float) -> None:
        """A chunk's file was written."""
        self._first_s = min(self._first_s, now_s)
        self.written.append((chunk, version))
        self._written_keys.add(chunk.key)

    def note_loaded(self, chunk: Chunk) -> None:
        """A chunk has come back as its file is, which may not be durable yet."""
        if chunk.key in self._written_keys:
            self.written.append((chunk, chunk.version))
        elif chunk.key in self._flushing_keys:
            self.flushing.append((chunk, chunk.version))
        else:
            chunk.durable = chunk.version

    @staticmethod
    def note_applied(chunk: Chunk, scan: Scan) -> None:
        """A chunk has taken in a scan, or had before."""
        if chunk.version > chunk.durable:
            scan.to_save[chunk.key] = chunk.version
            chunk.unsaved.append((chunk.version, scan))

    def missing(self, chunks: Iterable[Chunk]) -> list[tuple[Chunk, int]]:
        """Chunks, of these and of those given up since they were written, that are not durable as they are.

        Each is, when its ``durable`` comes to the version that stands beside it.
        """
        there = [(chunk, chunk.version) for chunk in chunks if chunk.version > chunk.durable]
        return [*there, *self.written, *self.flushing]

    def begin(self) -> None:
        """A flush begins: it makes durable what was written until now."""
        self.flushing, self.written = self.written, []
        self._flushing_keys, self._written_keys = self._written_keys, set()
        self._first_s = math.inf

    def failed(self, retry_s: float) -> None:
        """The flush did not come about; it is tried again then."""
        self.flushing, self.written = [], self.flushing + self.written
        self._written_keys |= self._flushing_keys
        self._flushing_keys = set()
        self._first_s, self.retry_s = -math.inf, retry_s

    def flushed(self) -> list[Scan]:
        """The flush is over; returns the scans that are durable by that."""
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
