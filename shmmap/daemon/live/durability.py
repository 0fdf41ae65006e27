# SPDX-License-Identifier: Apache-2.0
"""Which scans no power cut takes away: those all of whose chunks have been written and flushed since."""

from __future__ import annotations

from collections.abc import Iterable

from shmmap.daemon.live.records import Chunk, Scan

__all__ = ["Durability"]


class Durability:
    """Files of chunks between being written and being durable; one flush at a time.

    Attributes
    ----------
    written
        Chunks whose files were written since the last flush began, with the versions.
    flushing
        What the flush that is under way makes durable.
    """

    def __init__(self) -> None:
        self.written: list[tuple[Chunk, int]] = []
        self.flushing: list[tuple[Chunk, int]] = []

    def note_loaded(self, chunk: Chunk) -> None:
        """A chunk has come back as its file is, which may not be durable yet."""
        if any(other.key == chunk.key for other, _ in (*self.written, *self.flushing)):
            self.written.append((chunk, chunk.version))
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

    def failed(self) -> None:
        """The flush did not come about."""
        self.flushing, self.written = [], self.flushing + self.written

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
        self.flushing = []
        return done
